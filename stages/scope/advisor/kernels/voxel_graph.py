"""Potentials on the interior voxels of a lumen: the shortest and the widest paths, exactly.

Legend: N interior voxels, numbered in raster order (k fastest).  `neighbours` is `(N, 6)` int32: the voxels
before and after along i, j and k, -1 for wall.  `steps` is `(3,)` float64: what a step along an axis counts.
"""

import numpy as np

from anatomy.kernels.compiling import kernel


@kernel()
def clearance_l1(neighbours, steps, out):
    """Fill `out` (N,) with the L1 distance to the nearest voxel of wall.

    Two sweeps are exact: the shortest path to the nearest wall never turns back along an axis, and the
    steps of one sign can all be taken last.
    """
    count = neighbours.shape[0]
    for n in range(count):
        best = np.inf
        for axis in range(3):
            before = neighbours[n, 2 * axis]
            best = min(best, steps[axis] + (0.0 if before < 0 else out[before]))
            if neighbours[n, 2 * axis + 1] < 0:
                best = min(best, steps[axis])
        out[n] = best
    for n in range(count - 1, -1, -1):
        best = out[n]
        for axis in range(3):
            after = neighbours[n, 2 * axis + 1]
            if after >= 0:
                best = min(best, steps[axis] + out[after])
        out[n] = best


@kernel()
def shortest_paths(neighbours, steps, weights, extremes, goal, out):
    """Fill `out` (N,) with the cost of the shortest path from voxel `goal`, infinity where there is none.

    A step along axis `a` into voxel `n` costs `steps[a] * weights[n]`, above 0; `extremes` (2,) are the least
    and the largest such cost.  Dijkstra's algorithm with buckets half as wide as the cheapest step: no voxel
    of a bucket can improve another one of it, so the result is that of any exact implementation, to the last
    bit.
    """
    count = neighbours.shape[0]
    width = 0.5 * extremes[0]
    slots = int(extremes[1] / width) + 3
    first = np.zeros(slots, np.int32)
    following = np.zeros(count, np.int32)
    preceding = np.zeros(count, np.int32)
    for slot in range(slots):
        first[slot] = -1
    for node in range(count):
        out[node] = np.inf
    out[goal] = 0.0
    following[goal] = -1
    preceding[goal] = -1
    first[0] = goal
    waiting = 1
    bucket = 0
    while waiting > 0:
        slot = bucket % slots
        node = first[slot]
        if node < 0:
            bucket += 1
            continue
        first[slot] = following[node]
        if following[node] >= 0:
            preceding[following[node]] = -1
        waiting -= 1
        here = out[node]
        for side in range(6):
            other = neighbours[node, side]
            if other < 0:
                continue
            cost = here + steps[side // 2] * weights[other]
            before = out[other]
            if cost >= before:
                continue
            if before < np.inf:
                old = int(before / width) % slots
                if preceding[other] >= 0:
                    following[preceding[other]] = following[other]
                else:
                    first[old] = following[other]
                if following[other] >= 0:
                    preceding[following[other]] = preceding[other]
                waiting -= 1
            out[other] = cost
            new = int(cost / width) % slots
            following[other] = first[new]
            preceding[other] = -1
            if first[new] >= 0:
                preceding[first[new]] = other
            first[new] = other
            waiting += 1


@kernel()
def widest_paths(neighbours, depth, start, out):
    """Fill `out` (N,) int64 with the narrowest depth on the widest path from voxel `start`, -1 if none.

    `depth` (N,) int64 is not negative.  Voxels are taken by decreasing width, so that the first path found
    to a voxel is the widest.
    """
    count = neighbours.shape[0]
    first = np.zeros(depth[start] + 1, np.int32)
    following = np.zeros(count, np.int32)
    for level in range(depth[start] + 1):
        first[level] = -1
    for node in range(count):
        out[node] = -1
    out[start] = depth[start]
    following[start] = -1
    first[depth[start]] = start
    level = depth[start]
    while level >= 0:
        node = first[level]
        if node < 0:
            level -= 1
            continue
        first[level] = following[node]
        for side in range(6):
            other = neighbours[node, side]
            if other >= 0 and out[other] < 0:
                out[other] = min(level, depth[other])
                following[other] = first[out[other]]
                first[out[other]] = other
