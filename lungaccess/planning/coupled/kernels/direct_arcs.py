"""Compiled kernels of the coupled search: lower bounds of the cost, and the cost of many direct arcs.

`needle` is a `lungaccess.plans.evaluator.NeedleArrays`.
"""

import math

import numpy as np

from anatomy.kernels.arcs import arc_to_point
from anatomy.kernels.compiling import inner_kernel, kernel
from anatomy.kernels.field import distance_estimate
from stages.needle.kernels import CLEARANCE_FLOOR_MM, blocker_on_arc, cost_of_arc, single_arc_exceeds

PRUNED_BY_BOUND = -2
"""The label of an arc that was not tested for obstacles, because its cost or its lower bound is too high."""
SHORTEST_MM = 1e-6
"""A shorter needle is none: the tubes end at the target, and rounding would decide where it goes."""

# Typed: a kernel is compiled once more for every literal that it is called with.
_FIRST = np.bool_(True)


@inner_kernel
def _clearance_bound(needle, x, y, z):
    """Return a distance in mm that the clearance at a point does not exceed."""
    geometry = needle.obstacles.geometry
    diagonal = math.sqrt(geometry[0, 4] + geometry[1, 4] + geometry[2, 4])
    estimate = distance_estimate(needle.obstacles.clearance, geometry, x, y, z)
    return max(estimate + diagonal, CLEARANCE_FLOOR_MM)


@inner_kernel
def _cost_bound(needle, begin_mm, end_mm, length):
    """Return what any path of `length` mm or more costs at least.

    Clearance is 1-Lipschitz: `s` mm from an end of the path it is at most that at the end, or more, and `s`.
    """
    objective = needle.objective
    cost = objective.length * length
    if objective.inverse_clearance > 0.0:
        middle = min(max(0.5 * (length + end_mm - begin_mm), 0.0), length)
        total = math.log(1.0 + middle / begin_mm) + math.log(1.0 + (length - middle) / end_mm)
        cost += objective.inverse_clearance * total
    return max(cost, objective.least_rate * length)


@kernel(nogil=True)
def cost_bounds(needle, positions, lengths, target, bounds):
    """Fill `bounds` (N,) with the least cost of any path from `positions` (N, 3) to the target.

    The paths are `lengths` (N,) mm long or longer.
    """
    end = _clearance_bound(needle, target[0], target[1], target[2])
    for n in range(positions.shape[0]):
        begin = _clearance_bound(needle, positions[n, 0], positions[n, 1], positions[n, 2])
        bounds[n] = _cost_bound(needle, begin, end, lengths[n])


@kernel(nogil=True)
def evaluate_arcs(needle, positions, tangents, branches, before, target, slack, best, blockers, costs):
    """Evaluate the single arc from each pose to the target, and prove those whose cost is low enough.

    Args:
        before ((N,) float64): What the tubes cost before the arc.
        slack, best (float): Arcs that cost more than `slack` times the cheapest so far, at first `best`, are
            not tested.
        blockers ((N,) int64): Receives 0 for arcs that are proved clear, the label that blocks, -1 where no
            arc keeps the needle's limits or none is needed, or PRUNED_BY_BOUND.
        costs ((N,) float64): Receives estimated costs with those of the tubes, infinite where a lower bound
            was enough.

    Returns:
        float: The cost of the cheapest clear arc, or `best`.
    """
    obstacles, objective, limits = needle.obstacles, needle.objective, needle.limits
    end = _clearance_bound(needle, target[0], target[1], target[2])
    for n in range(positions.shape[0]):
        x, y, z = positions[n]
        tx, ty, tz = tangents[n]
        pose = (x, y, z, tx, ty, tz)
        length, bend, turn = arc_to_point(pose, target)
        costs[n] = math.inf
        if length < SHORTEST_MM or single_arc_exceeds(limits, bend, length, turn):
            blockers[n] = -1
            continue
        bound = before[n] + _cost_bound(needle, _clearance_bound(needle, x, y, z), end, length)
        if bound > slack * best:
            blockers[n] = PRUNED_BY_BOUND
            continue
        arc = cost_of_arc(obstacles, objective, limits.cost_step_mm, pose, bend, length, _FIRST)
        costs[n] = before[n] + arc
        if costs[n] > slack * best:
            blockers[n] = PRUNED_BY_BOUND
            continue
        blockers[n] = blocker_on_arc(obstacles, limits, pose, bend, length, 0.0, branches[n])
        if blockers[n] == 0 and costs[n] < best:
            best = costs[n]
    return best


@inner_kernel
def _strays(one, other, square):
    """Tell whether some point of a line is `square` mm^2 or more, squared, from all points of another."""
    for m in range(one.shape[0]):
        near = False
        for n in range(other.shape[0]):
            dx = one[m, 0] - other[n, 0]
            dy = one[m, 1] - other[n, 1]
            dz = one[m, 2] - other[n, 2]
            if dx * dx + dy * dy + dz * dz < square:
                near = True
                break
        if not near:
            return True
    return False


@kernel(nogil=True)
def choose_separated(lines, order, separation_mm, chosen):
    """Choose lines `(N, M, 3)` one after the other, each separated from all before; return how many.

    Two lines are separated if some point of either is `separation_mm` or more from all points of the other.
    They are looked at in an order `(K,)`, the best first; `chosen` `(C,)` receives at most C.
    """
    square = separation_mm * separation_mm
    count = 0
    for n in order:
        if count == chosen.shape[0]:
            break
        separated = True
        for m in range(count):
            one, other = lines[n], lines[chosen[m]]
            if not (_strays(one, other, square) or _strays(other, one, square)):
                separated = False
                break
        if separated:
            chosen[count] = n
            count += 1
    return count
