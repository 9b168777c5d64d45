"""The resistance of every combination of exits: by reduction of the tree, and as [Pan2025] prints it."""

import math

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel


@inner_kernel
def parallel(a, b):
    """Return the resistance of two resistors side by side; infinity is an open circuit."""
    if math.isinf(a):
        return b
    if math.isinf(b):
        return a
    return a * b / (a + b)


@merged_kernel
def _count(parent, vertex_of, count):
    """Fill `count` (K,) with the number of loops, one a lesion, that pass the stretch to each vertex."""
    count[:] = 0
    for m in range(vertex_of.shape[0]):
        v = vertex_of[m]
        while v >= 0:
            count[v] += 1
            v = parent[v]


@merged_kernel
def _reduced(parent, resistance, vertex_of, lesion, below):
    """Merge in series and parallel from the ends of the tree to its root."""
    below[:] = math.inf
    for m in range(vertex_of.shape[0]):
        below[vertex_of[m]] = parallel(below[vertex_of[m]], lesion[m])
    for v in range(parent.shape[0] - 1, 0, -1):
        if not math.isinf(below[v]):
            below[parent[v]] = parallel(below[parent[v]], below[v] + resistance[v])
    return below[0]


@inner_kernel
def _sort_two(keys, values, n):
    """Sort the first `n` of two arrays by ascending key, keeping the order of equal ones."""
    for i in range(1, n):
        key, value, j = keys[i], values[i], i - 1
        while j >= 0 and keys[j] > key:
            keys[j + 1], values[j + 1] = keys[j], values[j]
            j -= 1
        keys[j + 1], values[j + 1] = key, value


@inner_kernel
def _side(parent, resistance, side, which, vertex_of, lesion, count, on_n, on_r, par_n, par_r, group):
    """Return the resistance of one side by the printed steps; infinity without lesions there."""
    lesions = vertex_of.shape[0]
    # Step 2: resistors in as many loops, two or more, are summed, wherever they are.
    ons = 0
    for v in range(1, parent.shape[0]):
        if side[v] == which and count[v] >= 2:
            at = 0
            while at < ons and on_n[at] != count[v]:
                at += 1
            if at == ons:
                on_n[ons] = count[v]
                on_r[ons] = 0.0
                ons += 1
            on_r[at] += resistance[v]
    # Step 2 for resistors in one loop, and step 3: bulbs with the same preceding resistor are parallel.
    pars = 0
    for m in range(lesions):
        v = vertex_of[m]
        if side[v] != which:
            continue
        total = lesion[m]
        while v > 0 and side[v] == which and count[v] == 1:
            total += resistance[v]
            v = parent[v]
        at = 0
        while at < pars and group[at] != v:
            at += 1
        if at == pars:
            group[pars] = v
            par_n[pars] = count[v]
            par_r[pars] = math.inf
            pars += 1
        par_r[at] = parallel(par_r[at], total)
    if pars == 0:
        return math.inf
    _sort_two(on_n, on_r, ons)
    _sort_two(par_n, par_r, pars)
    # Step 4.
    merged = par_r[0]
    if ons > 0:
        merged += on_r[0]
    for i in range(1, max(ons, pars)):
        if i < pars:
            merged = parallel(merged, par_r[i])
        if i < ons:
            merged += on_r[i]
    return merged


@kernel()
def all_resistances(parent, resistance, side, exit_vertex, exit_resistance, first, printed, reduced):
    """Fill `printed` (C,) and `reduced` (C,) for all combinations of exits.

    The exits of lesion m are `first[m]` to `first[m + 1] - 1`; combination c counts them with the last
    lesion fastest.
    """
    lesions = first.shape[0] - 1
    vertex_of, lesion = np.zeros(lesions, dtype=np.int64), np.zeros(lesions)
    n = parent.shape[0]
    count, below = np.zeros(n, dtype=np.int64), np.zeros(n)
    on_n, on_r = np.zeros(n + 1, dtype=np.int64), np.zeros(n + 1)
    par_n, par_r = np.zeros(lesions + 1, dtype=np.int64), np.zeros(lesions + 1)
    group = np.zeros(lesions + 1, dtype=np.int64)
    for c in range(printed.shape[0]):
        rest = c
        for m in range(lesions - 1, -1, -1):
            size = first[m + 1] - first[m]
            x = first[m] + rest % size
            rest //= size
            vertex_of[m] = exit_vertex[x]
            lesion[m] = exit_resistance[x]
        _count(parent, vertex_of, count)
        reduced[c] = _reduced(parent, resistance, vertex_of, lesion, below)
        total = math.inf
        # Step 5; the trachea is in no side.
        for which in (1, 2):
            part = _side(
                parent, resistance, side, which, vertex_of, lesion, count, on_n, on_r, par_n, par_r, group
            )
            total = parallel(total, part)
        for m in range(lesions):
            if side[vertex_of[m]] == 0:
                total = parallel(total, lesion[m])
        printed[c] = total
