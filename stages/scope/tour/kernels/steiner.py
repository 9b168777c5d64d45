"""Dynamic program over a tree: the shortest tour that takes one exit of each lesion.

The tree is a list of binary nodes, children first.  A leaf is an exit; any other node merges two nodes.
`lift` is the length of the stretch above a node.  A lesion is open at a node if some of its exits lie below
and some do not.  For each set of open lesions, as bits in ascending order of the lesions, and for tours that
end below the node or not, the least cost is stored of serving at least this set and every lesion whose exits
all lie below.  A lesion that both children know is served by either: all divisions of the set are tried.
"""

import math

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel


@inner_kernel
def _bits_of(mask):
    count = 0
    while mask:
        mask &= mask - 1
        count += 1
    return count


@inner_kernel
def _table(union, known, out):
    """Fill `out`: for each subset of `union`, written in its bits, the subset in the bits of `known`.

    Bits that `known` has not are dropped.
    """
    out[0] = 0
    size = 1
    at = 0
    bit = np.int64(1)
    rest = union
    while rest:
        if rest & 1:
            value = np.int64(0)
            if known & bit:
                value = np.int64(1) << at
            for m in range(size):
                out[size + m] = out[m] | value
            size *= 2
        if known & bit:
            at += 1
        rest >>= 1
        bit <<= 1


@inner_kernel
def _spread(union, part):
    """Return `part`, a subset of `union` written as lesions, in the bits of `union`."""
    local = np.int64(0)
    at = np.int64(1)
    bit = np.int64(1)
    rest = union
    while rest:
        if rest & 1:
            if part & bit:
                local |= at
            at <<= 1
        rest >>= 1
        bit <<= 1
    return local


@inner_kernel
def _parts(union, above, a, b):
    """Return in the bits of `union`: what closes, what stays open, what both children have, what only `a`."""
    closing, keep = _spread(union, union & ~above), _spread(union, union & above)
    return closing, keep, _spread(union, a & b), _spread(union, a & ~b)


@kernel()
def solve(left, right, lift, cost, below, open_sets, offset, closed_tour, best, split, chosen):
    """Return the least cost, and mark the chosen exits.

    Args:
        left, right ((T,) int64): Children of a node; -1 for a leaf.
        lift, cost ((T,) float64): Stretch above the node; cost of a leaf's exit.
        below ((T,) int64): Lesions with an exit below the node, as bits.
        open_sets ((T,) int64): Open lesions, as bits; a subset of `below`.
        offset ((T + 1,) int64): Where the values of a node begin in `best` (2, ...) and `split` (2, ...):
            rows for tours that do not end below the node, and for those that do.
        closed_tour: bool.
        chosen ((T,) bool): Filled: which leaves are taken.
    """
    nodes = left.shape[0]
    widest = 1
    for t in range(nodes):
        union = open_sets[t]
        if left[t] >= 0:
            union = open_sets[left[t]] | open_sets[right[t]]
        widest = max(widest, 1 << _bits_of(union))
    to_a = np.zeros(widest, dtype=np.int64)
    to_b = np.zeros(widest, dtype=np.int64)
    for t in range(nodes):
        o = offset[t]
        if left[t] < 0:
            size = offset[t + 1] - o
            for m in range(size):
                taken = m > 0 or open_sets[t] == 0
                best[0, o + m] = cost[t] + 2.0 * lift[t] if taken else 0.0
                best[1, o + m] = cost[t] + lift[t]
            continue
        a, b = left[t], right[t]
        union = open_sets[a] | open_sets[b]
        _table(union, open_sets[a], to_a)
        _table(union, open_sets[b], to_b)
        closing, keep, shared, only_a = _parts(union, open_sets[t], open_sets[a], open_sets[b])
        empty_allowed = below[t] == open_sets[t]
        # Subsets of `keep`, ascending, are the node's own bits in order.
        own = np.int64(0)
        at = 0
        while True:
            full = own | closing
            both = full & shared
            in_a = full & only_a
            in_b = full & ~shared & ~only_a
            zero = math.inf
            one = math.inf
            zero_split = np.int64(0)
            one_split = np.int64(0)
            sub = both
            while True:
                ia = offset[a] + to_a[in_a | sub]
                ib = offset[b] + to_b[in_b | (both ^ sub)]
                value = best[0, ia] + best[0, ib]
                if value < zero:
                    zero = value
                    zero_split = sub
                value = best[1, ia] + best[0, ib]
                if value < one:
                    one = value
                    one_split = 2 * sub
                value = best[0, ia] + best[1, ib]
                if value < one:
                    one = value
                    one_split = 2 * sub + 1
                if sub == 0:
                    break
                sub = (sub - 1) & both
            nothing = full == 0 and empty_allowed
            best[0, o + at] = zero if nothing else zero + 2.0 * lift[t]
            best[1, o + at] = one + lift[t]
            split[0, o + at] = zero_split
            split[1, o + at] = one_split
            at += 1
            if own == keep:
                break
            own = (own - keep) & keep
    _choose(left, right, open_sets, offset, split, 0 if closed_tour else 1, chosen)
    return best[0 if closed_tour else 1, offset[nodes - 1]]


@inner_kernel
def _choose(left, right, open_sets, offset, split, ends_below, chosen):
    """Walk back from the root and mark the exits of the best values."""
    nodes = left.shape[0]
    want = np.zeros(nodes, dtype=np.int64)
    flag = np.zeros(nodes, dtype=np.int64)
    active = np.zeros(nodes, dtype=np.bool_)
    active[nodes - 1] = True
    flag[nodes - 1] = ends_below
    for t in range(nodes - 1, -1, -1):
        if not active[t]:
            continue
        if left[t] < 0:
            chosen[t] = flag[t] == 1 or want[t] > 0 or open_sets[t] == 0
            continue
        a, b = left[t], right[t]
        union = open_sets[a] | open_sets[b]
        size = 1 << _bits_of(union)
        to_a = np.zeros(size, dtype=np.int64)
        to_b = np.zeros(size, dtype=np.int64)
        _table(union, open_sets[a], to_a)
        _table(union, open_sets[b], to_b)
        closing, keep, shared, only_a = _parts(union, open_sets[t], open_sets[a], open_sets[b])
        own = np.int64(0)
        for _ in range(want[t]):
            own = (own - keep) & keep
        full = own | closing
        both = full & shared
        code = split[flag[t], offset[t] + want[t]]
        sub = code if flag[t] == 0 else code >> 1
        active[a] = True
        active[b] = True
        want[a] = to_a[(full & only_a) | sub]
        want[b] = to_b[(full & ~shared & ~only_a) | (both ^ sub)]
        flag[a] = 1 if flag[t] == 1 and (code & 1) == 0 else 0
        flag[b] = 1 if flag[t] == 1 and (code & 1) == 1 else 0
