"""A proof by boxes that no deployment has a target in its needle's workspace.

What all deployments of a box have in common follows from the one in its middle and from bounds of how far the
others differ.  A box that cannot be ruled out is halved; see docs/theory/unreachable.md.

`cones` (N, 7) holds tree points, LPS mm; for the tips that have one of them as the nearest, the middle of the
directions that they may have; and the greatest angle (rad) from it.
"""

import math
from typing import NamedTuple

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from lungaccess.planning.coupled.kernels.box_of_tubes import (
    HALF,
    INNER,
    OUTER,
    ROTATION,
    SPARE,
    costliest,
    has_insertions,
    seen_target,
    split,
    tip_moves,
    tip_of,
)
from lungaccess.planning.reachability.kernels.blocked import (
    no_tip_near,
    tips_blocked,
    tips_in_lumen,
    tubes_blocked,
)
from lungaccess.planning.reachability.kernels.deployment_boxes import (
    BOX_COLUMNS,
    EAST,
    NORTH,
    PLACE_X,
    PLACE_Y,
    PLACE_Z,
    SIDES,
    box_tubes,
    place_of,
    sum_changes,
    turned_vector,
)
from stages.needle.infeasibility.kernels import escape_depth
from stages.tube.kernels import planar_point

RULED_OUT, UNDECIDED, TOO_MANY = 1, 2, 3
"""Of a box: no deployment of it reaches; a part too small to halve may; not looked at to the end."""

LEAST_TIP_MM, LEAST_VIEW_MM = 0.25, 0.5
"""A box in which tips, and the target as they see it, differ by less is not halved."""
FOLLOWED_MM = 8.0
"""The path of the tubes is looked at where their tips differ by less."""
MOST_WAITING = 400
"""Boxes that may wait: each is halved depth first, so that a few dozen wait at a time."""


class Pieces(NamedTuple):
    """Pieces of the airway with their frames `(P, 3, 3)`, see `places_of_tips`.

    `cones` `(N, 7)` are those of all pieces, one after the other, and `first_cone` `(P + 1,)` where each
    begins.
    """

    frames: np.ndarray
    cones: np.ndarray
    first_cone: np.ndarray


class Found(NamedTuple):
    """What `rule_out` finds of M boxes.

    Args:
        outcome ((M,) uint8): RULED_OUT, UNDECIDED or TOO_MANY.
        share ((M,) float64): Share of each that is ruled out.
        looked ((M,) int64): Boxes looked at for it.
        left ((M, BOX_COLUMNS) float64): The first part that was left, if any was.
    """

    outcome: np.ndarray
    share: np.ndarray
    looked: np.ndarray
    left: np.ndarray


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
        if may_look and _away_from_point(cones, m, place) <= nearest + 2.0 * away + SPARE:
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
def _outside_workspace(limits, aside, ahead, size, moved, second, sums, away):
    """Tell whether no tip of a box has the target in its workspace; see `Seen` and `sum_changes`.

    Tips are within `away` mm of the middle one: their distance to the target differs by no more, however
    far they turn.
    """
    spare = limits.goal_tolerance_mm + SPARE
    radius = 1.0 / limits.kappa
    if math.hypot(aside, ahead) - min(moved, away) - spare > limits.max_length_mm:
        return True
    forward_only = limits.max_angle_rad <= 0.5 * math.pi
    if not forward_only and limits.max_turn_rad > math.pi:
        return False  # A needle that may turn so much comes to every point.
    depth = escape_depth(aside, ahead, radius)
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
    if not has_insertions(tubes, insertions, box) or not tips_may_be(environment, frame, cones, box):
        return False, 0.0, 0.0
    family = box_tubes(tubes, frame, box)
    tip, tangent, away, swing = tip_of(tubes, family, box)
    seen = seen_target(tubes, limits.kappa, target, family, tip, tangent, box)
    sum_changes(seen, family, tangent, target, frame, box, sums, costs)
    aside, ahead, size, moved, second = seen.aside, seen.ahead, seen.size, seen.moved, seen.second
    if _outside_workspace(limits, aside, ahead, size, moved, second, sums, away):
        return False, 0.0, 0.0
    far = math.hypot(aside, ahead)
    if tips_blocked(environment, limits, tip, tangent, far, away, swing) or (
        away <= FOLLOWED_MM and tubes_blocked(environment, tubes, family, box)
    ):
        return False, away, moved
    _add_tip_costs(tubes, family, box, costs)
    return True, away, moved


