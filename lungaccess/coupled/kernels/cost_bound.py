"""Lower bounds of the cost of every path of a needle from a box of deployments to a target.

docs/explanation/cost_bound.md derives them.  A box is a row of `BOX_COLUMNS` float64: a range of places of
the scope tip along a motion (samples FIRST to LAST of a row of tips), of the rotation of the tubes, and of
both insertions (middles and half widths); and where the paths cross a sphere halfway to the target, as a
rotation vector (rad) from the straight line, with half widths; a half width below 0 is no such range.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from anatomy.kernels.compiling import inner_kernel
from anatomy.kernels.field import UNITS_PER_MM, distance_bound
from stages.needle.kernels import CLEARANCE_FLOOR_MM
from stages.tube.kernels import (
    CORNER_MM,
    CURVED_LENGTH,
    INNER_CURVATURE,
    INNER_RADIUS,
    MARGIN,
    MAX_EXTENSION,
    MAX_SWEEP,
    OUTER_RADIUS,
    OVERLAP_CURVATURE,
    insertions_exist,
    planar_point,
)

BOUND, TIP, FIRST, LAST, ROTATION, OUTER, INNER, ACROSS, UP = range(9)
HALF_ROTATION, HALF_OUTER, HALF_INNER, HALF_ACROSS, HALF_UP = range(9, 14)
AWAY, WIDE, LOSS, SIDES = 14, 15, 16, 6
BOX_COLUMNS = LOSS + SIDES
"""`AWAY` is how far tips are from the middle one at most, mm, and `WIDE` the greatest angle (rad) of that
rotation vector; from `LOSS` on stands what each side costs, mm: place, rotation, outer, inner, and the two
sides of the rotation vector."""

SPARE = 1e-6
"""For rounding, mm and rad."""
ROUNDING = 1e-4
"""Share by which distance transforms are made smaller before they are rounded down; they have less."""
LARGEST_SINE = 0.99
"""Of half the turn of an arc over a line; paths over longer ones do not lie near it."""
COST_STEP_MM = 0.7
"""Longest step of the bounds of an integral where both ends are known well."""
TUBE_STEP_MM = 0.5
"""Step at which tubes of a small box are looked at."""
FOLLOWED_MM = 8.0
"""The path of the tubes is looked at where their tips differ by less."""


class BoundEnvironment(NamedTuple):
    """What the bounds look at.

    Parameters
    ----------
    obstacles : (ni + 1, nj + 1, nk + 1) uint16
        Corner field of the distance to all obstacles.
    airway, vessels, outside, fissures : (ni + 1, nj + 1, nk + 1) uint16
        Those of single structures; `vessels` again where fissures are no obstacles.
    geometry : (3, 6) float64
    depth, depth_geometry
        Corner field of the depth in the lumen.
    kappa, max_length_mm, goal_tolerance_mm : float
        Limits of the needle; `max_length_mm` is no more than half a circle of the curvature `kappa`.
    per_clearance, per_mm : float
        The objective: weight of 1 / clearance, and least cost of a mm by all else.
    """

    obstacles: np.ndarray
    airway: np.ndarray
    vessels: np.ndarray
    outside: np.ndarray
    fissures: np.ndarray
    geometry: np.ndarray
    depth: np.ndarray
    depth_geometry: np.ndarray
    kappa: float
    max_length_mm: float
    goal_tolerance_mm: float
    per_clearance: float
    per_mm: float


@inner_kernel
def most_distance(field, geometry, x, y, z):
    """Return a distance in mm that the true distance never exceeds; inf off the grid and next to its border.

    Let X be the corner nearest to the point p, and o the obstacle point nearest to X.  No obstacle point
    is nearer to another corner than that corner's distance, which bounds how far o lies beyond X.
    """
    u = geometry[0, 0] * x + geometry[0, 1] * y + geometry[0, 2] * z + geometry[0, 3]
    v = geometry[1, 0] * x + geometry[1, 1] * y + geometry[1, 2] * z + geometry[1, 3]
    w = geometry[2, 0] * x + geometry[2, 1] * y + geometry[2, 2] * z + geometry[2, 3]
    u -= 0.5 - geometry[0, 5]
    v -= 0.5 - geometry[1, 5]
    w -= 0.5 - geometry[2, 5]
    ni, nj, nk = field.shape
    if not (1.0 <= u < ni - 2 and 1.0 <= v < nj - 2 and 1.0 <= w < nk - 2):
        return math.inf
    i, j, k = int(u + 0.5), int(v + 0.5), int(w + 0.5)
    here = (float(field[i, j, k]) * (1.0 + ROUNDING) + 2.0) / UNITS_PER_MM
    square = here * here
    total = beside = 0.0
    for axis in range(3):
        if axis == 0:
            off = u - i
            other = field[i - 1 if off > 0.0 else i + 1, j, k]
        elif axis == 1:
            off = v - j
            other = field[i, j - 1 if off > 0.0 else j + 1, k]
        else:
            off = w - k
            other = field[i, j, k - 1 if off > 0.0 else k + 1]
        share, size2 = abs(off), geometry[axis, 4]
        there = float(other) / UNITS_PER_MM
        total += share * (square - there * there + size2)
        beside += share * share * size2
    return min(math.sqrt(max(square + total + beside, 0.0)), here + math.sqrt(beside))


@inner_kernel
def _angle_at(kappa, length):
    """Return the angle (rad) from a chord to the arc of greatest curvature over it, at most a right one."""
    return math.asin(min(0.5 * kappa * length, 1.0))


@inner_kernel
def between(environment, begin, end, begin_off, end_off):
    """Bound the cost of every path from near one point to near another from below.

    Parameters
    ----------
    begin, end : tuple of 3 float
        LPS mm.
    begin_off, end_off : float
        How far the path may begin and end from them, mm.
    """
    x, y, z = end[0] - begin[0], end[1] - begin[1], end[2] - begin[2]
    far = math.sqrt(x * x + y * y + z * z)
    least = far - begin_off - end_off
    if least <= 0.0:
        return 0.0
    kappa = environment.kappa
    most = far + begin_off + end_off
    if 0.5 * kappa * most > LARGEST_SINE:
        return least * environment.per_mm
    steps = int(math.ceil(far / max(COST_STEP_MM, 0.25 * (begin_off + end_off))))
    lean = _angle_at(kappa, most)
    step, reach_step = far / steps, most / steps
    total = 0.0
    last = most_distance(environment.obstacles, environment.geometry, begin[0], begin[1], begin[2])
    for n in range(steps):
        share = (n + 1.0) / steps
        clear = most_distance(
            environment.obstacles,
            environment.geometry,
            begin[0] + share * x,
            begin[1] + share * y,
            begin[2] + share * z,
        )
        # The mean of the least of what the two ends allow, since clearance is 1-Lipschitz.
        low, high = min(last, clear), min(max(last, clear), min(last, clear) + step)
        last = clear
        middle = 0.5 * (low + high) + 0.25 * (step - (high - low) ** 2 / step)
        # The greatest distance from the straight line: a concave function of the way, below its tangent.
        turn = _angle_at(kappa, (n + 0.5) * reach_step)
        half = 0.5 * max(lean - turn, 0.0)
        slope = abs(2.0 * math.sin(half) - math.tan(turn) * math.cos(half))
        aside = 2.0 * (n + 0.5) * reach_step * math.sin(half) + 0.5 * reach_step * slope
        aside += begin_off + (n + 0.5) / steps * (end_off - begin_off)
        if low + aside < CLEARANCE_FLOOR_MM:
            middle += CLEARANCE_FLOOR_MM  # Of max(clearance, floor), whose inverse is convex.
        total += 1.0 / max(middle + aside, CLEARANCE_FLOOR_MM)
    return least * (environment.per_clearance * total / steps + environment.per_mm)


@inner_kernel
def _across(direction):
    """Return two unit vectors across a unit vector, and across each other."""
    x, y, z = direction
    if abs(x) < 0.6:
        size = math.sqrt(y * y + z * z)
        one = (0.0, z / size, -y / size)
    else:
        size = math.sqrt(x * x + y * y)
        one = (y / size, -x / size, 0.0)
    other = (y * one[2] - z * one[1], z * one[0] - x * one[2], x * one[1] - y * one[0])
    return one, other


@inner_kernel
def _pose_of(tips, rates, box):
    """Return the middle scope tip of a box, its tubes' normal, and how far others may be from it.

    That is: point, direction, normal; by how many mm the places and by what angle the frames differ.
    """
    n, m = int(box[TIP]), int(0.5 * (box[FIRST] + box[LAST]))
    tip = tips[n, m]
    base = (tip[0], tip[1], tip[2])
    forward = (tip[3], tip[4], tip[5])
    binormal = (
        forward[1] * tip[8] - forward[2] * tip[7],
        forward[2] * tip[6] - forward[0] * tip[8],
        forward[0] * tip[7] - forward[1] * tip[6],
    )
    c, s = math.cos(box[ROTATION]), math.sin(box[ROTATION])
    normal = (c * tip[6] + s * binormal[0], c * tip[7] + s * binormal[1], c * tip[8] + s * binormal[2])
    samples = max(box[LAST] - m, m - box[FIRST])
    return base, forward, normal, samples * rates[n, 0], samples * rates[n, 1]


@inner_kernel
def _point_of(tubes, pose, box, s):
    """Return the point of the middle tubes at arc length `s`, and how far from it those of others are, mm."""
    base, forward, normal, place, tilt = pose
    outer, half_inner = box[OUTER], box[HALF_INNER]
    longest = box[INNER] + half_inner
    bent = longest > tubes[CURVED_LENGTH]
    x, z = planar_point(tubes, outer, box[INNER] if bent else longest, s)
    unlike = abs(tubes[OVERLAP_CURVATURE] - tubes[INNER_CURVATURE])
    most = max(abs(tubes[OVERLAP_CURVATURE]), abs(tubes[INNER_CURVATURE]))
    wrong = unlike * box[HALF_OUTER] * max(s - max(outer - box[HALF_OUTER], 0.0), 0.0)
    if bent:
        wrong += most * half_inner * s
    away = place + wrong + tilt * (math.hypot(x, z) + wrong) + box[HALF_ROTATION] * (abs(x) + wrong)
    point = (
        base[0] + x * normal[0] + z * forward[0],
        base[1] + x * normal[1] + z * forward[1],
        base[2] + x * normal[2] + z * forward[2],
    )
    return point, away


@inner_kernel
def _least_sweep(tubes, box):
    """Return a sideways sweep (mm) that no deployment of a box goes below; see `stages.tube.lateral_sweep`.

    It looks at the point of the body that is the first to go straight, for which the insertions change shapes
    by no more than the length beyond their bend times the change of its angle.
    """
    curved, inner, outer = tubes[CURVED_LENGTH], box[INNER], min(box[OUTER], box[INNER])
    if inner - box[HALF_INNER] <= curved:
        return 0.0
    before_x, before_z = planar_point(tubes, min(curved, outer), curved, curved)
    after_x, after_z = planar_point(tubes, outer, inner, curved)
    unlike = abs(tubes[OVERLAP_CURVATURE] - tubes[INNER_CURVATURE])
    most = max(abs(tubes[OVERLAP_CURVATURE]), abs(tubes[INNER_CURVATURE]))
    loose = most * curved * box[HALF_INNER]
    loose += 2.0 * unlike * curved * (box[HALF_OUTER] + max(box[OUTER] - outer, 0.0))
    return max(math.hypot(after_x - before_x, after_z - before_z) - loose - SPARE, 0.0)


@inner_kernel
def _hazard_distance(environment, point, needed):
    """Return how far a vessel, the outside or a fissure is at most, mm; or any number of `needed` or more."""
    geometry = environment.geometry
    x, y, z = point
    near = most_distance(environment.obstacles, geometry, x, y, z)
    if near >= needed:
        return near
    near = most_distance(environment.vessels, geometry, x, y, z)
    near = min(near, most_distance(environment.outside, geometry, x, y, z))
    return min(near, most_distance(environment.fissures, geometry, x, y, z))


@inner_kernel
def _tubes_blocked(environment, tubes, pose, box, sweep):
    """Tell whether all tubes of a box meet a hazard or a lumen beyond their airway, or end in a lumen."""
    shortest = max(box[INNER] - box[HALF_INNER], 0.0)
    left = False
    s = 0.0
    while True:
        point, away = _point_of(tubes, pose, box, s)
        x, y, z = point
        deep = distance_bound(environment.depth, environment.depth_geometry, x, y, z)
        step = max(TUBE_STEP_MM, away)
        if left:
            radius = tubes[OUTER_RADIUS] if s <= box[OUTER] - box[HALF_OUTER] else tubes[INNER_RADIUS]
            needed = radius + tubes[MARGIN] + sweep - away
            hazard = _hazard_distance(environment, point, needed)
            if hazard < needed or deep > away + SPARE:
                return True
            step = max(step, hazard - needed - away)
        else:
            out = distance_bound(environment.airway, environment.geometry, x, y, z)
            left = out > away + CORNER_MM + SPARE
            step = max(step, deep - away)
        if s >= shortest:
            return deep > away + 2.0 * box[HALF_INNER] + SPARE
        s = min(s + step, shortest)


@inner_kernel
def bound_box(environment, tubes, insertions, tips, rates, target, box):
    """Bound the cost of every path from the deployments of a box from below; inf if there is none.

    Parameters
    ----------
    environment : BoundEnvironment
    tubes : (N_TUBES,) float64
    insertions : (N,) float64
        See `stages.tube.kernels.greatest_insertions`.
    tips : (S, K, 9) float64
        Rows of scope tips, LPS mm.
    rates : (S, 2) float64
        By how many mm the place, and by what angle (rad) the frame may change from a sample to the next.
    target : tuple of 3 float
    box : (BOX_COLUMNS,) float64
        AWAY, WIDE and LOSS are filled.
    """
    kappa = environment.kappa
    outer, half_outer, inner, half_inner = box[OUTER], box[HALF_OUTER], box[INNER], box[HALF_INNER]
    if not insertions_exist(tubes, insertions, outer, half_outer, inner, half_inner):
        return math.inf
    sweep = _least_sweep(tubes, box)
    if sweep > tubes[MAX_SWEEP] or inner - half_inner > tubes[MAX_EXTENSION]:
        return math.inf
    pose = _pose_of(tips, rates, box)
    _base, forward, normal, place, tilt = pose
    tip, away = _point_of(tubes, pose, box, inner)
    away += half_inner
    box[AWAY] = away
    ahead = (target[0] - tip[0], target[1] - tip[1], target[2] - tip[2])
    far = math.sqrt(ahead[0] * ahead[0] + ahead[1] * ahead[1] + ahead[2] * ahead[2])
    off = environment.goal_tolerance_mm + SPARE
    if far - away - off > environment.max_length_mm:
        return math.inf
    straight = max(inner - tubes[CURVED_LENGTH], 0.0)
    shared = min(max(outer - straight, 0.0), inner - straight)
    heading = tubes[OVERLAP_CURVATURE] * shared + tubes[INNER_CURVATURE] * (inner - straight - shared)
    sine, cosine = math.sin(heading), math.cos(heading)
    tangent = (
        sine * normal[0] + cosine * forward[0],
        sine * normal[1] + cosine * forward[1],
        sine * normal[2] + cosine * forward[2],
    )
    unlike = abs(tubes[OVERLAP_CURVATURE] - tubes[INNER_CURVATURE])
    most = max(abs(tubes[OVERLAP_CURVATURE]), abs(tubes[INNER_CURVATURE]))
    turned = unlike * half_outer + most * half_inner
    swing = tilt + turned + box[HALF_ROTATION] * min(abs(sine) + turned, 1.0)
    if _leans_too_far(kappa, tangent, ahead, swing, away + off):
        return math.inf
    if away < FOLLOWED_MM and _tubes_blocked(environment, tubes, pose, box, sweep):
        return math.inf
    x, z = planar_point(tubes, outer, inner, inner)
    box[LOSS] = place + tilt * math.hypot(x, z)
    box[LOSS + 1] = box[HALF_ROTATION] * abs(x)
    box[LOSS + 2] = unlike * half_outer * max(inner - outer + half_outer, 0.0)
    box[LOSS + 3] = half_inner * (1.0 + (most * inner if inner + half_inner > tubes[CURVED_LENGTH] else 0.0))
    box[LOSS + 5] = 0.0
    most_far = far + away + off
    box[WIDE] = max(_angle_at(kappa, most_far) - _angle_at(kappa, 0.5 * most_far), 0.0)
    if box[HALF_ACROSS] < 0.0 or far <= away + off or 0.5 * kappa * most_far > LARGEST_SINE:
        box[LOSS + 4] = 0.06 * kappa * far * far
        return between(environment, target, tip, off, away)
    return _by_halfway(environment, target, tip, tangent, swing, off, away, box)


@inner_kernel
def _leans_too_far(kappa, tangent, ahead, swing, off):
    """Tell whether no path of the curvature `kappa` leads as far as `ahead`, an offset known to `off` mm.

    `swing` (rad) is how well the direction at the start is known.
    """
    x, y, z = ahead
    far = math.sqrt(x * x + y * y + z * z)
    if far <= off:
        return False
    cosine = (tangent[0] * x + tangent[1] * y + tangent[2] * z) / far
    lean = math.acos(min(max(cosine, -1.0), 1.0)) - swing - math.asin(min(off / far, 1.0))
    return lean > _angle_at(kappa, far + off) + SPARE


@inner_kernel
def _by_halfway(environment, target, tip, tangent, swing, off, away, box):
    """Bound the cost of paths that cross the sphere halfway to the target in a range; see the module."""
    kappa = environment.kappa
    x, y, z = tip[0] - target[0], tip[1] - target[1], tip[2] - target[2]
    far = math.sqrt(x * x + y * y + z * z)
    angle = math.hypot(box[ACROSS], box[UP])
    half = math.hypot(box[HALF_ACROSS], box[HALF_UP])
    if angle - half > box[WIDE] + SPARE:
        return math.inf
    direction = (x / far, y / far, z / far)
    one, other = _across(direction)
    a, b = (box[ACROSS] / angle, box[UP] / angle) if angle > 0.0 else (1.0, 0.0)
    c, s = math.cos(angle), math.sin(angle)
    reach = 0.5 * far
    via = (
        target[0] + reach * (c * direction[0] + s * (a * one[0] + b * other[0])),
        target[1] + reach * (c * direction[1] + s * (a * one[1] + b * other[1])),
        target[2] + reach * (c * direction[2] + s * (a * one[2] + b * other[2])),
    )
    unsure = reach * half + 0.5 * away + 1.5 * off
    # The path has to get there from the tip's direction.
    ahead = (via[0] - tip[0], via[1] - tip[1], via[2] - tip[2])
    if _leans_too_far(kappa, tangent, ahead, swing, unsure + away):
        return math.inf
    box[LOSS + 4] = 0.5 * reach * box[HALF_ACROSS]
    box[LOSS + 5] = 0.5 * reach * box[HALF_UP]
    total = between(environment, target, via, off, unsure)
    return total + between(environment, via, tip, unsure, away)
