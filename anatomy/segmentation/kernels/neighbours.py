"""What the neighbours of a voxel hold."""

from __future__ import annotations

from numba import njit


@njit(cache=True, nogil=True)
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
