"""Lower bounds of the cost of every path of a needle from a box of deployments to a target.

docs/theory/cost_bound.md derives them; boxes are those of `deployment_box`.
"""

import math
from typing import NamedTuple

import numpy as np

from anatomy.kernels.compiling import inner_kernel, merged_kernel
from anatomy.kernels.field import most_distance
from lungaccess.planning.coupled.kernels.box_of_tubes import (
    HALF,
    INNER,
    OUTER,
    ROTATION,
    SPARE,
    cross,
    dot,
    has_insertions,
    minus,
    norm,
    seen_target,
    times,
    tip_moves,
    tip_of,
)
from lungaccess.planning.coupled.kernels.cost_to_go import LARGEST_SINE, CostToGo, angle_at, cost_from
from lungaccess.planning.coupled.kernels.deployment_box import (
    ACROSS,
    AWAY,
    LOSS,
    SIDES,
    UP,
    WIDE,
    TubeSurroundings,
    least_sweep,
    tubes_at,
    tubes_blocked,
)
from stages.needle.kernels import CLEARANCE_FLOOR_MM
from stages.tube.kernels import CORNER_MM, MAX_EXTENSION, MAX_SWEEP

COST_STEP_MM = 0.7
"""Longest step of the bounds of an integral where both ends are known well."""
KNOWN_MM = 1.0
"""Between tip and target paths are looked at as a whole where tips differ by less."""
HALFWAY_LOSS = 0.1
"""How much it counts to know paths halfway, beside knowing their tips."""
FIRST_STEP_MM = 1.0
"""Step along the tangent of a tip that is known to less; twice as much otherwise."""
LONGEST_START_MM, MOST_UNSURE_MM = 30.0, 12.0
"""Paths are followed along the tangent so far, and where they are known so well."""
FOLLOWED_MM = 8.0
"""The path of the tubes is looked at where their tips differ by less."""


class BoundEnvironment(NamedTuple):
    """What the bounds look at.

    Args:
        obstacles ((ni + 1, nj + 1, nk + 1) uint16): Corner field of the distance to all obstacles.
        geometry: (3, 6) float64.
        kappa, max_length_mm, goal_tolerance_mm: Limits of the needle; `max_length_mm` is no more than half a
            circle of the curvature `kappa`.
        per_clearance, per_mm: The objective: weight of 1 / clearance, and least cost of a mm by all else.
        required_mm, exempt_mm: Clearance that the needle keeps, beyond so much of its length.
        togo: What paths still cost.
    """

    obstacles: np.ndarray
    geometry: np.ndarray
    surroundings: TubeSurroundings
    kappa: float
    max_length_mm: float
    goal_tolerance_mm: float
    per_clearance: float
    per_mm: float
    required_mm: float
    exempt_mm: float
    togo: CostToGo


@inner_kernel
def between(environment, begin, end, begin_off, end_off):
    """Bound the cost of every path from below that begins and ends near two points, LPS mm.

    `begin_off` and `end_off` (mm) are how far from them it may begin and end.
    """
    far = math.sqrt((end[0] - begin[0]) ** 2 + (end[1] - begin[1]) ** 2 + (end[2] - begin[2]) ** 2)
    return as_far_as(environment, begin, end, begin_off, end_off, far - begin_off - end_off)


@inner_kernel
def as_far_as(environment, begin, end, begin_off, end_off, least):
    """Bound the cost as `between`, of paths whose ends are known to be at least so many mm apart."""
    x, y, z = end[0] - begin[0], end[1] - begin[1], end[2] - begin[2]
    far = math.sqrt(x * x + y * y + z * z)
    if least <= 0.0:
        return 0.0
    kappa = environment.kappa
    most = far + begin_off + end_off
    if 0.5 * kappa * most > LARGEST_SINE:
        return least * environment.per_mm
    steps = int(math.ceil(far / max(COST_STEP_MM, 0.25 * (begin_off + end_off))))
    lean = angle_at(kappa, most)
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
        turn = angle_at(kappa, (n + 0.5) * reach_step)
        half = 0.5 * max(lean - turn, 0.0)
        slope = abs(2.0 * math.sin(half) - math.tan(turn) * math.cos(half))
        aside = 2.0 * (n + 0.5) * reach_step * math.sin(half) + 0.5 * reach_step * slope
        aside += begin_off + (n + 0.5) / steps * (end_off - begin_off)
        if low + aside < CLEARANCE_FLOOR_MM:
            middle += CLEARANCE_FLOOR_MM  # Of max(clearance, floor), whose inverse is convex.
        total += 1.0 / max(middle + aside, CLEARANCE_FLOOR_MM)
    return least * (environment.per_clearance * total / steps + environment.per_mm)


