"""Best-first search over words of arcs and straight pieces, refined step by step [Fu2021, Fu2022].

A *word* is a sequence of *primitives*: pieces of whole steps, straight or arcs of greatest curvature in one
of n directions of bending.  The directions are fixed in a frame that the needle carries along without twist.
A node is the end of a word that is proved clear; from every node the goal is tried, by the shortest path and
by the single arc.  An entry of the queue is a node with a primitive to go on by, or with the level of the
primitives that are to be looked at next; so each is looked at once.
"""

import math

from anatomy.kernels.arcs import pose_on_arc
from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from stages.needle.kernels.connections import seen_from
from stages.needle.kernels.cost import cost_of_arc
from stages.needle.kernels.goal_ball import least_length_from, shortest_into_ball, single_into_ball
from stages.needle.kernels.proof import TINY, blocker_on_arc
from stages.needle.kernels.tree import angle_kept
from stages.needle.search.kernels.resolution_nodes import (
    CLEAR,
    DIRECTION,
    NODE_RANK,
    PARENT,
    PATH_COST,
    PATH_LENGTH,
    PATH_TURN,
    ROUNDING,
    STEPS,
    USELESS,
    WAITING,
    bend_of,
    find_duplicate,
    follow,
    node_pose,
    pop,
    push,
)

# What `best` holds: its last node, then length and bend of each of the two legs from there to the goal.
BEST_NODE, BEST_LEGS = 0, 1
LEG_SIZE = 5
BEST_SIZE = BEST_LEGS + 2 * LEG_SIZE

# What `counts` holds.
NODES, POPS, DUPLICATES, PRUNED, REFUSED, COUNTS = range(6)

# Why the search returns.
SPENT, BETTER, EXHAUSTED, FULL_OF_NODES, FULL_OF_ENTRIES = range(5)


@inner_kernel
def _estimate(nodes, row, rates, goal, limits, reference):
    """Return a cost below which no path within the limits leads by a node to the goal; inf if none does."""
    pose = node_pose(nodes, row)
    ahead = least_length_from(pose, goal, limits, reference, limits.max_turn_rad - nodes[row, PATH_TURN])
    if nodes[row, PATH_LENGTH] + ahead > limits.max_length_mm + TINY:
        return math.inf
    missing = limits.goal_tolerance_mm if ahead > 0.0 else math.hypot(*seen_from(pose, goal))
    return nodes[row, PATH_COST] + rates[0] * ahead + rates[1] * missing


@merged_kernel
def _push_level(
    limits, rates, goal, reference, words, merge, store, queue, state, counts, at, level, f, most
):
    """Push the primitives of a level from node `at`, and as good as the best of them one for the next level.

    Passed over are those from whose end no path within the limits leads to the goal for less than `most`,
    with all longer ones; those longer than a refused one; and, where a cell's poses count as one, those that
    end in the cell of a node that costs no more.  One like the primitive that led to the node is taken only
    if that had the full length, so that each curve is one word.
    """
    nodes, links, proved, seen = store
    fine_mm, rolls, arcs, primitives, first = words
    n_rolls, full, row = rolls.shape[0], arcs.shape[0] - 1, counts[NODES]
    forward = nodes[at, 3] * reference[0] + nodes[at, 4] * reference[1] + nodes[at, 5] * reference[2]
    least = math.cos(limits.max_angle_rad)
    rank = links[at, NODE_RANK] + 1 + level
    barred = links[at, DIRECTION] if links[at, STEPS] < full else -1
    best_estimate = math.inf
    for m in range(first[level], first[level + 1]):
        direction, steps = primitives[m, 0], primitives[m, 1]
        if direction == barred or steps >= proved[at, direction, USELESS]:
            continue
        length = steps * fine_mm
        bend = bend_of(nodes, rolls, limits.kappa, at, direction)
        turn = bend[0] * length
        nodes[row, PATH_LENGTH] = nodes[at, PATH_LENGTH] + length
        nodes[row, PATH_TURN] = nodes[at, PATH_TURN] + turn
        nodes[row, PATH_COST] = nodes[at, PATH_COST] + rates[0] * length
        within = nodes[row, PATH_TURN] <= limits.max_turn_rad + TINY
        # The cosine of an angle falls by no more than the arc turns.
        if within and forward - turn < least:
            within = angle_kept(limits, reference, node_pose(nodes, at), bend, turn)
        estimate = math.inf
        if within:
            follow(nodes, words, bend, at, direction, steps, row)
            estimate = _estimate(nodes, row, rates, goal, limits, reference)
        if estimate >= most:
            counts[PRUNED] += 1
            proved[at, direction, USELESS] = steps
        elif merge[2] and find_duplicate(nodes, seen, merge, n_rolls, row)[1]:
            counts[DUPLICATES] += 1
        else:
            push(queue, state, estimate, at, direction * (full + 1) + steps, rank)
            best_estimate = min(best_estimate, estimate)
    if level + 2 < first.shape[0]:
        f = best_estimate if best_estimate < math.inf else f
        push(queue, state, f, at, -(level + 1), rank + 1)


