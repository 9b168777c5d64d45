"""Masks by whole voxels: their bounds, and growing."""

from __future__ import annotations

import numpy as np

from anatomy.typed import Array, Int, Mask

Window = tuple[slice, slice, slice]
"""A box of voxels, as an index of arrays."""


def grown_by_one(mask: Mask) -> Mask:
    """Grow a mask by one voxel in all 26 directions, one axis after the other."""
    for axis in range(3):
        lower = tuple(slice(None, -1) if a == axis else slice(None) for a in range(3))
        upper = tuple(slice(1, None) if a == axis else slice(None) for a in range(3))
        grown = mask.copy(order="F")
        grown[lower] |= mask[upper]
        grown[upper] |= mask[lower]
        mask = grown
    return mask


def bounds(mask: Array, pad: int | Int = 0) -> tuple[Int, Int]:
    """Return `low` and `high` such that every voxel of a mask has `low <= ijk < high`; zeros if it is empty.

    They are wider by `pad` voxels, of all axes or of each `(3,)`, as far as the array reaches.
    """
    low, high = np.zeros(3, dtype=np.int64), np.zeros(3, dtype=np.int64)
    lines = (mask.any(axis=(1, 2)), mask.any(axis=(0, 2)), mask.any(axis=(0, 1)))
    for axis, line in enumerate(lines):
        hits = np.flatnonzero(line)
        if hits.size:
            low[axis], high[axis] = hits[0], hits[-1] + 1
    return np.maximum(low - pad, 0), np.minimum(high + pad, mask.shape)


def window(low: Int, high: Int) -> Window:
    """Return the voxels `low <= ijk < high` as an index."""
    i, j, k = (slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
    return i, j, k
