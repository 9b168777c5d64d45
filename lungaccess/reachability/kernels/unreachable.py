"""A proof by boxes that no deployment has a target in its needle's workspace; see docs/unreachable.md.

What all deployments of a box have in common follows from the one in its middle and from bounds of how far the
others differ.  A box that cannot be ruled out is halved.

`cones` (N, 4) is, for a tip between two knots, the middle of what it may look to and the angle (rad) from it.
`scene` is the tuple (corner fields of the distance to lumen, to lumen that may be left, to what tubes keep
clear of; depth in the lumen; distance to what the needle may pass before the target; labels; their
geometry; that of the depth; bits of what tubes keep clear of; by how much a bound of these fields may fall
short of the distance, mm).
"""

from __future__ import annotations

import math

import numba
import numpy as np

from anatomy.kernels.compiling import inner_kernel
from anatomy.kernels.field import distance_bound, exact_distance
from anatomy.kernels.labels import LUMEN
from lungaccess.reachability.kernels.deployment_boxes import (
    BOX_COLUMNS,
    EAST,
    FIRST_KNOT,
    HALF,
    INNER,
    LAST_KNOT,
    NORTH,
    OUTER,
    PLACE,
    ROTATION,
    SIDES,
    SPARE_MM,
    heading,
    sample_of,
    target_seen,
    tubes_of,
    turned_vector,
)
from stages.needle.infeasibility.kernels import escape_depth
from stages.tube.kernels import (
    CURVED_LENGTH,
    INNER_CURVATURE,
    INNER_RADIUS,
    MARGIN,
    MAX_PROTRUSION,
    MAX_SWEEP,
    OUTER_RADIUS,
    OVERLAP_CURVATURE,
    lateral_sweep,
    planar_point,
)

RULED_OUT, UNDECIDED, TOO_MANY = 1, 2, 3

UNNOTICED_MM = 0.05
"""A tube that is farther than this from all lumen has left it noticeably; see `deployment.march`."""
FIRST_LOOK_MM, FARTHEST_LOOK_MM = 5.0, 40.0
"""The path of the needle is looked at from so far ahead of the tip on, as long as it is known so well."""
INSERTION_STEP_MM = 0.5
"""Of the outer tube, in the table of greatest insertions."""
LEAST_TIP_MM, LEAST_VIEW_MM = 0.25, 0.5
"""A box in which tips, and the target as they see it, differ by less is not halved."""
FOLLOWED_MM = 8.0
"""The path of the tubes is looked at where their tips differ by less."""
LOOSE_SWEEP_MM = 0.3
"""The sweep of a box is looked at where it is known so well."""
EXACT_BELOW_MM = 1.0
"""Where tubes of a box differ by less, distances to hazards and lumen are taken exactly."""
LEAST_STEP_MM, GREATEST_STEP_MM = 0.05, 4.0
"""Of samples; the least is no less than the step of `deployment.march` where it leaves the lumen."""
ROOM = 4000
"""Boxes that may wait."""


@inner_kernel
def _insertions_exist(tubes, insertions, box):
    """Tell whether a box holds insertions that are possible and sweep little."""
    outer, inner = box[OUTER], box[INNER]
    low_outer, high_outer = outer - box[HALF + OUTER], outer + box[HALF + OUTER]
    low_inner = inner - box[HALF + INNER]
    if low_outer > inner + box[HALF + INNER] or low_inner - high_outer > tubes[MAX_PROTRUSION]:
        return False
    last = len(insertions) - 1
    first = min(max(int(low_outer / INSERTION_STEP_MM), 0), last)
    longest = 0.0
    for m in range(first, min(int(high_outer / INSERTION_STEP_MM), last) + 1):
        longest = max(longest, insertions[m])
    return low_inner <= longest


@inner_kernel
def _may_look(cones, first, last, forward, tilt):
    """Tell whether a tip of the piece may look to within `tilt` of a direction."""
    for m in range(first, last):
        cosine = forward[0] * cones[m, 0] + forward[1] * cones[m, 1] + forward[2] * cones[m, 2]
        if math.acos(min(max(cosine, -1.0), 1.0)) - tilt <= cones[m, 3]:
            return True
    return False