@inner_kernel
def _add(
    obstacles, limits, objective, rates, branch, goal, reference, words, merge, store, counts, at, primitive,
    rank, most,
):  # fmt: skip
    """Make the node at the end of a proved primitive from node `at`; return its estimate, inf if there is
    none."""
    nodes, links, proved, seen = store
    fine_mm, rolls, arcs = words[0], words[1], words[2]
    n_rolls, full, row = rolls.shape[0], arcs.shape[0] - 1, counts[NODES]
    direction, steps = primitive // (full + 1), primitive % (full + 1)
    if steps >= proved[at, direction, USELESS]:
        return math.inf
    length = steps * fine_mm
    bend = bend_of(nodes, rolls, limits.kappa, at, direction)
    follow(nodes, words, bend, at, direction, steps, row)
    nodes[row, PATH_LENGTH] = nodes[at, PATH_LENGTH] + length
    nodes[row, PATH_TURN] = nodes[at, PATH_TURN] + bend[0] * length
    nodes[row, PATH_COST] = nodes[at, PATH_COST] + rates[0] * length
    slot, duplicate = find_duplicate(nodes, seen, merge, n_rolls, row)
    if duplicate:
        counts[DUPLICATES] += 1
        return math.inf
    pose = node_pose(nodes, at)
    if steps > proved[at, direction, CLEAR]:
        if blocker_on_arc(obstacles, limits, pose, bend, length, nodes[at, PATH_LENGTH], branch) != 0:
            proved[at, direction, USELESS] = steps
            counts[REFUSED] += 1
            return math.inf
        proved[at, direction, CLEAR] = steps
    cost = cost_of_arc(obstacles, objective, limits.cost_step_mm, pose, bend, length, at == 0)
    if cost > rates[0] * length:
        nodes[row, PATH_COST] = nodes[at, PATH_COST] + cost
        slot, duplicate = find_duplicate(nodes, seen, merge, n_rolls, row)
        if duplicate:
            counts[DUPLICATES] += 1
            return math.inf
    estimate = _estimate(nodes, row, rates, goal, limits, reference)
    if estimate >= most:
        counts[PRUNED] += 1
        return math.inf
    seen[slot] = row + 1
    links[row, PARENT] = at
    links[row, DIRECTION] = direction
    links[row, STEPS] = steps
    links[row, NODE_RANK] = rank
    for m in range(n_rolls + 1):
        proved[row, m, CLEAR] = 0
        proved[row, m, USELESS] = full + 1
    counts[NODES] += 1
    return estimate


@inner_kernel
def _connect(obstacles, limits, objective, rates, branch, goal, reference, nodes, best, at, cost):
    """Try the goal from a node; keep a path cheaper than `cost` in `best`, and return the least cost.

    A path ends where it first is within the goal tolerance, or goes on to the goal where that costs no more.
    """
    start = node_pose(nodes, at)
    for single in range(2):
        first, first_length, second, second_length, ahead = shortest_into_ball(start, goal, limits)
        if single:
            first, first_length = single_into_ball(start, goal, limits)
            second_length, ahead = 0.0, 0.0
            if first_length == 0.0:
                break
        most = cost * (1.0 - ROUNDING)
        found, total, missing = nodes[at, PATH_COST], math.inf, 0.0
        begun, turn = nodes[at, PATH_LENGTH], nodes[at, PATH_TURN]
        pose, bend, length, is_start = start, first, first_length, at == 0
        for leg in range(3):
            if length > 0.0:
                turn += bend[0] * length
                within = begun + length <= limits.max_length_mm + TINY and turn <= limits.max_turn_rad + TINY
                if not (
                    within
                    and found + rates[0] * length < most
                    and angle_kept(limits, reference, pose, bend, bend[0] * length)
                    and blocker_on_arc(obstacles, limits, pose, bend, length, begun, branch) == 0
                ):
                    break
                paid = cost_of_arc(obstacles, objective, limits.cost_step_mm, pose, bend, length, is_start)
                if leg == 2:
                    if paid <= rates[1] * missing * (1.0 + ROUNDING):
                        total = found + paid
                        second_length += length
                    break
                found += paid
                begun += length
                is_start = False
                pose = pose_on_arc(pose, bend, length)
            bend, length = second, second_length
            if leg == 1:
                rho, h = seen_from(pose, goal)
                missing = math.hypot(rho, h)
                total = found + rates[1] * missing
                if total >= most:
                    break
                length = ahead
        if total < most:
            cost = total
            best[BEST_NODE] = at
            best[BEST_LEGS] = first_length
            best[BEST_LEGS + LEG_SIZE] = second_length
            for m in range(4):
                best[BEST_LEGS + 1 + m] = first[m]
                best[BEST_LEGS + LEG_SIZE + 1 + m] = second[m]
    return cost


