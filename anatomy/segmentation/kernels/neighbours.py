"""Neighbours of a voxel: where they lie, and what they hold."""

import numpy as np

from anatomy.kernels.compiling import kernel


@kernel()
def box_offsets(shape, reach):
    """Return the flat offsets of all voxels of a box of `2 reach + 1` but its middle, `(N,)` int64."""
    side = 2 * reach + 1
    out = np.zeros(side**3 - 1, dtype=np.int64)
    at = 0
    for dk in range(-reach, reach + 1):
        for dj in range(-reach, reach + 1):
            for di in range(-reach, reach + 1):
                if dk != 0 or dj != 0 or di != 0:
                    out[at] = (dk * shape[1] + dj) * shape[2] + di
                    at += 1
    return out


@kernel()
def face_offsets(shape):
    """Return the flat offsets of the six voxels that share a face with a voxel, `(6,)` int64."""
    out = np.zeros(6, dtype=np.int64)
    step = 1
    for axis in range(3):
        out[2 * axis] = -step
        out[2 * axis + 1] = step
        step *= shape[2 - axis]
    return out


@kernel(nogil=True)
def take_greatest_neighbour(values, first, last, where, raised):
    """Fill `raised` with the greatest of a voxel and its 26 neighbours in the planes `first <= k < last`.

    `values`, `raised` float32 and `where` bool are `(nk, nj, ni)`; only voxels of `where` are changed.
    """
    nk, nj, ni = values.shape
    for k in range(first, last):
        for j in range(nj):
            for i in range(ni):
                if not where[k, j, i]:
                    continue
                greatest = values[k, j, i]
                for c in range(max(k - 1, 0), min(k + 2, nk)):
                    for b in range(max(j - 1, 0), min(j + 2, nj)):
                        for a in range(max(i - 1, 0), min(i + 2, ni)):
                            greatest = max(greatest, values[c, b, a])
                raised[k, j, i] = greatest
