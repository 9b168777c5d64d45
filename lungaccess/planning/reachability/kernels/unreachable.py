"""A proof by boxes that no deployment has a target in its needle's workspace.

What all deployments of a box have in common follows from the one in its middle and from bounds of how far the
others differ.  A box that cannot be ruled out is halved; see docs/explanation/unreachable.md.

`cones` (N, 7) holds tree points, LPS mm; for the tips that have one of them as the nearest, the middle of the
directions that they may have; and the greatest angle (rad) from it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from lungaccess.planning.reachability.kernels.blocked import (
    no_tip_near,
    tips_blocked,
    tips_differ,
    tips_in_lumen,
    tubes_blocked,
)
from lungaccess.planning.reachability.kernels.deployment_boxes import (
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
from stages.tube.kernels import CURVED_LENGTH, insertions_exist, planar_point

RULED_OUT, UNDECIDED, TOO_MANY = 1, 2, 3
"""Of a box: no deployment of it reaches; a part too small to halve may; not looked at to the end."""

LEAST_TIP_MM, LEAST_VIEW_MM = 0.25, 0.5
"""A box in which tips, and the target as they see it, differ by less is not halved."""
FOLLOWED_MM = 8.0
"""The path of the tubes is looked at where their tips differ by less."""
MOST_WAITING = 400
"""Boxes that may wait: each is halved depth first, so that a few dozen wait at a time."""


class Pieces(NamedTuple):
    """Pieces of the airway as the kernels take them, see `lungaccess.planning.reachability.tip_places`.

    Parameters
    ----------
    frames : (P, 3, 3) float64
    cones : (N, 7) float64
        Of all pieces, one after the other.
    first_cone : (P + 1,) int64
    """

    frames: np.ndarray
    cones: np.ndarray
    first_cone: np.ndarray


class Found(NamedTuple):
    """What `rule_out` finds of M boxes.

    Parameters
    ----------
    outcome : (M,) uint8
        RULED_OUT, UNDECIDED or TOO_MANY.
    share : (M,) float64
        Share of each that is ruled out.
    looked : (M,) int64
        Boxes looked at for it.
    left : (M, BOX_COLUMNS) float64
        The first part that was left, if any was.
    """

    outcome: np.ndarray
    share: np.ndarray
    looked: np.ndarray
    left: np.ndarray


@inner_kernel
def _insertions_exist(tubes, insertions, box):
    """Tell whether a box holds insertions that are possible and sweep little."""
    outer, inner = box[OUTER], box[INNER]
    return insertions_exist(tubes, insertions, outer, box[HALF + OUTER], inner, box[HALF + INNER])


@inner_kernel
def _away_from_point(cones, m, place):
    return math.sqrt(
        (place[0] - cones[m, 0]) ** 2 + (place[1] - cones[m, 1]) ** 2 + (place[2] - cones[m, 2]) ** 2
    )


@merged_kernel
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
def _outside_workspace(limits, seen, sums, away):
    """Tell whether no tip of a box has the target in its workspace; `seen`, `sums`: of `target_seen`.

    Tips are within `away` mm of the middle one: their distance to the target differs by no more, however
    far they turn.
    """
    _pose, rho, ahead, size, moved, second = seen
    spare = limits.goal_tolerance_mm + SPARE_MM
    radius = 1.0 / limits.kappa
    if math.hypot(rho, ahead) - min(moved, away) - spare > limits.max_length_mm:
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


@merged_kernel
def may_reach(environment, tubes, insertions, limits, target, frame, cones, box, sums, costs):
    """Tell whether a deployment of a box may be one with the target in its workspace: False if none can.

    Returns that, and how far tips, and the target as they see it, may differ from the middle ones, mm.
    """
    if not _insertions_exist(tubes, insertions, box) or not tips_may_be(environment, frame, cones, box):
        return False, 0.0, 0.0
    seen = target_seen(tubes, limits.kappa, target, frame, box, sums, costs)
    family = tubes_of(tubes, frame, box)
    away = tips_differ(tubes, family, box)
    if _outside_workspace(limits, seen, sums, away):
        return False, 0.0, 0.0
    if tips_blocked(environment, tubes, limits, seen, family, box, away) or (
        away <= FOLLOWED_MM and tubes_blocked(environment, tubes, family, box)
    ):
        return False, away, seen[4]
    _add_tip_costs(tubes, family, box, costs)
    return True, away, seen[4]


@inner_kernel
def may_exist(environment, tubes, insertions, frame, cones, box, costs):
    """Tell whether a box may hold a deployment at all, whatever the target: False if it holds none."""
    if not _insertions_exist(tubes, insertions, box) or not tips_may_be(environment, frame, cones, box):
        return False
    family = tubes_of(tubes, frame, box)
    away = tips_differ(tubes, family, box)
    if tips_in_lumen(environment, family, tubes, box, away):
        return False
    if away <= FOLLOWED_MM and tubes_blocked(environment, tubes, family, box):
        return False
    for m in range(SIDES):
        costs[m] = 0.0
    _add_tip_costs(tubes, family, box, costs)
    return True


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
def _measure(box):
    """Return the measure of a box: mm^3 of places, rad^3 of directions and rotations, mm^2 of insertions."""
    product = 1.0
    for m in range(SIDES):
        product *= 2.0 * box[HALF + m]
    return product


@kernel(nogil=True)
def measures(boxes, out):
    """Write the measure of each of N boxes to `out` (N,)."""
    for n in range(len(boxes)):
        out[n] = _measure(boxes[n])


@kernel(nogil=True)
def first_boxes(tubes, longest, wide, places, boxes):
    """Write the boxes that hold everything of a piece of the airway: up to the curved length, and beyond.

    Parameters
    ----------
    tubes : (N_TUBES,) float64
    longest : float
        Greatest insertion, mm.
    wide : float
        Greatest angle (rad) from the axis in `frame` to where a tip may look.
    places : (2, 3) float64
        Least and greatest coordinates of the places of tips along the rows of `frame`, mm.
    boxes : (2, BOX_COLUMNS) float64
        Receives them.

    Returns
    -------
    int
        How many they are.
    """
    curved = min(tubes[CURVED_LENGTH], longest)
    count = 0
    for part in range(2):
        low, high = (0.0, curved) if part == 0 else (curved, longest)
        if high <= low:
            continue
        box = boxes[count]
        box[OUTER] = box[HALF + OUTER] = 0.5 * longest
        box[INNER] = 0.5 * (low + high)
        box[HALF + INNER] = 0.5 * (high - low)
        box[EAST] = box[NORTH] = box[ROTATION] = 0.0
        box[HALF + EAST] = box[HALF + NORTH] = wide
        box[HALF + ROTATION] = math.pi
        for m in range(3):
            box[PLACE_X + m] = 0.5 * (places[0, m] + places[1, m])
            box[HALF + PLACE_X + m] = 0.5 * (places[1, m] - places[0, m])
        count += 1
    return count


@kernel(nogil=True)
def divide(environment, tubes, insertions, pieces, boxes, owners, greatest, parts, part_owners):
    """Halve the boxes that are larger than `greatest`, and keep the halves that may hold a deployment.

    Parameters
    ----------
    environment, tubes, insertions
        See `rule_out`; the target does not count.
    pieces : Pieces
    boxes : (N, BOX_COLUMNS) float64, owners : (N,) int32
        The boxes and the numbers of their pieces.
    greatest : float
        Measure of a box.
    parts : (2 N, BOX_COLUMNS) float64, part_owners : (2 N,) int32
        Receive what is kept.

    Returns
    -------
    int
        How many are kept.
    """
    costs = np.zeros(SIDES)
    pair = np.zeros((2, BOX_COLUMNS))
    kept = 0
    for n in range(len(boxes)):
        frame, cones = _piece_of(pieces, owners[n])
        _copy(boxes[n], pair[0])
        halves = 1
        if _measure(boxes[n]) > greatest:
            if not may_exist(environment, tubes, insertions, frame, cones, pair[0], costs):
                continue
            _halve(pair, 0, costs)
            halves = 2
        for m in range(halves):
            if halves == 1 or may_exist(environment, tubes, insertions, frame, cones, pair[m], costs):
                _copy(pair[m], parts[kept])
                part_owners[kept] = owners[n]
                kept += 1
    return kept


@inner_kernel
def _piece_of(pieces, n):
    return pieces.frames[n], pieces.cones[pieces.first_cone[n] : pieces.first_cone[n + 1]]


@inner_kernel
def _copy(box, to):
    for n in range(BOX_COLUMNS):
        to[n] = box[n]


@kernel(nogil=True)
def rule_out(
    environment, tubes, insertions, limits, target, pieces, boxes, owners, rows, most, to_the_end, found
):
    """Try to rule out all deployments of boxes, each by halving it again and again.

    Parameters
    ----------
    environment : ProofEnvironment
    tubes : (N_TUBES,) float64
    insertions : (N,) float64
        See `stages.tube.kernels.greatest_insertions`.
    limits : Limits
    target : (3,) float64
        LPS mm.
    pieces : Pieces
    boxes : (M, BOX_COLUMNS) float64, owners : (M,) int32
        The boxes and the numbers of their pieces.
    rows : (R,) int64
        Those to look at.
    most : int
        Boxes to look at for each of them.
    to_the_end : bool
        Whether to go on after a part that is too small to halve.
    found : Found
        Its rows receive what is found.
    """
    sums, costs = np.zeros(3), np.zeros(SIDES)
    there = (target[0], target[1], target[2])
    waiting_boxes = np.zeros((MOST_WAITING, BOX_COLUMNS))
    for row in rows:
        frame, cones = _piece_of(pieces, owners[row])
        whole = _measure(boxes[row])
        _copy(boxes[row], waiting_boxes[0])
        waiting, looked = 1, 0
        ruled_out, left = 0.0, False
        while waiting > 0 and looked < most and (to_the_end or not left):
            box = waiting_boxes[waiting - 1]
            looked += 1
            may, away, moved = may_reach(
                environment, tubes, insertions, limits, there, frame, cones, box, sums, costs
            )
            if not may:
                ruled_out += _measure(box) / whole
                waiting -= 1
            elif waiting == MOST_WAITING or (away < LEAST_TIP_MM and moved < LEAST_VIEW_MM):
                if not left:
                    _copy(box, found.left[row])
                left = True
                waiting -= 1
            else:
                _halve(waiting_boxes, waiting - 1, costs)
                waiting += 1
        found.looked[row] = looked
        found.share[row] = ruled_out
        if left:
            found.outcome[row] = UNDECIDED
        elif waiting == 0:
            found.outcome[row], found.share[row] = RULED_OUT, 1.0
        else:
            found.outcome[row] = TOO_MANY
            _copy(waiting_boxes[waiting - 1], found.left[row])