@kernel(nogil=True)
def search_words(
    obstacles, limits, objective, rates, branch, goal, reference, words, merge, store, queue, state, counts,
    best, cost, pops,
):  # fmt: skip
    """Go on with the search for up to `pops` entries, or until a cheaper path is found.

    Args:
        obstacles, limits, objective: Obstacles, Limits, ObjectiveArrays.
        rates (tuple of float): Least cost of a mm of path, and what each mm costs by which the path ends
            short of the goal; no more than the former.
        branch (int): Pierced branch, whose wall is exempt at the exit; -1 for none.
        goal: (3,) float64, LPS mm.
        reference ((3,) float64): Direction from which the limit of the angle counts.
        words (tuple): Step in mm; cosine and sine of the n directions of bending, (n, 2) float64; of an arc
            of k steps, (K + 1, 4) float64, its advance along the tangent and towards the bend in mm, cosine
            and sine of its turn; primitives by level, (P, 2) int64, direction and steps, and the first of
            each level and the end, (levels + 1,) int64.
        merge (tuple of float, float, bool): Size of a cell of poses in mm and in components of the tangent;
            whether a node makes each costlier one in its cell superfluous, or only equal ones that are in
            nothing better.
        store (tuple): nodes (N, NODE_COLUMNS) float64, links (N, LINK_COLUMNS) int32, proved (N, n + 1, 2)
            uint8, and the hash table of nodes, row + 1, (H,) int32, with H a power of two and at least 2 N.
        queue, state (tuple, (STATE_SIZE,) int64): See `rank_queue`.
        counts ((COUNTS,) int64): All 0 at first but NODES, 1: row 0 is the start.
        best ((BEST_SIZE,) float64): Gets the best path.
        cost (float): Cost of the best path so far.
        pops (int): The start counts as one.

    Returns:
        reason, cost (int, float): SPENT, BETTER, EXHAUSTED, or which arrays have to grow; cost of the best
            path.
    """
    nodes, entries = store[0], queue[1]
    most_new = words[3].shape[0] + 1
    stop = counts[POPS] + pops
    better = False
    while counts[POPS] < stop and not better:
        # Beside the node that may be made, one row is for what is only looked at.
        if counts[NODES] + 2 > nodes.shape[0]:
            return FULL_OF_NODES, cost
        if state[WAITING] + most_new > entries.shape[0]:
            return FULL_OF_ENTRIES, cost
        most = cost * (1.0 - ROUNDING)
        at, level = counts[NODES] - 1, 0
        if counts[POPS] == 0:
            f = _estimate(nodes, at, rates, goal, limits, reference)
            bend = bend_of(nodes, words[1], limits.kappa, at, words[1].shape[0])
            begun = nodes[at, PATH_LENGTH]
            if blocker_on_arc(obstacles, limits, node_pose(nodes, at), bend, 0.0, begun, branch) != 0:
                f = math.inf
            slot, _duplicate = find_duplicate(nodes, store[3], merge, words[1].shape[0], at)
            store[3][slot] = at + 1
        elif state[WAITING] == 0:
            return EXHAUSTED, cost
        else:
            f, at, primitive, rank = pop(queue, state)
            level = max(-primitive, 0)
            if level > 0:
                f = _estimate(nodes, at, rates, goal, limits, reference)
            if f >= most:
                counts[PRUNED] += 1
                f = math.inf
            elif primitive >= 0:
                f = _add(
                    obstacles, limits, objective, rates, branch, goal, reference, words, merge, store, counts,
                    at, primitive, rank, most,
                )  # fmt: skip
                at = counts[NODES] - 1
        counts[POPS] += 1
        if f == math.inf:
            continue
        if level == 0:
            found = _connect(
                obstacles, limits, objective, rates, branch, goal, reference, nodes, best, at, cost
            )
            better = found < cost
            cost = found
            most = cost * (1.0 - ROUNDING)
        if f < most:
            _push_level(
                limits, rates, goal, reference, words, merge, store, queue, state, counts, at, level, f, most
            )
    return BETTER if better else SPENT, cost
