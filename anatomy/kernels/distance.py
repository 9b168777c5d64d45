"""The exact Euclidean distance transform of a lattice, one axis after the other, in whole numbers.

The square of a distance is the sum over the axes of `steps**2 * square`, where `square` is that of the voxel
size in units of `4**-shift` mm^2, rounded down.  Whole numbers have one sum and one least sum in whatever
order they are taken.  So a box of points, with all that may be nearest to them, has the very distances of the
whole.
"""

import math

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel

NONE = 65535
"""Stands for no distance, and for all that are as far."""
UNIT_SHIFT = 8
"""Distances are stored in units of `2**-UNIT_SHIFT` mm."""


@inner_kernel
def _is_first(line, square, i, u, at):
    """Tell whether point `i` of a line is as near to the place `at` as point `u`."""
    return line[i] + square * (at - i) * (at - i) <= line[u] + square * (at - u) * (at - u)


@inner_kernel
def _nearest_along(line, count, square, sites, starts):
    """Find which of the `count` points of a line is nearest to each; return how many are nearest to any.

    `line` has the squares of the distances beside it, negative where there is none.  Point `sites[m]` is
    nearest from `starts[m]` to before `starts[m + 1]`.
    """
    found = 0
    for u in range(count):
        if line[u] < 0:
            continue
        while found > 0 and not _is_first(line, square, sites[found - 1], u, starts[found - 1]):
            found -= 1
        start = 0
        if found > 0:
            i = sites[found - 1]
            # The quotient may be off by one where it is nearly whole: which point is nearer decides.
            crossing = (square * (u - i) * (u + i) + line[u] - line[i]) / (2.0 * square * (u - i))
            start = max(int(min(crossing, 2.0 * count)) - 1, starts[found - 1])
            while start < count and _is_first(line, square, i, u, start):
                start += 1
        if start < count:
            sites[found], starts[found] = u, start
            found += 1
    return found


@kernel(nogil=True)
def fill_distances(near, squares, shift):
    """Turn `near` `(ni, nj, nk)` uint16, 0 at points and NONE elsewhere, into distances, rounded down.

    `squares` `(3,)` int64 are those of the voxel sizes in units of `4**-shift` mm^2, at least 1.
    """
    ni, nj, nk = near.shape
    most = max(ni, nj)
    sites, starts = np.zeros(most, np.int64), np.zeros(most, np.int64)
    line, plane = np.zeros(nj, np.int64), np.zeros((nj, ni), np.int64)
    # Steps to the nearest point along the last axis: up, then down.
    for k in range(1, nk):
        for j in range(nj):
            for i in range(ni):
                if near[i, j, k - 1] < min(near[i, j, k], NONE - 1):
                    near[i, j, k] = near[i, j, k - 1] + 1
    for k in range(nk - 2, -1, -1):
        for j in range(nj):
            for i in range(ni):
                if near[i, j, k + 1] < min(near[i, j, k], NONE - 1):
                    near[i, j, k] = near[i, j, k + 1] + 1
    for k in range(nk):
        for i in range(ni):
            for j in range(nj):
                steps = np.int64(near[i, j, k])
                line[j] = -1 if steps == NONE else squares[2] * steps * steps
            m = _nearest_along(line, nj, squares[1], sites, starts) - 1
            for j in range(nj - 1, -1, -1):
                if m < 0:
                    plane[j, i] = -1
                    continue
                site = sites[m]
                plane[j, i] = line[site] + squares[1] * (j - site) * (j - site)
                if j == starts[m]:
                    m -= 1
        for j in range(nj):
            row = plane[j]
            m = _nearest_along(row, ni, squares[0], sites, starts) - 1
            for i in range(ni - 1, -1, -1):
                if m < 0:
                    near[i, j, k] = NONE
                    continue
                site = sites[m]
                square = row[site] + squares[0] * (i - site) * (i - site)
                if i == starts[m]:
                    m -= 1
                root = int(math.sqrt(float(square)))
                if root * root > square:
                    root -= 1
                near[i, j, k] = min(root >> (shift - UNIT_SHIFT), NONE)
