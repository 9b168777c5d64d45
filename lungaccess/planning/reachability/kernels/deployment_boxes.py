"""Boxes of deployments: the one in the middle, and by how much the others of a box differ from it.

A deployment has a place of the scope tip, a direction, a rotation of the tubes about it, and the insertions
of both tubes.  A box is a range of each, a `(BOX_COLUMNS,)` float64 array.

`frame` (3, 3) has X, Y and the axis of a piece of the airway as rows.  A place is given by its coordinates
along them in mm, a direction is the axis turned by the rotation vector `EAST X + NORTH Y`.
"""

from __future__ import annotations

import math

from anatomy.kernels.compiling import inner_kernel, merged_kernel
from stages.tube.kernels import CURVED_LENGTH, INNER_CURVATURE, OVERLAP_CURVATURE, planar_point

# Columns of a box: the middles of its sides, and their half widths.
EAST, NORTH, ROTATION, OUTER, INNER, PLACE_X, PLACE_Y, PLACE_Z, SIDES = range(9)
HALF = SIDES
BOX_COLUMNS = 2 * SIDES

SPARE_MM = 1e-6
"""For rounding."""

BENT_THROUGHOUT, STRAIGHT_FIRST, OUTER_STRAIGHT, MIXED = range(4)
"""What the shapes of a box have in common; see `_shape_of`."""


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
    return (
        u * frame[0, 0] + v * frame[1, 0] + w * frame[2, 0],
        u * frame[0, 1] + v * frame[1, 1] + w * frame[2, 1],
        u * frame[0, 2] + v * frame[1, 2] + w * frame[2, 2],
    )


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
    return (
        u * frame[0, 0] + v * frame[1, 0] + w * frame[2, 0],
        u * frame[0, 1] + v * frame[1, 1] + w * frame[2, 1],
        u * frame[0, 2] + v * frame[1, 2] + w * frame[2, 2],
    )


@inner_kernel
def _cross(a, b):
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@inner_kernel
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inner_kernel
def _norm(a):
    return math.sqrt(_dot(a, a))


@inner_kernel
def _from(a, b, scale):
    """Return a - scale b."""
    return (a[0] - scale * b[0], a[1] - scale * b[1], a[2] - scale * b[2])


@inner_kernel
def heading(tubes, outer, inner):
    """Return the angle (rad) by which the tubes have turned at their tip; see `planar_point`."""
    straight = max(inner - tubes[CURVED_LENGTH], 0.0)
    shared = min(max(outer - straight, 0.0), inner - straight)
    return tubes[OVERLAP_CURVATURE] * shared + tubes[INNER_CURVATURE] * (inner - straight - shared)


@inner_kernel
def place_of(frame, box):
    """Return the place in the middle of a box, LPS mm, and how far from it those of others are at most."""
    x, y, z = box[PLACE_X], box[PLACE_Y], box[PLACE_Z]
    middle = (
        x * frame[0, 0] + y * frame[1, 0] + z * frame[2, 0],
        x * frame[0, 1] + y * frame[1, 1] + z * frame[2, 1],
        x * frame[0, 2] + y * frame[1, 2] + z * frame[2, 2],
    )
    return middle, _norm((box[HALF + PLACE_X], box[HALF + PLACE_Y], box[HALF + PLACE_Z]))


@merged_kernel
def _shape_of(tubes, box):
    """Tell what the tubes of a box have in common, so that their shape depends smoothly on the insertions.

    BENT_THROUGHOUT: curved from the scope tip on.  STRAIGHT_FIRST: straight, then curved, with the end of the
    outer tube in the curve.  OUTER_STRAIGHT: the same with the end of the outer tube before the curve.
    MIXED: none of these, or the inner tube may be less far out than the outer.
    """
    outer, inner = box[OUTER], box[INNER]
    half_outer, half_inner = box[HALF + OUTER], box[HALF + INNER]
    if outer > inner:
        return MIXED
    if inner + half_inner <= tubes[CURVED_LENGTH]:
        return BENT_THROUGHOUT
    if inner - half_inner >= tubes[CURVED_LENGTH]:
        if outer - half_outer >= inner + half_inner - tubes[CURVED_LENGTH]:
            return STRAIGHT_FIRST
        if outer + half_outer <= inner - half_inner - tubes[CURVED_LENGTH]:
            return OUTER_STRAIGHT
    return MIXED


@inner_kernel
def _turned_by(second, moved, rate, lever, half, extra):
    """Add a rotation to how far a point may move and to the remainder of second order; see `target_seen`.

    It turns by up to `rate` `half` (rad) with the point at most `lever` mm from its centre; `extra` mm a mm
    is how fast the centre, or what is turned, goes on itself.
    """
    speed = rate * lever
    second += rate * half * (moved + 0.5 * (extra + speed) * half)
    return second, moved + speed * half