@inner_kernel
def may_exist(environment, tubes, insertions, frame, cones, box, costs):
    """Tell whether a box may hold a deployment at all, whatever the target: False if it holds none."""
    if not has_insertions(tubes, insertions, box) or not tips_may_be(environment, frame, cones, box):
        return False
    family = box_tubes(tubes, frame, box)
    tip, _tangent, away, _swing = tip_of(tubes, family, box)
    if tips_in_lumen(environment, tip, away):
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
    x, z = planar_point(tubes, box[OUTER], box[INNER], box[INNER])
    for m in (PLACE_X, PLACE_Y, PLACE_Z):
        costs[m] += 0.5 * box[HALF + m]
    for m in (EAST, NORTH):
        costs[m] += 0.5 * box[HALF + m] * math.hypot(x, z)
    by_rotation, by_outer, by_inner = tip_moves(tubes, family, box)
    costs[ROTATION] += 0.5 * by_rotation
    costs[OUTER] += 0.5 * by_outer
    costs[INNER] += 0.5 * by_inner


@inner_kernel
def _measure(box):
    """Return the measure of a box: mm^3 of places, rad^3 of directions and rotations, mm^2 of insertions."""
    product = 1.0
    for m in range(SIDES):
        product *= 2.0 * box[HALF + m]
    return product


@kernel(nogil=True)
def divide(environment, tubes, insertions, pieces, boxes, owners, greatest, parts, part_owners):
    """Halve the boxes that are larger than `greatest`, and keep the halves that may hold a deployment.

    Arguments are those of `rule_out`; `parts` and `part_owners`, twice as long as the boxes, receive what is
    kept.

    Returns:
        int: How many are kept.
    """
    costs = np.zeros(SIDES)
    pair = np.zeros((2, BOX_COLUMNS))
    kept = 0
    for n in range(len(boxes)):
        frame, cones = _piece_of(pieces, owners[n])
        pair[0] = boxes[n]
        halves = 1
        if _measure(boxes[n]) > greatest:
            if not may_exist(environment, tubes, insertions, frame, cones, pair[0], costs):
                continue
            split(pair[0], pair[1], costliest(costs, 0, SIDES))
            halves = 2
        for m in range(halves):
            if halves == 1 or may_exist(environment, tubes, insertions, frame, cones, pair[m], costs):
                parts[kept] = pair[m]
                part_owners[kept] = owners[n]
                kept += 1
    return kept


@inner_kernel
def _piece_of(pieces, n):
    return pieces.frames[n], pieces.cones[pieces.first_cone[n] : pieces.first_cone[n + 1]]


@kernel(nogil=True)
def rule_out(
    environment, tubes, insertions, limits, target, pieces, boxes, owners, rows, most, to_the_end, found
):
    """Try to rule out all deployments of boxes, each by halving it again and again.

    Args:
        insertions ((N,) float64): See `stages.tube.kernels.greatest_insertions`.
        target ((3,) float64): LPS mm.
        boxes, owners ((M, BOX_COLUMNS) float64, (M,) int32): The boxes and the numbers of their pieces.
        rows, most ((R,) int64, int): Those to look at, and boxes to look at for each of them.
        to_the_end (bool): Whether to go on after a part that is too small to halve.
        found (Found): Its rows receive what is found.
    """
    sums, costs = np.zeros(3), np.zeros(SIDES)
    there = (target[0], target[1], target[2])
    waiting_boxes = np.zeros((MOST_WAITING, BOX_COLUMNS))
    for row in rows:
        frame, cones = _piece_of(pieces, owners[row])
        whole = _measure(boxes[row])
        waiting_boxes[0] = boxes[row]
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
                    found.left[row] = box
                left = True
                waiting -= 1
            else:
                split(box, waiting_boxes[waiting], costliest(costs, 0, SIDES))
                waiting += 1
        found.looked[row] = looked
        found.share[row] = ruled_out
        if left:
            found.outcome[row] = UNDECIDED
        elif waiting == 0:
            found.outcome[row], found.share[row] = RULED_OUT, 1.0
        else:
            found.outcome[row] = TOO_MANY
            found.left[row] = waiting_boxes[waiting - 1]