@merged_kernel
def along_tangent(environment, tip, tangent, swing, away, far, limit):
    """Bound the cost of every path from near a tip, which follows its direction at first, then any way.

    It ends early once the bound is as high as the limit; it is inf if there is no path.

    Args:
        swing, away (float): How well direction (rad) and place (mm) are known.
        far (float): Every path is at least so long, mm.
    """
    kappa, exempt = environment.kappa, environment.exempt_mm
    x, y, z = tip
    off = environment.goal_tolerance_mm
    best = cost_from(environment.togo, x, y, z, away + off, exempt)
    step = FIRST_STEP_MM if away < FIRST_STEP_MM else 2.0 * FIRST_STEP_MM
    length = total = 0.0
    unsure = away
    while best < limit and unsure < MOST_UNSURE_MM and length + step < min(far, LONGEST_START_MM):
        middle, end = length + 0.5 * step, length + step
        before, unsure = unsure, away + end * (swing + 0.5 * kappa * end)
        clear = most_distance(
            environment.obstacles,
            environment.geometry,
            x + middle * tangent[0],
            y + middle * tangent[1],
            z + middle * tangent[2],
        )
        if middle > exempt and clear + unsure < environment.required_mm:
            return math.inf
        # Mean clearances: how far paths are from the tangent is a convex function of their length.
        clear = max(clear, CLEARANCE_FLOOR_MM) + 0.25 * step + 0.5 * (before + unsure)
        total += step * (environment.per_clearance / clear + environment.per_mm)
        length = end
        rest = cost_from(
            environment.togo,
            x + length * tangent[0],
            y + length * tangent[1],
            z + length * tangent[2],
            unsure + off,
            max(exempt - length, 0.0),
        )
        best = max(best, total + rest)
    return best


@inner_kernel
def bound_box(environment, tubes, insertions, tips, target, limit, box, same_tubes):
    """Bound the cost of every path from the deployments of a box from below; inf if there is none.

    Tubes are not looked at where the bound is `limit` or more without.

    Args:
        insertions ((N,) float64): See `stages.tube.kernels.greatest_insertions`.
        tips ((S, 9) float64): Scope tips, LPS mm.
        box ((BOX_COLUMNS,) float64): AWAY, WIDE and LOSS are filled.
        same_tubes (bool): Whether a box with the same tubes was looked at before, whose bound counts as well:
            then this is that of the paths alone.
    """
    kappa = environment.kappa
    if not has_insertions(tubes, insertions, box):
        return math.inf
    sweep = least_sweep(tubes, box)
    if sweep > tubes[MAX_SWEEP] or box[INNER] - box[HALF + INNER] > tubes[MAX_EXTENSION]:
        return math.inf
    family = tubes_at(tubes, tips, box)
    tip, tangent, away, swing = tip_of(tubes, family, box)
    box[AWAY] = away
    ahead = minus(target, tip, 1.0)
    far = norm(ahead)
    off = environment.goal_tolerance_mm + SPARE
    if far - away - off > environment.max_length_mm or leans_too_far(
        kappa, tangent, ahead, swing, away + off
    ):
        return math.inf
    seen = seen_target(tubes, kappa, target, family, tip, tangent, box)
    least = max(least_distance(kappa, seen, off), far - away - off)
    if least == math.inf or least > environment.max_length_mm:
        return math.inf
    ahead_cost = 0.0
    if not same_tubes:
        ahead_cost = along_tangent(environment, tip, tangent, swing, away, far - away - off, limit)
    if ahead_cost >= limit:
        return math.inf
    box[LOSS : LOSS + SIDES] = 0.0
    box[LOSS + ROTATION], box[LOSS + OUTER], box[LOSS + INNER] = tip_moves(tubes, family, box)
    most_far = far + away + off
    box[WIDE] = max(angle_at(kappa, most_far) - angle_at(kappa, 0.5 * most_far), 0.0)
    bound = ahead_cost
    if away < KNOWN_MM:
        if box[HALF + ACROSS] < 0.0 or far <= away + off or 0.5 * kappa * most_far > LARGEST_SINE:
            box[LOSS + ACROSS] = HALFWAY_LOSS * 0.06 * kappa * far * far
            bound = max(bound, as_far_as(environment, target, tip, off, away, least))
        else:
            bound = max(bound, _by_halfway(environment, target, tip, tangent, swing, off, away, least, box))
    if same_tubes or bound >= limit or away >= FOLLOWED_MM:
        return bound
    return math.inf if tubes_blocked(environment.surroundings, tubes, family, box, sweep) else bound


