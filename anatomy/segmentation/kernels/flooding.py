"""Shares a volume out among labelled seeds: by the cheapest way from a seed, and by diffusion."""

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel

HALF, INFINITE = np.float32(0.5), np.float32(np.inf)


@inner_kernel
def _push(heap, item):
    """Put an item on a heap whose least item comes first."""
    heap.append(item)
    at = len(heap) - 1
    while at > 0 and item < heap[(at - 1) // 2]:
        heap[at] = heap[(at - 1) // 2]
        at = (at - 1) // 2
    heap[at] = item


@inner_kernel
def _pop(heap):
    """Take the least item from a heap."""
    least, last = heap[0], heap.pop()
    size, at = len(heap), 0
    if size == 0:
        return least
    while 2 * at + 1 < size:
        child = 2 * at + 1
        if child + 1 < size and heap[child + 1] < heap[child]:
            child += 1
        if last <= heap[child]:
            break
        heap[at] = heap[child]
        at = child
    heap[at] = last
    return least


@kernel()
def flood(labels, cost):
    """Give every voxel of 0 the label from which the way to it costs least, in place.

    A step between two voxels that share a face costs the mean of theirs.  `labels` (nk, nj, ni) int32 are
    above 0 at seeds, 0 where a label is wanted, below 0 where no way leads; `cost` is (nk, nj, ni) float32.
    """
    nk, nj, ni = labels.shape
    label, price = labels.ravel(), cost.ravel()
    least = np.full(label.size, INFINITE, dtype=np.float32)
    heap = [(np.float32(0.0), np.int64(0))]
    heap.clear()
    for seed in range(label.size):
        if label[seed] > 0:
            least[seed] = np.float32(0.0)
            _push(heap, (least[seed], np.int64(seed)))
    while len(heap) > 0:
        so_far, at = _pop(heap)
        if so_far > least[at]:
            continue
        i, j, k = at % ni, at // ni % nj, at // (nj * ni)
        for turn in range(6):
            axis, forward = turn // 2, turn % 2
            place, end = (i, ni) if axis == 0 else ((j, nj) if axis == 1 else (k, nk))
            if place + forward >= end or place + forward < 1:
                continue
            step = 1 if axis == 0 else (ni if axis == 1 else ni * nj)
            near = at + (2 * forward - 1) * step
            if label[near] < 0:
                continue
            total = so_far + HALF * (price[at] + price[near])
            if total < least[near]:
                least[near], label[near] = total, label[at]
                _push(heap, (total, np.int64(near)))


@kernel()
def diffuse(share, free, along_i, along_j, along_k, rounds, relaxation):
    """Bring shares nearer to their steady state by successive over-relaxation, in place.

    Args:
        share ((nk, nj, ni) float32): Start, and fixed values at all voxels that are not free.
        free ((F,) int64): Flat indices of the voxels to change, none in the outermost layer.
        along_i, along_j, along_k ((nk, nj, ni) float32): Conductance from each voxel to the next along an
            axis.
        rounds: int.
        relaxation (float32): 1 to below 2.
    """
    _, nj, ni = share.shape
    value, row, plane = share.ravel(), ni, ni * nj
    x, y, z = along_i.ravel(), along_j.ravel(), along_k.ravel()
    for _ in range(rounds):
        for at in free:
            total = x[at - 1] + x[at] + y[at - row] + y[at] + z[at - plane] + z[at]
            if total == np.float32(0.0):
                continue
            flow = x[at - 1] * value[at - 1] + x[at] * value[at + 1]
            flow += y[at - row] * value[at - row] + y[at] * value[at + row]
            flow += z[at - plane] * value[at - plane] + z[at] * value[at + plane]
            value[at] += relaxation * (flow / total - value[at])
