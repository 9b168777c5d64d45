"""Nodes of the resolution search: what follows a primitive, and which nodes are duplicates of others.

A row of `nodes` is a pose, the first direction of bending, and the length, the accumulated turn and the cost
of the path that leads there.

A queue of entries by rank and by a lower bound f of the cost of what they lead to.

Taken first is the smallest f among the lowest rank that has an entry and the next LOOK_AHEAD ranks [Fu2022].
Those entries are in one binary heap; the others wait in a list for each rank.  An entry is never pushed at a
rank below the lowest one.

The queue is a tuple: f of each entry, (M,) float64; `entries`, (M, ENTRY_COLUMNS) int32; the heap's copy of
f, (M,) float64, and its entries, (M,) int32; `ranks`, (K, 2) int32, with the first entry of each rank's list
(-1: none) and the number of its entries.  Ranks K - LOOK_AHEAD and above have none.
"""

import math

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel

LOOK_AHEAD = 3

# Columns of `entries`: two numbers of the user's, rank, next entry of a list.
FIRST, SECOND, RANK, NEXT, ENTRY_COLUMNS = range(5)

# Columns of `ranks`.
HEAD = 0
COUNT = 1

# What `state` holds, all 0 at first but FREE, -1: entries ever used, head of the list of free ones, entries
# waiting, entries in the heap, lowest rank.
USED, FREE, WAITING, HEAPED, LOWEST, STATE_SIZE = range(6)

ROUNDING = 1e-9
"""Share of the best cost by which a path must be cheaper to be looked for."""
# A type of its own: for each literal argument a function would be compiled anew.
_NOT_ACROSS = np.int64(0)

SAME = 1e-6
"""Poses that differ by less than this, in mm and in each component of a direction, are equal."""

# Columns of `nodes`: pose (6), first direction of bending (3), path length, accumulated turn, path cost.
NORMAL, PATH_LENGTH, PATH_TURN, PATH_COST, NODE_COLUMNS = 6, 9, 10, 11, 12

# Columns of `links`: node before, direction and steps of the primitive from there, rank.
PARENT, DIRECTION, STEPS, NODE_RANK, LINK_COLUMNS = range(5)

# Of a node and a direction, `proved` holds the most steps proved clear, and the least that are of no use.
CLEAR = 0
USELESS = 1


@inner_kernel
def node_pose(nodes, at):
    """Return the pose of a node."""
    return nodes[at, 0], nodes[at, 1], nodes[at, 2], nodes[at, 3], nodes[at, 4], nodes[at, 5]


@kernel()
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
def follow(nodes, words, bend, at, direction, steps, row):
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
    """Return a number, at least 0, of the cell that holds a pose, or of the nearest cell along the axes in
    `across`."""
    h = 0
    for m in range(6):
        size = merge[0] if m < 3 else merge[1]
        cell = math.floor(nodes[row, m] / size)
        if across >> m & 1:
            cell += 1.0 if nodes[row, m] / size - cell > 0.5 else -1.0
        h = (h ^ int(cell)) * 0x2545F4914F6CDD1D
        h ^= h >> 29
    return h & 0x7FFFFFFFFFFFFFFF


@merged_kernel
def _at_faces(nodes, row, merge):
    """Return the axes, as bits, along which an equal pose may lie in the next cell."""
    bits = 0
    for m in range(6):
        size = merge[0] if m < 3 else merge[1]
        if math.floor((nodes[row, m] - SAME) / size) != math.floor((nodes[row, m] + SAME) / size):
            bits |= 1 << m
    return bits


@merged_kernel
def _in_one_cell(nodes, a, b, merge):
    for m in range(6):
        size = merge[0] if m < 3 else merge[1]
        if math.floor(nodes[a, m] / size) != math.floor(nodes[b, m] / size):
            return False
    return True


@merged_kernel
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


@kernel()
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


@kernel()
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
def _into_heap(entry_f, heap_f, heap, state, entry):
    f = entry_f[entry]
    at = state[HEAPED]
    state[HEAPED] += 1
    while at > 0:
        above = (at - 1) >> 1
        if heap_f[above] <= f:
            break
        heap_f[at] = heap_f[above]
        heap[at] = heap[above]
        at = above
    heap_f[at] = f
    heap[at] = entry


@merged_kernel
def _off_heap(heap_f, heap, state):
    """Take the entry with the smallest f off the heap."""
    top = heap[0]
    state[HEAPED] -= 1
    size = state[HEAPED]
    f, entry = heap_f[size], heap[size]
    at = 0
    while True:
        below = 2 * at + 1
        if below >= size:
            break
        if below + 1 < size and heap_f[below + 1] < heap_f[below]:
            below += 1
        if heap_f[below] >= f:
            break
        heap_f[at] = heap_f[below]
        heap[at] = heap[below]
        at = below
    heap_f[at] = f
    heap[at] = entry
    return top


@kernel()
def push(queue, state, f, first, second, rank):
    """Add an entry; the caller sees to it that one is free, WAITING < M."""
    entry_f, entries, heap_f, heap, ranks = queue
    entry = state[FREE]
    if entry >= 0:
        state[FREE] = entries[entry, NEXT]
    else:
        entry = state[USED]
        state[USED] += 1
    state[WAITING] += 1
    entry_f[entry] = f
    entries[entry, FIRST] = first
    entries[entry, SECOND] = second
    entries[entry, RANK] = rank
    ranks[rank, COUNT] += 1
    if rank <= state[LOWEST] + LOOK_AHEAD:
        _into_heap(entry_f, heap_f, heap, state, entry)
    else:
        entries[entry, NEXT] = ranks[rank, HEAD]
        ranks[rank, HEAD] = entry


@kernel()
def pop(queue, state):
    """Take the next entry, of which there is one: return its f, its two numbers and its rank."""
    entry_f, entries, heap_f, heap, ranks = queue
    while ranks[state[LOWEST], COUNT] == 0:
        state[LOWEST] += 1
        opened = state[LOWEST] + LOOK_AHEAD
        entry = ranks[opened, HEAD]
        ranks[opened, HEAD] = -1
        while entry >= 0:
            following = entries[entry, NEXT]
            _into_heap(entry_f, heap_f, heap, state, entry)
            entry = following
    entry = _off_heap(heap_f, heap, state)
    ranks[entries[entry, RANK], COUNT] -= 1
    state[WAITING] -= 1
    entries[entry, NEXT] = state[FREE]
    state[FREE] = entry
    first, second = np.int64(entries[entry, FIRST]), np.int64(entries[entry, SECOND])
    return entry_f[entry], first, second, np.int64(entries[entry, RANK])
