"""Lower bounds of the cost of every path of a needle from a box of deployments to a target.

docs/explanation/cost_bound.md derives them; boxes are those of `deployment_box`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from anatomy.kernels.compiling import inner_kernel, merged_kernel
from anatomy.kernels.field import most_distance
from lungaccess.planning.coupled.kernels.cost_to_go import LARGEST_SINE, CostToGo, angle_at, cost_from
from lungaccess.planning.coupled.kernels.deployment_box import (
    ACROSS,
    AWAY,
    HALF_ACROSS,
    HALF_INNER,
    HALF_OUTER,
    HALF_ROTATION,
    HALF_UP,
    INNER,
    LOSS,
    OUTER,
    SPARE,
    UP,
    WIDE,
    TubeSurroundings,
    least_sweep,
    point_of,
    pose_of,
    tubes_blocked,
)
from lungaccess.planning.coupled.kernels.tips_in_reach import dot, leans_too_far, least_distance
from stages.needle.kernels import CLEARANCE_FLOOR_MM
from stages.tube.kernels import (
    CURVED_LENGTH,
    INNER_CURVATURE,
    MAX_EXTENSION,
    MAX_SWEEP,
    OVERLAP_CURVATURE,
    insertions_exist,
    planar_point,
)

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

    Parameters
    ----------
    obstacles : (ni + 1, nj + 1, nk + 1) uint16
        Corner field of the distance to all obstacles.
    geometry : (3, 6) float64
    surroundings : TubeSurroundings
    kappa, max_length_mm, goal_tolerance_mm : float
        Limits of the needle; `max_length_mm` is no more than half a circle of the curvature `kappa`.
    per_clearance, per_mm : float
        The objective: weight of 1 / clearance, and least cost of a mm by all else.
    required_mm, exempt_mm : float
        Clearance that the needle keeps, beyond so much of its length.
    togo : CostToGo
        What paths still cost.
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
    """Bound the cost of every path from near one point to near another from below.

    Parameters
    ----------
    begin, end : tuple of 3 float
        LPS mm.
    begin_off, end_off : float
        How far the path may begin and end from them, mm.
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

    Parameters
    ----------
    tip, tangent : tuple of 3 float
        LPS mm, and a unit vector.
    swing, away : float
        How well direction (rad) and place (mm) are known.
    far : float
        Every path is at least so long, mm.
    limit : float
        It ends early once the bound is as high.

    Returns
    -------
    float
        inf if there is no path.
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
def bound_box(environment, tubes, insertions, tips, rates, target, limit, box, same_tubes):
    """Bound the cost of every path from the deployments of a box from below; inf if there is none.

    Tubes are not looked at where the bound is `limit` or more without.

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
    limit : float
    box : (BOX_COLUMNS,) float64
        AWAY, WIDE and LOSS are filled.
    same_tubes : bool
        Whether a box with the same tubes was looked at before, whose bound counts as well: then this is that
        of the paths alone.
    """
    kappa = environment.kappa
    outer, half_outer, inner, half_inner = box[OUTER], box[HALF_OUTER], box[INNER], box[HALF_INNER]
    if not insertions_exist(tubes, insertions, outer, half_outer, inner, half_inner):
        return math.inf
    sweep = least_sweep(tubes, box)
    if sweep > tubes[MAX_SWEEP] or inner - half_inner > tubes[MAX_EXTENSION]:
        return math.inf
    pose = pose_of(tips, rates, box)
    _base, forward, normal, place, tilt = pose
    tip, away = point_of(tubes, pose, box, inner)
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
    if leans_too_far(kappa, tangent, ahead, swing, away + off):
        return math.inf
    least = max(least_distance(tubes, kappa, pose, box, tip, tangent, target, off), far - away - off)
    if least == math.inf or least > environment.max_length_mm:
        return math.inf
    ahead_cost = 0.0
    if not same_tubes:
        ahead_cost = along_tangent(environment, tip, tangent, swing, away, far - away - off, limit)
    if ahead_cost >= limit:
        return math.inf
    x, z = planar_point(tubes, outer, inner, inner)
    box[LOSS] = place + tilt * math.hypot(x, z)
    box[LOSS + 1] = box[HALF_ROTATION] * abs(x)
    box[LOSS + 2] = unlike * half_outer * max(inner - outer + half_outer, 0.0)
    box[LOSS + 3] = half_inner * (1.0 + (most * inner if inner + half_inner > tubes[CURVED_LENGTH] else 0.0))
    box[LOSS + 4] = box[LOSS + 5] = 0.0
    most_far = far + away + off
    box[WIDE] = max(angle_at(kappa, most_far) - angle_at(kappa, 0.5 * most_far), 0.0)
    bound = ahead_cost
    if away < KNOWN_MM:
        if box[HALF_ACROSS] < 0.0 or far <= away + off or 0.5 * kappa * most_far > LARGEST_SINE:
            box[LOSS + 4] = HALFWAY_LOSS * 0.06 * kappa * far * far
            bound = max(bound, as_far_as(environment, target, tip, off, away, least))
        else:
            bound = max(bound, _by_halfway(environment, target, tip, tangent, swing, off, away, least, box))
    if same_tubes or bound >= limit or away >= FOLLOWED_MM:
        return bound
    return math.inf if tubes_blocked(environment.surroundings, tubes, pose, box, sweep) else bound


@merged_kernel
def _by_halfway(environment, target, tip, tangent, swing, off, away, least, box):
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
    if leans_too_far(kappa, tangent, ahead, swing, unsure + away):
        return math.inf
    box[LOSS + 4] = HALFWAY_LOSS * 0.5 * reach * box[HALF_ACROSS]
    box[LOSS + 5] = HALFWAY_LOSS * 0.5 * reach * box[HALF_UP]
    far_via = reach - unsure
    total = as_far_as(environment, target, via, off, unsure, max(0.5 * least - 1.5 * off, far_via - off))
    ahead_via = math.sqrt(dot(ahead, ahead)) - unsure - away
    return total + as_far_as(environment, via, tip, unsure, away, max(0.5 * least - 0.5 * off, ahead_via))
