"""Growing of masks by whole voxels."""

from __future__ import annotations

from anatomy.typed import Mask


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