@inner_kernel
def _project(line, tangent, change, half, sums):
    """Add what a side of a box changes to the `sums` of `target_seen`; return what the side costs, mm."""
    part = _dot(line, change)
    size2 = _dot(change, change)
    sums[0] += abs(part) * half
    sums[1] += math.sqrt(max(size2 - part * part, 0.0)) * half
    sums[2] += abs(_dot(tangent, change)) * half
    return (abs(part) + 0.5 * math.sqrt(size2)) * half


@inner_kernel
def target_seen(tubes, kappa, target, frame, box, sums, costs):
    """Bound how far the target moves as the tips of a box see it, and where their tightest circle is.

    Every deployment moves the tip by a chain of motions: to its place, by its direction, its rotation, and
    along and in the bend of the tubes.  Seen from the tip the target makes the reverse motions, the place
    first. The displacement by each is at most its rate times how far the target is from its centre; the
    remainder of second order of a chain is the sum over pairs of what the outer motion turns of what the
    inner has moved, and half the square of each.

    Parameters
    ----------
    tubes, kappa
        kappa in 1/mm.
    target : tuple of 3 float
        LPS mm.
    frame, box
        See the module.
    sums : (3,) float64
        Receives by how much, to first order, the target may move along the line from the centre of the
        tightest circle in the plane of tip and target, across it, and along the tip's direction, mm.
    costs : (SIDES,) float64
        Receives what each side of the box costs, mm.

    Returns
    -------
    tuple
        Middle tip pose (6 float, LPS mm), `aside` and `ahead` of the target there, its distance from the
        circle's centre, the greatest displacement, and the remainder of second order, mm.
    """
    outer, inner = box[OUTER], box[INNER]
    half_outer, half_inner = box[HALF + OUTER], box[HALF + INNER]
    tilt = math.hypot(box[HALF + EAST], box[HALF + NORTH])
    roll = box[HALF + ROTATION]
    bent = tubes[INNER_CURVATURE]
    unlike = tubes[OVERLAP_CURVATURE] - bent
    middle, away = place_of(frame, box)
    forward = turned_vector(frame, box[EAST], box[NORTH], 0.0, 0.0, 1.0)
    normal = turned_vector(
        frame, box[EAST], box[NORTH], math.cos(box[ROTATION]), math.sin(box[ROTATION]), 0.0
    )
    binormal = _cross(forward, normal)
    x, z = planar_point(tubes, outer, inner, inner)
    angle = heading(tubes, outer, inner)
    sine, cosine = math.sin(angle), math.cos(angle)
    tip = _from(_from(middle, normal, -x), forward, -z)
    tangent = (
        sine * normal[0] + cosine * forward[0],
        sine * normal[1] + cosine * forward[1],
        sine * normal[2] + cosine * forward[2],
    )
    joint = min(max(outer, inner - tubes[CURVED_LENGTH], 0.0), inner)
    joint_x, joint_z = planar_point(tubes, outer, inner, joint)
    from_place = _from(target, middle, 1.0)
    from_joint = _from(_from(from_place, normal, joint_x), forward, joint_z)
    from_tip = _from(target, tip, 1.0)
    far = _norm(from_place)
    ahead = _dot(from_tip, tangent)
    aside = _from(from_tip, tangent, ahead)
    rho = _norm(aside)

    # How far the target moves: the motions from the first that moves it, as the tip sees it, to the last.
    moved = away
    second, moved = _turned_by(0.0, moved, 1.0, far + moved, tilt, 0.0)
    along = _dot(from_place, forward)
    beside = math.sqrt(max(far * far - along * along, 0.0))
    second, moved = _turned_by(second, moved, 1.0, min(far + away, beside + moved), roll, 0.0)
    shape = _shape_of(tubes, box)
    costs[OUTER] = costs[INNER] = 0.0
    if shape == BENT_THROUGHOUT:
        lever = _norm(from_joint) + moved + half_outer
        second, moved = _turned_by(second, moved, abs(unlike), lever, half_outer, 1.0)
        lever = (_norm(from_tip) + moved + half_inner) * math.exp(abs(bent) * half_inner)
        second += abs(bent) * half_inner * (moved + 0.5 * (1.0 + abs(bent) * lever) * half_inner)
        moved += (1.0 + abs(bent) * lever) * half_inner
    elif shape == STRAIGHT_FIRST:
        moved += half_inner
        half = half_outer + half_inner
        lever = _norm(from_joint) + moved + half
        second, moved = _turned_by(second, moved, abs(unlike), lever, half, 1.0)
    elif shape == OUTER_STRAIGHT:
        moved += half_inner
    else:
        lever = far + away + inner + half_inner
        costs[OUTER] = abs(unlike) * lever * half_outer
        costs[INNER] = (1.0 + max(abs(unlike), abs(bent)) * lever) * half_inner
        moved += costs[OUTER] + costs[INNER]
        second += costs[OUTER] + costs[INNER]
        costs[OUTER] *= 1.5
        costs[INNER] *= 1.5

    # To first order, along the line from the centre of the tightest circle to the target.
    towards = (aside[0] / rho, aside[1] / rho, aside[2] / rho) if rho > SPARE_MM else normal
    from_centre = _from(from_tip, towards, 1.0 / kappa)
    size = _norm(from_centre)
    line = (
        (from_centre[0] / size, from_centre[1] / size, from_centre[2] / size) if size > SPARE_MM else towards
    )
    for m in range(len(sums)):
        sums[m] = 0.0
    for m in range(3):
        axis = (frame[m, 0], frame[m, 1], frame[m, 2])
        costs[PLACE_X + m] = _project(line, tangent, axis, box[HALF + PLACE_X + m], sums)
    east = _cross(_turning(frame, box[EAST], box[NORTH], 1.0, 0.0), from_place)
    costs[EAST] = _project(line, tangent, east, box[HALF + EAST], sums)
    north = _cross(_turning(frame, box[EAST], box[NORTH], 0.0, 1.0), from_place)
    costs[NORTH] = _project(line, tangent, north, box[HALF + NORTH], sums)
    costs[ROTATION] = _project(line, tangent, _cross(forward, from_place), roll, sums)
    about_joint = _cross(binormal, from_joint)
    if shape == BENT_THROUGHOUT:
        costs[OUTER] = _project(line, tangent, about_joint, abs(unlike) * half_outer, sums)
        change = _from(tangent, _cross(binormal, from_tip), -bent)
        costs[INNER] = _project(line, tangent, change, half_inner, sums)
    elif shape == STRAIGHT_FIRST:
        costs[OUTER] = _project(line, tangent, about_joint, abs(unlike) * half_outer, sums)
        costs[INNER] = _project(line, tangent, _from(forward, about_joint, unlike), half_inner, sums)
    elif shape == OUTER_STRAIGHT:
        costs[INNER] = _project(line, tangent, forward, half_inner, sums)
    pose = (tip[0], tip[1], tip[2], tangent[0], tangent[1], tangent[2])
    return pose, rho, ahead, size, moved, second


