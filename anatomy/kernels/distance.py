"""The exact Euclidean distance transform of a lattice, one axis after the other, in whole numbers.

The square of a distance is the sum over the axes of `steps**2 * square`, where `square` is that of the voxel
size in fine units, a power of two of which is 1 mm.  Whole numbers have one sum and one least sum in whatever
order they are taken: a box of points, with all that may be nearest to them, has the very distances of the
whole.
"""

import math

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel

NONE = 65535
"""Stands for no distance, and for all that are as far, in the units in which distances are stored."""


@inner_kernel
def _spread(line, square, sites, heights, starts):
    """Turn the squares that are known along a line, negative where none is, into the least at each place.

    Point `sites[m]`, with the square `heights[m]`, is nearest from `starts[m]` to before `starts[m + 1]`.
    """
    count, m = line.shape[0], -1
    for u in range(count):
        if line[u] < 0:
            continue
        while m >= 0:
            at = starts[m]
            if heights[m] + square * (at - sites[m]) ** 2 <= line[u] + square * (at - u) ** 2:
                break
            m -= 1
        at = 0
        if m >= 0:
            i = sites[m]
            # The quotient may be off by one where it is nearly whole: which point is nearer decides.
            crossing = (square * (u - i) * (u + i) + line[u] - heights[m]) / (2.0 * square * (u - i))
            at = max(int(min(crossing, 2.0 * count)) - 1, starts[m])
            while at < count and heights[m] + square * (at - i) ** 2 <= line[u] + square * (at - u) ** 2:
                at += 1
        if at < count:
            m += 1
            sites[m], heights[m], starts[m] = u, line[u], at
    for at in range(count - 1, -1, -1):
        if m >= 0:
            line[at] = heights[m] + square * (at - sites[m]) ** 2
            m -= starts[m] == at


@kernel(nogil=True)
def fill_distances(near, squares, shift):
    """Turn `near` `(ni, nj, nk)` uint16, 0 at points and NONE elsewhere, into distances, rounded down.

    `squares` (3,) int64 are those of the voxel sizes in fine units, of which a stored unit has `2**shift`.
    """
    ni, nj, nk = near.shape
    sites, heights, starts = np.zeros((3, max(ni, nj)), np.int64)
    line, plane = np.zeros(nj, np.int64), np.zeros((nj, ni), np.int64)
    # Steps to the nearest point along the last axis: up, then down.
    for n in range(1, 2 * nk - 1):
        k, beside = (n, n - 1) if n < nk else (2 * nk - 2 - n, 2 * nk - 1 - n)
        for j in range(nj):
            for i in range(ni):
                if near[i, j, beside] < min(near[i, j, k], NONE - 1):
                    near[i, j, k] = near[i, j, beside] + 1
    for k in range(nk):
        for i in range(ni):
            for j in range(nj):
                steps = np.int64(near[i, j, k])
                line[j] = -1 if steps == NONE else squares[2] * steps**2
            _spread(line, squares[1], sites, heights, starts)
            plane[:, i] = line
        for j in range(nj):
            _spread(plane[j], squares[0], sites, heights, starts)
            for i in range(ni):
                square = plane[j, i]
                root = int(math.sqrt(float(max(square, 0))))
                root -= root * root > square
                near[i, j, k] = NONE if square < 0 else min(root >> shift, NONE)