@inner_kernel
def _outside_workspace(limits, seen, sums):
    """Tell whether no tip of a box has the target in its workspace; `seen`, `sums`: of `target_seen`."""
    _pose, rho, ahead, size, moved, second = seen
    spare = limits.goal_tolerance_mm + SPARE_MM
    radius = 1.0 / limits.kappa
    forward_only = limits.max_angle_rad <= 0.5 * math.pi
    depth = escape_depth(rho, ahead, radius)
    if forward_only:
        depth = min(depth, ahead)
    if depth + moved + spare < 0.0 or math.hypot(rho, ahead) - moved - spare > limits.max_length_mm:
        return True
    if math.hypot(size + sums[0], sums[1]) + second + spare < radius:
        return True
    return forward_only and ahead + sums[2] + second + spare < 0.0


@inner_kernel
def _tips_blocked(scene, tubes, limits, seen, family, box):
    """Tell whether all tips are in the lumen or blocked ahead, and how far tips are from the middle."""
    _lumen, _allowed, _hazards, depth, freed, _labels, geometry, depth_geometry, _bits, _loss = scene
    pose, rho, ahead, _size, _moved, _second = seen
    _middle, _forward, _normal, bounds, _outer, _inner = family
    _place, tilt, roll, sharing, _first_outer, opening = bounds
    half_inner = box[HALF + INNER]
    _point, away = sample_of(tubes, family, box[INNER])
    away += half_inner
    if distance_bound(depth, depth_geometry, pose[0], pose[1], pose[2]) > away:
        return True, away
    spare = limits.goal_tolerance_mm + SPARE_MM
    exempt = limits.exempt_mm
    if distance_bound(freed, geometry, pose[0], pose[1], pose[2]) > away + exempt + spare:
        return True, away
    most = max(abs(tubes[INNER_CURVATURE]), abs(tubes[OVERLAP_CURVATURE]))
    turned = sharing + opening + most * half_inner
    angle = turned + tilt + roll * min(abs(math.sin(heading(tubes, box[OUTER], box[INNER]))) + turned, 1.0)
    far = math.hypot(rho, ahead)
    length = max(FIRST_LOOK_MM, exempt)
    while length < far - away - spare:
        around = away + length * angle + 0.5 * limits.kappa * length * length
        if around > FARTHEST_LOOK_MM:
            break
        x, y, z = pose[0] + length * pose[3], pose[1] + length * pose[4], pose[2] + length * pose[5]
        if distance_bound(freed, geometry, x, y, z) > around:
            return True, away
        length += around
    return False, away


@inner_kernel
def _lacking(scene, point, away, required):
    """Return how much clearance all tubes lack that pass within `away` of a point, mm.

    Below 0 if some may lack none; then no tube that goes on from there lacks any for as many mm.
    """
    _lumen, _allowed, hazards, _depth, _freed, labels, geometry, _depth_geometry, bits, loss = scene
    gap = distance_bound(hazards, geometry, point[0], point[1], point[2]) + away
    if gap >= required or away >= EXACT_BELOW_MM:
        return required - gap - loss
    exact, label = exact_distance(labels, geometry, point[0], point[1], point[2], bits, -1, required)
    return required - (exact if label != 0 else required) - away


@inner_kernel
def _is_out(scene, point, away):
    """Tell whether all tubes that pass within `away` of a point are noticeably out of every lumen there."""
    lumen, _allowed, _hazards, _depth, _freed, labels, geometry, _depth_geometry, _bits, loss = scene
    required = away + UNNOTICED_MM
    bound = distance_bound(lumen, geometry, point[0], point[1], point[2])
    if bound > required or bound + loss < required or away >= EXACT_BELOW_MM:
        return bound > required
    _exact, label = exact_distance(labels, geometry, point[0], point[1], point[2], LUMEN, -1, required)
    return label == 0


