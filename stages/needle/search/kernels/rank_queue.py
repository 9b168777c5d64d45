"""A queue of entries by rank and by a lower bound f of the cost of what they lead to.

Taken first is the smallest f among the lowest rank that has an entry and the next LOOK_AHEAD ranks [Fu2022].
Those entries are in one binary heap; the others wait in a list for each rank.  An entry is never pushed at a
rank below the lowest one.

The queue is a tuple: f of each entry, (M,) float64; `entries`, (M, ENTRY_COLUMNS) int32; the heap's copy of
f, (M,) float64, and its entries, (M,) int32; `ranks`, (K, 2) int32, with the first entry of each rank's list
(-1: none) and the number of its entries.  Ranks K - LOOK_AHEAD and above have none.
"""

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
