"""A proof by boxes that no deployment has a target in its needle's workspace.

What all deployments of a box have in common follows from the one in its middle and from bounds of how far the
others differ.  A box that cannot be ruled out is halved; see docs/explanation/unreachable.md.

`cones` (N, 7) holds tree points, LPS mm; for the tips that have one of them as the nearest, the middle of the
directions that they may have; and the greatest angle (rad) from it.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from anatomy.kernels.compiling import inner_kernel
from lungaccess.reachability.kernels.blocked import no_tip_near, sweep_slope, tips_blocked, tubes_blocked
from lungaccess.reachability.kernels.deployment_boxes import (
    BOX_COLUMNS,
    EAST,
    HALF,
    INNER,
    NORTH,
    OUTER,
    PLACE_X,
    PLACE_Y,
    PLACE_Z,
    ROTATION,
    SIDES,
    SPARE_MM,
    place_of,
    target_seen,
    tubes_of,
    turned_vector,
)
from stages.needle.infeasibility.kernels import escape_depth
from stages.tube.kernels import (
    CURVED_LENGTH,
    INNER_CURVATURE,
    MAX_PROTRUSION,
    MAX_SWEEP,
    OVERLAP_CURVATURE,
    lateral_sweep,
    planar_point,
)

RULED_OUT, UNDECIDED, TOO_MANY = 1, 2, 3

INSERTION_STEP_MM = 0.5
"""Of the outer tube, in the table of greatest insertions."""
LEAST_TIP_MM, LEAST_VIEW_MM = 0.25, 0.5
"""A box in which tips, and the target as they see it, differ by less is not halved."""
FOLLOWED_MM = 8.0
"""The path of the tubes is looked at where their tips differ by less."""
MOST_WAITING = 4000
"""Boxes that may wait: each is halved depth first, so that a few dozen wait at a time."""


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
def _away_from_point(cones, m, place):
    return math.sqrt(
        (place[0] - cones[m, 0]) ** 2 + (place[1] - cones[m, 1]) ** 2 + (place[2] - cones[m, 2]) ** 2
    )


@inner_kernel
def _may_look(cones, place, away, forward, tilt):
    """Tell whether a tip within `away` of a place may look to within `tilt` of a direction."""
    nearest = np.inf
    for m in range(len(cones)):
        nearest = min(nearest, _away_from_point(cones, m, place))
    for m in range(len(cones)):
        cosine = forward[0] * cones[m, 3] + forward[1] * cones[m, 4] + forward[2] * cones[m, 5]
        may_look = math.acos(min(max(cosine, -1.0), 1.0)) - tilt <= cones[m, 6]
        if may_look and _away_from_point(cones, m, place) <= nearest + 2.0 * away + SPARE_MM:
            return True
    return False


@inner_kernel
def tips_may_be(environment, frame, cones, box):
    """Tell whether a tip of the scope may be in a box: its lumen is wide enough, and it looks ahead."""
    place, away = place_of(frame, box)
    if no_tip_near(environment, place, away):
        return False
    forward = turned_vector(frame, box[EAST], box[NORTH], 0.0, 0.0, 1.0)
    tilt = math.hypot(box[HALF + EAST], box[HALF + NORTH])
    return _may_look(cones, place, away, forward, tilt)


@inner_kernel
def _outside_workspace(limits, seen, sums):
    """Tell whether no tip of a box has the target in its workspace; `seen`, `sums`: of `target_seen`."""
    _pose, rho, ahead, size, moved, second = seen
    spare = limits.goal_tolerance_mm + SPARE_MM
    radius = 1.0 / limits.kappa
    if math.hypot(rho, ahead) - moved - spare > limits.max_length_mm:
        return True
    forward_only = limits.max_angle_rad <= 0.5 * math.pi
    if not forward_only and limits.max_turn_rad > math.pi:
        return False  # A needle that may turn so much comes to every point.
    depth = escape_depth(rho, ahead, radius)
    if forward_only:
        depth = min(depth, ahead)
    if depth + moved + spare < 0.0:
        return True
    if math.hypot(size + sums[0], sums[1]) + second + spare < radius:
        return True
    return forward_only and ahead + sums[2] + second + spare < 0.0


@inner_kernel
def may_reach(environment, tubes, insertions, limits, target, frame, cones, box, sums, costs):
    """Tell whether a deployment of a box may be one with the target in its workspace: False if none can.

    Returns that, and how far tips, and the target as they see it, may differ from the middle ones, mm.
    """
    if not _insertions_exist(tubes, insertions, box) or not tips_may_be(environment, frame, cones, box):
        return False, 0.0, 0.0
    seen = target_seen(tubes, limits.kappa, target, frame, box, sums, costs)
    if _outside_workspace(limits, seen, sums):
        return False, 0.0, 0.0
    family = tubes_of(tubes, frame, box)
    blocked, away = tips_blocked(environment, tubes, limits, seen, family, box)
    if blocked or (away <= FOLLOWED_MM and tubes_blocked(environment, tubes, family, box)):
        return False, away, seen[4]
    _add_tip_costs(tubes, family, box, costs)
    return True, away, seen[4]


@inner_kernel
def _add_tip_costs(tubes, family, box, costs):
    """Add half of what each side displaces the tip."""
    _middle, _forward, _normal, bounds, _outer, _inner = family
    x, z = planar_point(tubes, box[OUTER], box[INNER], box[INNER])
    for m in (PLACE_X, PLACE_Y, PLACE_Z):
        costs[m] += 0.5 * box[HALF + m]
    costs[EAST] += 0.5 * box[HALF + EAST] * math.hypot(x, z)
    costs[NORTH] += 0.5 * box[HALF + NORTH] * math.hypot(x, z)
    costs[ROTATION] += 0.5 * box[HALF + ROTATION] * abs(x)
    costs[OUTER] += 0.5 * bounds[3] * max(box[INNER] - box[OUTER], 0.0)
    costs[INNER] += 0.5 * box[HALF + INNER]


@inner_kernel
def _halve(boxes, row, costs):
    """Halve a box on the side that costs most; the second half becomes the row after it."""
    side = 0
    for m in range(1, SIDES):
        if costs[m] > costs[side]:
            side = m
    for n in range(BOX_COLUMNS):
        boxes[row + 1, n] = boxes[row, n]
    half = 0.5 * boxes[row, HALF + side]
    boxes[row, HALF + side] = boxes[row + 1, HALF + side] = half
    boxes[row, side] -= half
    boxes[row + 1, side] += half


@inner_kernel
def _begin(boxes, tubes, longest, wide, places):
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
        for m in range(3):
            box[PLACE_X + m] = 0.5 * (places[0, m] + places[1, m])
            box[HALF + PLACE_X + m] = 0.5 * (places[1, m] - places[0, m])
        waiting += 1
    return waiting


@numba.njit(cache=True, nogil=True)
def rule_out(environment, tubes, insertions, limits, target, frame, places, cones, wide, most, boxes):
    """Try to rule out all deployments from one piece of the airway.

    Parameters
    ----------
    environment, frame, cones
        See the module.
    tubes : (N_TUBES,) float64
    limits : Limits
    insertions : (N,) float64
        See `greatest_insertions`.
    target : (3,) float64
        LPS mm.
    places : (2, 3) float64
        Least and greatest coordinates of the places of tips along the rows of `frame`, mm.
    wide : float
        Greatest angle (rad) from the axis in `frame` to where a tip may look.
    most : int
        Boxes to look at.
    boxes : (MOST_WAITING, BOX_COLUMNS) float64
        Workspace of the boxes that wait; the first is left as the one that could not be ruled out.

    Returns
    -------
    tuple of (int, int)
        RULED_OUT, UNDECIDED (a box too small to halve is left) or TOO_MANY, and how many boxes were looked
        at.
    """
    sums, costs = np.zeros(3), np.zeros(SIDES)
    there = (target[0], target[1], target[2])
    waiting = _begin(boxes, tubes, np.max(insertions), wide, places)
    looked = 0
    while waiting > 0:
        row = waiting - 1
        looked += 1
        may, away, moved = may_reach(
            environment, tubes, insertions, limits, there, frame, cones, boxes[row], sums, costs
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