@inner_kernel
def _way_blocked(scene, tubes, family, box):
    """Tell whether all tubes of a box leave no airway, or one that they must not leave, or meet a hazard.

    A tube leaves between the last sample that is in the lumen for all of the box and the first that is
    outside for all; there and beyond it keeps clear of hazards, and out of every lumen.
    """
    lumen, allowed, _hazards, depth, _freed, _labels, geometry, depth_geometry, _bits, _loss = scene
    outer, inner = box[OUTER], box[INNER]
    half_outer, half_inner = box[HALF + OUTER], box[HALF + INNER]
    most = max(abs(tubes[INNER_CURVATURE]), abs(tubes[OVERLAP_CURVATURE]))
    loose = (half_outer + half_inner) * sweep_slope(most * tubes[CURVED_LENGTH])
    sweep = 0.0
    if loose < LOOSE_SWEEP_MM and inner > tubes[CURVED_LENGTH]:
        sweep = max(lateral_sweep(tubes, min(outer, inner), inner) - loose, 0.0)
    shortest, longest = max(inner - half_inner, 0.0), inner + half_inner
    may_leave = meets = out = False
    s = 0.0
    while True:
        point, away = sample_of(tubes, family, s)
        step = min(max(away, LEAST_STEP_MM), GREATEST_STEP_MM)
        radius = tubes[OUTER_RADIUS] if s <= outer - half_outer else tubes[INNER_RADIUS]
        lacking = _lacking(scene, point, away, radius + tubes[MARGIN] + sweep)
        deep = distance_bound(depth, depth_geometry, point[0], point[1], point[2]) - away
        if out:
            if s <= shortest and (deep > 0.0 or lacking > SPARE_MM):
                return True
            to_lumen = distance_bound(lumen, geometry, point[0], point[1], point[2])
            step = max(step, min(-lacking, to_lumen))
        else:
            to_allowed = distance_bound(allowed, geometry, point[0], point[1], point[2])
            may_here = to_allowed <= away + step + UNNOTICED_MM
            meets_here = lacking > step
            if deep > 0.0 and s <= shortest:
                may_leave, meets = may_here, meets_here
            else:
                may_leave, meets = may_leave or may_here, meets and meets_here
            out = _is_out(scene, point, away)
            if out and (not may_leave or meets or (lacking > SPARE_MM and s <= shortest)):
                return True
            if deep > step:
                step = deep
        if s >= longest:
            return not may_leave
        s = min(s + step, longest)


@inner_kernel
def sweep_slope(bend):
    """Return how fast the lateral sweep may change with an insertion, mm a mm; `bend` (rad) is curvature x
    length.

    The sweep is the distance of two points: the tip when it first got there, and the body of the final
    shape.  Where the tip is sampled moves with the insertion by at most as much; the first point moves by at
    most 1 + `bend` with it, the second by 1; and the final shape at a fixed place changes by at most `bend`
    with each insertion, the first by `bend` with the outer.
    """
    return 2.0 + 3.0 * bend


@inner_kernel
def may_reach(scene, tubes, insertions, limits, target, frame, knots, cones, box, sums, costs):
    """Tell whether a deployment of a box may be one with the target in its workspace: False if none can.

    Returns that, and how far tips, and the target as they see it, may differ from the middle ones, mm.
    """
    if not _insertions_exist(tubes, insertions, box):
        return False, 0.0, 0.0
    forward = turned_vector(frame, box[EAST], box[NORTH], 0.0, 0.0, 1.0)
    tilt = math.hypot(box[HALF + EAST], box[HALF + NORTH])
    if not _may_look(cones, int(box[FIRST_KNOT]), int(box[LAST_KNOT]), forward, tilt):
        return False, 0.0, 0.0
    seen = target_seen(tubes, limits.kappa, target, frame, knots, box, sums, costs)
    if _outside_workspace(limits, seen, sums):
        return False, 0.0, 0.0
    family = tubes_of(tubes, knots, frame, box)
    blocked, away = _tips_blocked(scene, tubes, limits, seen, family, box)
    if blocked or (away <= FOLLOWED_MM and _way_blocked(scene, tubes, family, box)):
        return False, away, seen[4]
    _add_tip_costs(tubes, family, box, costs)
    return True, away, seen[4]


@inner_kernel
def _add_tip_costs(tubes, family, box, costs):
    """Add half of what each side displaces the tip."""
    _middle, _forward, _normal, bounds, _outer, _inner = family
    x, z = planar_point(tubes, box[OUTER], box[INNER], box[INNER])
    costs[PLACE] += 0.5 * bounds[0]
    costs[EAST] += 0.5 * box[HALF + EAST] * math.hypot(x, z)
    costs[NORTH] += 0.5 * box[HALF + NORTH] * math.hypot(x, z)
    costs[ROTATION] += 0.5 * box[HALF + ROTATION] * abs(x)
    costs[OUTER] += 0.5 * bounds[3] * max(box[INNER] - box[OUTER], 0.0)
    costs[INNER] += 0.5 * box[HALF + INNER]


@inner_kernel
def _halve(boxes, row, costs):
    """Halve a box on the side that costs most; the second half becomes the row after it."""
    side = 0
    for m in range(1, HALF):
        if costs[m] > costs[side]:
            side = m
    for n in range(BOX_COLUMNS):
        boxes[row + 1, n] = boxes[row, n]
    first, last = boxes[row, FIRST_KNOT], boxes[row, LAST_KNOT]
    if costs[PLACE] > costs[side] and last - first > 1.5:
        middle = np.floor(0.5 * (first + last))
        boxes[row, LAST_KNOT] = boxes[row + 1, FIRST_KNOT] = middle
        return
    half = 0.5 * boxes[row, HALF + side]
    boxes[row, HALF + side] = boxes[row + 1, HALF + side] = half
    boxes[row, side] -= half
    boxes[row + 1, side] += half


