"""Growth and refinement of an asymptotically optimal search."""

import math

from anatomy.kernels.arcs import arc_to_point
from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from anatomy.kernels.random import uniform
from stages.needle.kernels import tree
from stages.needle.kernels.connections import seen_from, shortest_path
from stages.needle.kernels.proof import MIN_ARC_MM, TINY
from stages.needle.kernels.rrt import goal_from_root, random_arc, sample_between

RANDOM_SHARE = 0.4
"""Share of the iterations that extend a random node by a random arc."""
CHEAPEST_SHARE = 0.5
"""Share of the others that extend the node from which the sample is cheapest; the rest, the nearest one."""

ARC, LEGS = 0, 1
VIA_COLUMNS = 4
SPREADS_MM = (6.0, 2.0, 0.6, 0.2, 0.05, 0.01)
"""Radii of the balls in which a via point is drawn anew, from the size of vessels down."""
DROP_SHARE, ADD_SHARE, OTHER_LEG_SHARE, ALL_SHARE = 0.12, 0.27, 0.37, 0.9
"""Below the first share of all variations a via point is dropped, below the second one is added, below the
third one is reached by the other kind of leg; above the fourth all points are moved, and else a single one.
The values are a free choice: most variations move points, and each kind is frequent."""


@kernel()
def _choose(nodes, count, q, limits, rate, cost_bound):
    """Return the node to extend towards a point, -1 if none may take it.

    With the least cost to the point; if `cost_bound` is finite, the nearest in state and cost
    [HauserZhou2016]: the length to the point, plus what the node costs more than the bound.
    """
    best = math.inf
    chosen = -1
    for m in range(count):
        node = nodes[m]
        pose = tree.pose_of(node)
        rho, h = seen_from(pose, q)
        length = shortest_path(rho, h, limits.kappa, math.pi, limits.max_turn_rad - node[tree.PATH_TURN])
        if not node[tree.PATH_LENGTH] + length <= limits.max_length_mm:
            continue
        if cost_bound < math.inf:
            measure = rate * length + max(node[tree.PATH_COST] - cost_bound, 0.0)
        else:
            measure = rate * length + node[tree.PATH_COST]
        if measure < best:
            best = measure
            chosen = m
    return chosen


@kernel(nogil=True)
def grow_optimal(obstacles, limits, objective, branch, goal, nodes, parents, count, iterations, state, best):
    """Grow a tree in state and cost by up to `iterations` samples, until it has a path cheaper than `best`.

    Points are drawn between start and goal; a tree node goes there by a single arc or by the shortest path
    (arc and straight), whole or up to the longest step; or a random node goes along a random arc, so that
    every sequence of arcs keeps a chance.  Nodes that cannot lead to a cheaper path are refused.
    Parameters and results as those of `stages.needle.kernels.rrt.grow_rrt`.
    """
    start = tree.pose_of(nodes[0])
    count, ends, solved = goal_from_root(
        obstacles, limits, objective, branch, goal, nodes, parents, count, state, best
    )
    if ends:
        return count, 0, solved
    rate = objective.least_rate
    for used in range(iterations):
        if count + tree.ROWS_PER_STEP > nodes.shape[0]:
            return count, used, False
        before = count
        if uniform(state) < RANDOM_SHARE:
            near = int(uniform(state) * count)
            bend, length = random_arc(tree.pose_of(nodes[near]), limits, state)
            if tree.add_arc(
                obstacles, limits, objective, branch, nodes, parents, count, near, bend, length, goal, best
            ):
                count += 1
        else:
            end = tree.within(goal, limits.goal_tolerance_mm, state)
            q, drawn = sample_between(start, end, limits, state)
            bound = math.inf
            if best < math.inf and uniform(state) >= CHEAPEST_SHARE:
                bound = uniform(state) * best
            near = _choose(nodes, count, q, limits, rate, bound) if drawn else -1
            if near < 0:
                continue
            count = _extend(
                obstacles, limits, objective, branch, nodes, parents, count, near, q, goal, best, state
            )
        if count == before:
            continue
        rows = tree.add_goal(
            obstacles, limits, objective, branch, nodes, parents, count, count - 1, goal, best, state
        )
        if rows > count:
            return rows, used + 1, True
    return count, iterations, False


@inner_kernel
def _extend(obstacles, limits, objective, branch, nodes, parents, count, near, q, goal, best, state):
    """Go from a node to a point, by legs or by an arc of at most the longest step; return the new `count`."""
    if uniform(state) < 0.5:
        return tree.add_legs(obstacles, limits, objective, branch, nodes, parents, count, near, q, goal, best)
    length, bend, _turn = arc_to_point(tree.pose_of(nodes[near]), q)
    length = min(length, limits.max_step_mm)
    if bend[0] > limits.kappa or length < MIN_ARC_MM:
        return count
    added = tree.add_arc(
        obstacles, limits, objective, branch, nodes, parents, count, near, bend, length, goal, best
    )
    return count + 1 if added else count


