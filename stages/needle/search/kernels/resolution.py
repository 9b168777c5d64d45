"""Best-first search over words of arcs and straight pieces, refined step by step [Fu2021, Fu2022].

A *word* is a sequence of *primitives*: pieces of whole steps, straight or arcs of greatest curvature in one
of n directions of bending.  The directions are fixed in a frame that the needle carries along without twist.
A node is the end of a word that is proved clear; from every node the goal is tried, by the shortest path and
by the single arc.  An entry of the queue is a node with a primitive to go on by, or with the level of the
primitives that are to be looked at next; so each is looked at once.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from anatomy.kernels.arcs import pose_on_arc
from anatomy.kernels.compiling import inner_kernel
from stages.needle.kernels.connections import seen_from
from stages.needle.kernels.cost import cost_of_arc
from stages.needle.kernels.limits import (
    TINY,
)
from stages.needle.kernels.proof import blocker_on_arc
from stages.needle.kernels.tree import angle_kept
from stages.needle.search.kernels.goal_ball import least_length, shortest_into_ball, single_into_ball
from stages.needle.search.kernels.rank_queue import WAITING, pop, push

ROUNDING = 1e-9
"""Share of the best cost by which a path must be cheaper to be looked for."""
# A type of its own: for each literal argument a function would be compiled anew.
_NOT_ACROSS = np.int64(0)

SAME = 1e-6
"""Poses that differ by less than this, in mm and in each component of a direction, are equal."""

# Columns of `nodes`: pose (6), first direction of bending (3), path length, accumulated turn, path cost.
NORMAL = 6
PATH_LENGTH = 9
PATH_TURN = 10
PATH_COST = 11
NODE_COLUMNS = 12

# Columns of `links`: node before, direction and steps of the primitive from there, rank.
PARENT = 0
DIRECTION = 1
STEPS = 2
NODE_RANK = 3
LINK_COLUMNS = 4

# Of a node and a direction, `proved` holds the most steps proved clear, and the least that are of no use.
CLEAR = 0
USELESS = 1

# What `best` holds: its last node, then length and bend of each of the two legs from there to the goal.
BEST_NODE = 0
BEST_LEGS = 1
LEG_SIZE = 5
BEST_SIZE = BEST_LEGS + 2 * LEG_SIZE

# What `counts` holds.
NODES = 0
POPS = 1
DUPLICATES = 2
PRUNED = 3
REFUSED = 4
COUNTS = 5

# Why the search returns.
SPENT = 0
BETTER = 1
EXHAUSTED = 2
FULL_OF_NODES = 3
FULL_OF_ENTRIES = 4


@inner_kernel
def _pose(nodes, at):
    return nodes[at, 0], nodes[at, 1], nodes[at, 2], nodes[at, 3], nodes[at, 4], nodes[at, 5]


@numba.njit(cache=True)
def bend_of(nodes, rolls, kappa, at, direction):
    """Return the bend of a primitive from a node; the direction after the last is straight."""
    tx, ty, tz = nodes[at, 3], nodes[at, 4], nodes[at, 5]
    ux, uy, uz = nodes[at, NORMAL], nodes[at, NORMAL + 1], nodes[at, NORMAL + 2]
    if direction == rolls.shape[0]:
        return 0.0, ux, uy, uz
    c, s = rolls[direction, 0], rolls[direction, 1]
    return (
        kappa,
        c * ux + s * (ty * uz - tz * uy),
        c * uy + s * (tz * ux - tx * uz),
        c * uz + s * (tx * uy - ty * ux),
    )


@inner_kernel
def _follow(nodes, words, bend, at, direction, steps, row):
    """Fill a row with the pose after a primitive, and the first direction of bending carried there."""
    fine_mm, rolls, arcs = words[0], words[1], words[2]
    if direction == rolls.shape[0]:
        length = steps * fine_mm
        for m in range(3):
            nodes[row, m] = nodes[at, m] + length * nodes[at, 3 + m]
            nodes[row, 3 + m] = nodes[at, 3 + m]
            nodes[row, NORMAL + m] = nodes[at, NORMAL + m]
        return
    ahead, aside, c, s = arcs[steps, 0], arcs[steps, 1], arcs[steps, 2], arcs[steps, 3]
    norm2 = 0.0
    for m in range(3):
        tangent, normal = nodes[at, 3 + m], bend[1 + m]
        nodes[row, m] = nodes[at, m] + ahead * tangent + aside * normal
        nodes[row, 3 + m] = c * tangent + s * normal
        # Of the first direction of bending, only its part along the normal turns.
        turned = (c - 1.0) * normal - s * tangent
        nodes[row, NORMAL + m] = nodes[at, NORMAL + m] + rolls[direction, 0] * turned
        norm2 += nodes[row, 3 + m] * nodes[row, 3 + m]
    scale = 1.0 / math.sqrt(norm2)
    dot = 0.0
    for m in range(3):
        nodes[row, 3 + m] *= scale
        dot += nodes[row, 3 + m] * nodes[row, NORMAL + m]
    norm2 = 0.0
    for m in range(3):
        nodes[row, NORMAL + m] -= dot * nodes[row, 3 + m]
        norm2 += nodes[row, NORMAL + m] * nodes[row, NORMAL + m]
    scale = 1.0 / math.sqrt(norm2)
    for m in range(3):
        nodes[row, NORMAL + m] *= scale


@inner_kernel
def _hash(nodes, row, merge, across):
    """Return a number, at least 0, of the cell that holds a node's pose.

    Of the cell across the nearest face instead, along each axis whose bit is set in `across`.
    """
    h = 0
    for m in range(6):
        size = merge[0] if m < 3 else merge[1]
        cell = math.floor(nodes[row, m] / size)
        if across >> m & 1:
            cell += 1.0 if nodes[row, m] / size - cell > 0.5 else -1.0
        h = (h ^ int(cell)) * 0x2545F4914F6CDD1D
        h ^= h >> 29
    return h & 0x7FFFFFFFFFFFFFFF


@inner_kernel
def _at_faces(nodes, row, merge):
    """Return the axes, as bits, along which an equal pose may lie in the next cell."""
    bits = 0
    for m in range(6):
        size = merge[0] if m < 3 else merge[1]
        if math.floor((nodes[row, m] - SAME) / size) != math.floor((nodes[row, m] + SAME) / size):
            bits |= 1 << m
    return bits


@inner_kernel
def _in_one_cell(nodes, a, b, merge):
    for m in range(6):
        size = merge[0] if m < 3 else merge[1]
        if math.floor(nodes[a, m] / size) != math.floor(nodes[b, m] / size):
            return False
    return True


@inner_kernel
def _equal(nodes, a, b, n_rolls):
    """Tell whether two poses are equal up to rounding, and their directions of bending are the same set."""
    for m in range(6):
        if abs(nodes[a, m] - nodes[b, m]) > SAME:
            return False
    tx, ty, tz = nodes[a, 3], nodes[a, 4], nodes[a, 5]
    ux, uy, uz = nodes[a, NORMAL], nodes[a, NORMAL + 1], nodes[a, NORMAL + 2]
    wx, wy, wz = nodes[b, NORMAL], nodes[b, NORMAL + 1], nodes[b, NORMAL + 2]
    c = ux * wx + uy * wy + uz * wz
    s = (ty * uz - tz * uy) * wx + (tz * ux - tx * uz) * wy + (tx * uy - ty * ux) * wz
    rolls = math.atan2(s, c) * n_rolls / (2.0 * math.pi)
    return abs(rolls - round(rolls)) < n_rolls * SAME


@inner_kernel
def _no_worse(nodes, a, b):
    """Tell whether what can follow node `b` can follow node `a` at no more cost; their poses are equal."""
    return (
        nodes[a, PATH_COST] <= nodes[b, PATH_COST] * (1.0 + ROUNDING)
        and nodes[a, PATH_LENGTH] <= nodes[b, PATH_LENGTH] + SAME
        and nodes[a, PATH_TURN] <= nodes[b, PATH_TURN] + SAME
    )


@inner_kernel
def _in_chain(nodes, seen, merge, n_rolls, row, slot):
    """Look through the nodes that the hash table holds from a slot on; see `find_duplicate`."""
    while seen[slot] != 0:
        kept = seen[slot] - 1
        if merge[2]:
            if _in_one_cell(nodes, kept, row, merge):
                return slot, nodes[kept, PATH_COST] <= nodes[row, PATH_COST] * (1.0 + ROUNDING)
        elif _equal(nodes, kept, row, n_rolls):
            if _no_worse(nodes, kept, row):
                return slot, True
            if _no_worse(nodes, row, kept):
                return slot, False
        slot = (slot + 1) & (seen.shape[0] - 1)
    return slot, False


@numba.njit(cache=True)
def find_duplicate(nodes, seen, merge, n_rolls, row):
    """Return the slot of a row in the hash table, and whether a node there makes the row superfluous.

    Else the slot is free, or that of a node which the row makes superfluous.  See `search_words`.
    """
    last = seen.shape[0] - 1
    slot, duplicate = _in_chain(
        nodes, seen, merge, n_rolls, row, _hash(nodes, row, merge, _NOT_ACROSS) & last
    )
    faces = 0 if merge[2] or duplicate else _at_faces(nodes, row, merge)
    for across in range(1, faces + 1):
        if across & ~faces == 0 and not duplicate:
            begin = _hash(nodes, row, merge, across) & last
            duplicate = _in_chain(nodes, seen, merge, n_rolls, row, begin)[1]
    return slot, duplicate


@numba.njit(cache=True)
def rehash(nodes, merge, seen, larger):
    """Move the nodes in the hash table `seen` to a larger one, whose size is a power of two, all 0."""
    last = larger.shape[0] - 1
    for m in range(seen.shape[0]):
        if seen[m] != 0:
            slot = _hash(nodes, seen[m] - 1, merge, _NOT_ACROSS) & last
            while larger[slot] != 0:
                slot = (slot + 1) & last
            larger[slot] = seen[m]


@inner_kernel
def _estimate(nodes, row, rates, goal, limits, reference):
    """Return a cost below which no path within the limits leads by a node to the goal; inf if none does."""
    rho, h = seen_from(_pose(nodes, row), goal)
    cosine = nodes[row, 3] * reference[0] + nodes[row, 4] * reference[1] + nodes[row, 5] * reference[2]
    ahead = least_length(rho, h, limits, cosine, limits.max_turn_rad - nodes[row, PATH_TURN])
    if nodes[row, PATH_LENGTH] + ahead > limits.max_length_mm + TINY:
        return math.inf
    missing = limits.goal_tolerance_mm if ahead > 0.0 else math.hypot(rho, h)
    return nodes[row, PATH_COST] + rates[0] * ahead + rates[1] * missing


@inner_kernel
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
            within = angle_kept(limits, reference, _pose(nodes, at), bend, turn)[0]
        estimate = math.inf
        if within:
            _follow(nodes, words, bend, at, direction, steps, row)
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
    """Make the node at the end of a primitive from node `at`; return its estimate, inf if there is none.

    The primitive is proved clear as a whole, or is the first part of one that was.
    """
    nodes, links, proved, seen = store
    fine_mm, rolls, arcs = words[0], words[1], words[2]
    n_rolls, full, row = rolls.shape[0], arcs.shape[0] - 1, counts[NODES]
    direction, steps = primitive // (full + 1), primitive % (full + 1)
    if steps >= proved[at, direction, USELESS]:
        return math.inf
    length = steps * fine_mm
    bend = bend_of(nodes, rolls, limits.kappa, at, direction)
    _follow(nodes, words, bend, at, direction, steps, row)
    nodes[row, PATH_LENGTH] = nodes[at, PATH_LENGTH] + length
    nodes[row, PATH_TURN] = nodes[at, PATH_TURN] + bend[0] * length
    nodes[row, PATH_COST] = nodes[at, PATH_COST] + rates[0] * length
    slot, duplicate = find_duplicate(nodes, seen, merge, n_rolls, row)
    if duplicate:
        counts[DUPLICATES] += 1
        return math.inf
    pose = _pose(nodes, at)
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
    start = _pose(nodes, at)
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
                    and angle_kept(limits, reference, pose, bend, bend[0] * length)[0]
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


@numba.njit(cache=True, nogil=True)
def search_words(
    obstacles, limits, objective, rates, branch, goal, reference, words, merge, store, queue, state, counts,
    best, cost, pops,
):  # fmt: skip
    """Go on with the search for up to `pops` entries, or until a cheaper path is found.

    Parameters
    ----------
    obstacles, limits, objective : Obstacles, Limits, ObjectiveArrays
    rates : tuple of float
        Least cost of a mm of path, and what each mm costs by which the path ends short of the goal; no
        more than the former.
    branch : int
        Pierced branch, whose wall is exempt at the exit; -1 for none.
    goal : (3,) float64, LPS mm
    reference : (3,) float64
        Direction from which the limit of the angle counts.
    words : tuple
        Step in mm; cosine and sine of the n directions of bending, (n, 2) float64; of an arc of k steps,
        (K + 1, 4) float64, its advance along the tangent and towards the bend in mm, cosine and sine of its
        turn; primitives by level, (P, 2) int64, direction and steps, and the first of each level and the end,
        (levels + 1,) int64.
    merge : tuple of float, float, bool
        Size of a cell of poses in mm and in components of the tangent; whether a node makes each costlier one
        in its cell superfluous, or only equal ones that are in nothing better.
    store : tuple
        nodes (N, NODE_COLUMNS) float64, links (N, LINK_COLUMNS) int32, proved (N, n + 1, 2) uint8, and the
        hash table of nodes, row + 1, (H,) int32, with H a power of two and at least 2 N.
    queue, state : tuple, (STATE_SIZE,) int64
        See `rank_queue`.
    counts : (COUNTS,) int64
        All 0 at first but NODES, 1: row 0 is the start.
    best : (BEST_SIZE,) float64
        Gets the best path.
    cost : float
        Cost of the best path so far.
    pops : int
        The start counts as one.

    Returns
    -------
    reason, cost : int, float
        SPENT, BETTER, EXHAUSTED, or which arrays have to grow; cost of the best path.
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
            if blocker_on_arc(obstacles, limits, _pose(nodes, at), bend, 0.0, begun, branch) != 0:
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