@merged_kernel
def _by_halfway(environment, target, tip, tangent, swing, off, away, least, box):
    """Bound the cost of paths that cross the sphere halfway to the target in a range; see the module."""
    kappa = environment.kappa
    back = minus(tip, target, 1.0)
    far = norm(back)
    angle = math.hypot(box[ACROSS], box[UP])
    half = math.hypot(box[HALF + ACROSS], box[HALF + UP])
    if angle - half > box[WIDE] + SPARE:
        return math.inf
    direction = times(back, 1.0 / far)
    one = cross(direction, (1.0, 0.0, 0.0) if abs(direction[0]) < 0.6 else (0.0, 0.0, 1.0))
    one = times(one, 1.0 / norm(one))
    other = cross(direction, one)
    a, b = (box[ACROSS] / angle, box[UP] / angle) if angle > 0.0 else (1.0, 0.0)
    c, s = math.cos(angle), math.sin(angle)
    reach = 0.5 * far
    aside = minus(times(one, a), other, -b)
    via = minus(target, minus(times(direction, c), aside, -s), -reach)
    unsure = reach * half + 0.5 * away + 1.5 * off
    # The path has to get there from the tip's direction.
    ahead = minus(via, tip, 1.0)
    if leans_too_far(kappa, tangent, ahead, swing, unsure + away):
        return math.inf
    box[LOSS + ACROSS] = HALFWAY_LOSS * 0.5 * reach * box[HALF + ACROSS]
    box[LOSS + UP] = HALFWAY_LOSS * 0.5 * reach * box[HALF + UP]
    far_via = reach - unsure
    total = as_far_as(environment, target, via, off, unsure, max(0.5 * least - 1.5 * off, far_via - off))
    ahead_via = norm(ahead) - unsure - away
    return total + as_far_as(environment, via, tip, unsure, away, max(0.5 * least - 0.5 * off, ahead_via))


@merged_kernel
def least_distance(kappa, seen, off):
    """Return how far the tips of a box with the target in reach are at least, mm; inf if there is none.

    The target, beside which a needle may end by `off` mm, moves, as the tips see it, with each side of the
    box.  To first order its distance from the middle tip, and from the centre of the tightest circle there,
    change with each in proportion.  The least distance with the target outside of that circle is that of a
    linear program with one condition.
    """
    far = math.hypot(seen.aside, seen.ahead)
    if min(far, seen.size) < CORNER_MM:
        return max(far - seen.moved - off, 0.0)
    second = seen.second + off + SPARE
    sides = (seen.by_rotation, seen.by_outer, seen.by_inner)
    outward = across = nearer = 0.0
    for side in sides:
        part = dot(seen.line, side)
        outward += abs(part)
        across += math.sqrt(max(dot(side, side) - part * part, 0.0))
        nearer += abs(dot(seen.from_tip, side)) / far
    needed = max(1.0 / kappa - second, 0.0)
    needed = math.sqrt(max(needed * needed - across * across, 0.0)) - seen.size
    if needed > outward:
        return math.inf
    best = -nearer
    for at in sides:
        slope = dot(seen.line, at)
        if slope == 0.0:
            continue
        price = dot(seen.from_tip, at) / (far * slope)
        if price <= 0.0:
            continue
        total = price * needed
        for side in sides:
            total -= abs(dot(seen.from_tip, side) / far - price * dot(seen.line, side))
        best = max(best, total)
    return max(far + best - second, 0.0)


@inner_kernel
def leans_too_far(kappa, tangent, ahead, swing, off):
    """Tell whether no path of the curvature `kappa` leads as far as `ahead`, an offset known to `off` mm.

    `swing` (rad) is how well the direction at the start is known.
    """
    x, y, z = ahead
    far = math.sqrt(x * x + y * y + z * z)
    if far <= off:
        return False
    cosine = (tangent[0] * x + tangent[1] * y + tangent[2] * z) / far
    lean = math.acos(min(max(cosine, -1.0), 1.0)) - swing - math.asin(min(off / far, 1.0))
    return lean > angle_at(kappa, far + off) + SPARE
