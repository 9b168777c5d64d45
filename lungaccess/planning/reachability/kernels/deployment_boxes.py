"""Boxes of deployments from a piece of the airway, and how their tips see a target.

A deployment has a place of the scope tip, a direction, a rotation of the tubes about it, and the insertions
of both tubes.  A box is a range of each, a `(BOX_COLUMNS,)` float64 array: see `box_of_tubes`.

`frame` (3, 3) has X, Y and the axis of a piece of the airway as rows.  A place is given by its coordinates
along them in mm, a direction is the axis turned by the rotation vector `EAST X + NORTH Y`.
"""

import math

from anatomy.kernels.compiling import inner_kernel
from lungaccess.planning.coupled.kernels.box_of_tubes import (
    HALF,
    INNER,
    OUTER,
    ROTATION,
    cross,
    dot,
    minus,
    norm,
    times,
    tubes_of,
)

EAST, NORTH, PLACE_X, PLACE_Y, PLACE_Z, SIDES = 0, 1, 5, 6, 7, 8
BOX_COLUMNS = HALF + SIDES
"""The sides of a box, beside those that every box has, and its columns: middles, then half widths."""


@inner_kernel
def _in_lps(frame, u, v, w):
    """Return u X + v Y + w axis."""
    return (
        u * frame[0, 0] + v * frame[1, 0] + w * frame[2, 0],
        u * frame[0, 1] + v * frame[1, 1] + w * frame[2, 1],
        u * frame[0, 2] + v * frame[1, 2] + w * frame[2, 2],
    )


@inner_kernel
def turned_vector(frame, east, north, x, y, z):
    """Rotate x X + y Y + z axis by the rotation vector east X + north Y; see the module."""
    angle = math.hypot(east, north)
    c, s = math.cos(angle), math.sin(angle)
    e, n = (east / angle, north / angle) if angle > 0.0 else (1.0, 0.0)
    along = (e * x + n * y) * (1.0 - c)
    u = x * c + n * z * s + e * along
    v = y * c - e * z * s + n * along
    w = z * c + (e * y - n * x) * s
    return _in_lps(frame, u, v, w)


@inner_kernel
def _turning(frame, east, north, x, y):
    """Return the axis about which a direction turns as its rotation vector changes by x X + y Y.

    That is the left Jacobian of the rotation; its norm is at most 1.
    """
    angle = math.hypot(east, north)
    e, n = (east / angle, north / angle) if angle > 0.0 else (1.0, 0.0)
    p = math.sin(angle) / angle if angle > 0.0 else 1.0
    q = (1.0 - math.cos(angle)) / angle if angle > 0.0 else 0.0
    along = (1.0 - p) * (e * x + n * y)
    u, v, w = p * x + along * e, p * y + along * n, q * (e * y - n * x)
    return _in_lps(frame, u, v, w)


@inner_kernel
def place_of(frame, box):
    """Return the place in the middle of a box, LPS mm, and how far from it those of others are at most."""
    middle = _in_lps(frame, box[PLACE_X], box[PLACE_Y], box[PLACE_Z])
    return middle, norm((box[HALF + PLACE_X], box[HALF + PLACE_Y], box[HALF + PLACE_Z]))


@inner_kernel
def box_tubes(tubes, frame, box):
    """Return the `BoxTubes` of a box."""
    middle, away = place_of(frame, box)
    forward = turned_vector(frame, box[EAST], box[NORTH], 0.0, 0.0, 1.0)
    normal = turned_vector(
        frame, box[EAST], box[NORTH], math.cos(box[ROTATION]), math.sin(box[ROTATION]), 0.0
    )
    tilt = math.hypot(box[HALF + EAST], box[HALF + NORTH])
    return tubes_of(tubes, middle, forward, normal, away, tilt, box)


@inner_kernel
def _project(line, tangent, change, sums):
    """Add what a side of a box changes to the `sums` of `sum_changes`; return what the side costs, mm."""
    part = dot(line, change)
    size2 = dot(change, change)
    sums[0] += abs(part)
    sums[1] += math.sqrt(max(size2 - part * part, 0.0))
    sums[2] += abs(dot(tangent, change))
    return abs(part) + 0.5 * math.sqrt(size2)


@inner_kernel
def sum_changes(seen, family, tangent, target, frame, box, sums, costs):
    """Sum up by how much the target moves as the tips of a box see it, to first order.

    Args:
        tangent, target (tuples of 3 float): Direction of the middle tip, and LPS mm.
        sums ((3,) float64): Receives by how much the target may move along the line from the centre of the
            tightest circle in the plane of tip and target, across it, and along the tip's direction, mm.
        costs ((SIDES,) float64): Receives what each side of the box costs, mm.
    """
    line = seen.line
    from_place = minus(target, family.base, 1.0)
    for m in range(len(sums)):
        sums[m] = 0.0
    for m in range(3):
        axis = (frame[m, 0], frame[m, 1], frame[m, 2])
        costs[PLACE_X + m] = _project(line, tangent, times(axis, box[HALF + PLACE_X + m]), sums)
    east = cross(_turning(frame, box[EAST], box[NORTH], 1.0, 0.0), from_place)
    costs[EAST] = _project(line, tangent, times(east, box[HALF + EAST]), sums)
    north = cross(_turning(frame, box[EAST], box[NORTH], 0.0, 1.0), from_place)
    costs[NORTH] = _project(line, tangent, times(north, box[HALF + NORTH]), sums)
    costs[ROTATION] = _project(line, tangent, seen.by_rotation, sums)
    costs[OUTER] = _project(line, tangent, seen.by_outer, sums) + 1.5 * seen.rate_outer
    costs[INNER] = _project(line, tangent, seen.by_inner, sums) + 1.5 * seen.rate_inner