@inner_kernel
def tubes_of(tubes, frame, box):
    """Return what the samples of a box's tubes need: the middle one, and how the others differ.

    Place, direction and bending direction; and how much the place, the direction, the rotation, the share of
    the outer tube and that of the straight part may
    differ: see `sample_of`.
    """
    middle, away = place_of(frame, box)
    forward = turned_vector(frame, box[EAST], box[NORTH], 0.0, 0.0, 1.0)
    normal = turned_vector(
        frame, box[EAST], box[NORTH], math.cos(box[ROTATION]), math.sin(box[ROTATION]), 0.0
    )
    most = max(abs(tubes[INNER_CURVATURE]), abs(tubes[OVERLAP_CURVATURE]))
    unlike = abs(tubes[OVERLAP_CURVATURE] - tubes[INNER_CURVATURE])
    longest = box[INNER] + box[HALF + INNER]
    bounds = (
        away,
        math.hypot(box[HALF + EAST], box[HALF + NORTH]),
        box[HALF + ROTATION],
        unlike * box[HALF + OUTER],
        max(box[OUTER] - box[HALF + OUTER], 0.0),
        most * box[HALF + INNER] if longest > tubes[CURVED_LENGTH] else 0.0,
    )
    inserted = box[INNER] if longest > tubes[CURVED_LENGTH] else longest
    return middle, forward, normal, bounds, box[OUTER], inserted


@inner_kernel
def sample_of(tubes, family, s):
    """Return the middle tubes' point at arc length `s`, LPS mm, and how far from it those of others are."""
    middle, forward, normal, bounds, outer, inner = family
    place, tilt, roll, sharing, first_outer, opening = bounds
    x, z = planar_point(tubes, outer, inner, s)
    wrong = sharing * max(s - first_outer, 0.0) + opening * s
    away = place + wrong + tilt * (math.hypot(x, z) + wrong) + roll * (abs(x) + wrong)
    return _from(_from(middle, normal, -x), forward, -z), away