@inner_kernel
def _begin(boxes, tubes, longest, wide, n_knots):
    """Write the boxes that hold everything, up to the curved length and beyond; return how many they are."""
    curved = min(tubes[CURVED_LENGTH], longest)
    waiting = 0
    for part in range(2):
        low, high = (0.0, curved) if part == 0 else (curved, longest)
        if high <= low:
            continue
        box = boxes[waiting]
        for n in range(BOX_COLUMNS):
            box[n] = 0.0
        box[OUTER] = box[HALF + OUTER] = 0.5 * longest
        box[INNER] = 0.5 * (low + high)
        box[HALF + INNER] = 0.5 * (high - low)
        box[HALF + EAST] = box[HALF + NORTH] = wide
        box[HALF + ROTATION] = math.pi
        box[LAST_KNOT] = n_knots - 1
        waiting += 1
    return waiting


@numba.njit(cache=True, nogil=True)
def rule_out(scene, tubes, insertions, limits, target, frame, knots, cones, wide, most, boxes):
    """Try to rule out all deployments from one piece of the airway.

    Parameters
    ----------
    scene, frame, knots, cones
        See the module.
    tubes, limits : (N_TUBES,), (N_LIMITS,) float64
    insertions : (N,) float64
        See `greatest_insertions`.
    target : (3,) float64
        LPS mm.
    wide : float
        Greatest angle (rad) from the axis in `frame` to where a tip may look.
    most : int
        Boxes to look at.
    boxes : (ROOM, BOX_COLUMNS) float64
        Room for boxes that wait; the first is left as the one that could not be ruled out.

    Returns
    -------
    tuple of (int, int)
        RULED_OUT, UNDECIDED (a box too small to halve is left) or TOO_MANY, and how many boxes were looked
        at.
    """
    sums, costs = np.zeros(3), np.zeros(SIDES)
    there = (target[0], target[1], target[2])
    waiting = _begin(boxes, tubes, np.max(insertions), wide, len(knots))
    looked = 0
    while waiting > 0:
        row = waiting - 1
        looked += 1
        may, away, moved = may_reach(
            scene, tubes, insertions, limits, there, frame, knots, cones, boxes[row], sums, costs
        )
        if not may:
            waiting -= 1
            continue
        small = away < LEAST_TIP_MM and moved < LEAST_VIEW_MM
        if small or looked >= most or waiting + 1 > len(boxes) - 1:
            for n in range(BOX_COLUMNS):
                boxes[0, n] = boxes[row, n]
            return (UNDECIDED if small else TOO_MANY), looked
        _halve(boxes, row, costs)
        waiting += 1
    return RULED_OUT, looked


@numba.njit(cache=True, nogil=True)
def greatest_insertions(tubes, longest, spacing, insertions):
    """Find how far the inner tube may come out before it sweeps sideways too far.

    Parameters
    ----------
    tubes : (N_TUBES,) float64
    longest : float
        Greatest insertion at all, mm.
    spacing : float
        Of the insertions that are tried; what lies between is bounded, mm.
    insertions : (N,) float64
        `insertions[m]` receives a length, mm, that is at least the greatest allowed one with the outer tube
        at m INSERTION_STEP_MM to (m + 1) INSERTION_STEP_MM.
    """
    curved = tubes[CURVED_LENGTH]
    most = max(abs(tubes[INNER_CURVATURE]), abs(tubes[OVERLAP_CURVATURE]))
    slope = sweep_slope(most * curved)
    for m in range(len(insertions)):
        greatest = min(curved, longest)
        tried = int(math.ceil(INSERTION_STEP_MM / spacing))
        for n in range(tried):
            outer = (m + (n + 0.5) / tried) * INSERTION_STEP_MM
            inner = longest
            while inner > max(greatest, outer - spacing):
                over = lateral_sweep(tubes, min(outer, inner), inner) - tubes[MAX_SWEEP]
                over -= 0.5 * slope * spacing
                if over <= 0.0:
                    greatest = inner
                    break
                inner -= max(over / slope, 0.25 * spacing)
        insertions[m] = min(greatest + spacing, longest)