@kernel()
def build(obstacles, limits, objective, branch, goal, nodes, parents, vias, count, best):
    """Lay a path from the root through via points, rows 1 onwards; return the last row, 0 if refused.

    `vias` (N, 4): a point, and whether it is reached by a single ARC or by the LEGS of the shortest path.
    The last one must lie within the goal tolerance.
    """
    last = 0
    for m in range(count):
        q = (vias[m, 0], vias[m, 1], vias[m, 2])
        if vias[m, 3] == ARC:
            length, bend, _turn = arc_to_point(tree.pose_of(nodes[last]), q)
            if length < MIN_ARC_MM or bend[0] > limits.kappa * (1.0 + TINY):
                return 0
            if not tree.add_arc(
                obstacles, limits, objective, branch, nodes, parents, last + 1, last, bend, length, goal, best
            ):
                return 0
            last += 1
        else:
            rows = tree.add_legs(
                obstacles, limits, objective, branch, nodes, parents, last + 1, last, q, goal, best
            )
            if rows == last + 1:
                return 0
            last = rows - 1
    return last


@merged_kernel
def _is_promising(nodes, vias, count, limits, rate, best):
    """Tell whether the path through via points could cost less than `best`, by its length alone."""
    total = nodes[0, tree.PATH_COST]
    pose = tree.pose_of(nodes[0])
    for m in range(count):
        dx = vias[m, 0] - pose[0]
        dy = vias[m, 1] - pose[1]
        dz = vias[m, 2] - pose[2]
        total += rate * math.sqrt(dx * dx + dy * dy + dz * dz)
        pose = (vias[m, 0], vias[m, 1], vias[m, 2], 0.0, 0.0, 1.0)
    return total < best


@merged_kernel
def _mutate(vias, trial, count, goal, limits, state):
    """Write a variation of via points to `trial`; return how many.  The last one stays within the goal
    tolerance."""
    for m in range(count):
        for n in range(VIA_COLUMNS):
            trial[m, n] = vias[m, n]
    kind = uniform(state)
    spread = SPREADS_MM[int(uniform(state) * len(SPREADS_MM))]
    m = int(uniform(state) * count)
    if kind < DROP_SHARE and count > 1:
        m = min(m, count - 2)
        for k in range(m, count - 1):
            for n in range(VIA_COLUMNS):
                trial[k, n] = trial[k + 1, n]
        return count - 1
    if kind < ADD_SHARE and count + 1 < trial.shape[0]:
        for k in range(count, m, -1):
            for n in range(VIA_COLUMNS):
                trial[k, n] = trial[k - 1, n]
        share = uniform(state)
        for n in range(3):
            before = trial[m - 1, n] if m > 0 else goal[n]
            trial[m, n] = share * before + (1.0 - share) * trial[m + 1, n]
        trial[m, 3] = ARC if uniform(state) < 0.5 else LEGS
        count += 1
        if m == 0:
            # A new first via point is drawn from a ball of this radius at least: its centre lies between the
            # next one and the goal, not near the start.
            spread = max(spread, 2.0)
    elif kind < OTHER_LEG_SHARE:
        trial[m, 3] = LEGS if trial[m, 3] == ARC else ARC
        return count
    every = kind > ALL_SHARE
    for k in range(count):
        if k != m and not every:
            continue
        x, y, z = tree.within((trial[k, 0], trial[k, 1], trial[k, 2]), spread, state)
        trial[k, 0], trial[k, 1], trial[k, 2] = x, y, z
    last = count - 1
    dx = trial[last, 0] - goal[0]
    dy = trial[last, 1] - goal[1]
    dz = trial[last, 2] - goal[2]
    missing = math.sqrt(dx * dx + dy * dy + dz * dz)
    allowed = limits.goal_tolerance_mm * (1.0 - TINY)
    scale = allowed / missing if missing > allowed else 1.0
    trial[last, 0] = goal[0] + scale * dx
    trial[last, 1] = goal[1] + scale * dy
    trial[last, 2] = goal[2] + scale * dz
    return count


@kernel(nogil=True)
def refine(obstacles, limits, objective, branch, goal, nodes, parents, vias, count, tries, state, best):
    """Vary the via points of a path at random and keep what is cheaper; return count, cost, improvements.

    Here the start is fixed, a leg may be an arc and a straight line, and the end may be anywhere within the
    goal tolerance.  A planner that varies the start too needs a local search of another kind.

    `vias` (N, 4) holds the path and gets the best one; rows of `nodes` but the root are scratch.
    """
    trial = vias.copy()
    rate = objective.least_rate
    improved = 0
    for _ in range(tries):
        number = _mutate(vias, trial, count, goal, limits, state)
        if not _is_promising(nodes, trial, number, limits, rate, best):
            continue
        if 2 * number + 1 > nodes.shape[0]:
            continue
        last = build(obstacles, limits, objective, branch, goal, nodes, parents, trial, number, best)
        if last == 0 or not nodes[last, tree.PATH_COST] < best:
            continue
        best = nodes[last, tree.PATH_COST]
        count = number
        improved += 1
        for m in range(count):
            for n in range(VIA_COLUMNS):
                vias[m, n] = trial[m, n]
    return count, best, improved
