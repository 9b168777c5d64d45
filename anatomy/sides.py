"""Left and right lung: where the two touch, a septum keeps a needle from crossing over.

A filled lung mask often joins the lungs along the anterior and posterior junction lines, where four
layers of pleura lie together.  A path through it would leave one lung and enter the other.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from anatomy.grid import Float, Grid

Mask = NDArray[np.bool_]

COARSE_VOXEL_MM = 1.6
NECK_WIDTHS_MM = (0.0, 2.0, 4.0, 7.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0)
SMALLER_LUNG_SHARE = 0.1


def septum(lung: Mask, airway: Mask, grid: Grid) -> Mask | None:
    """Return the voxels on both sides of the border between the two lungs.

    The mask without its airways is eroded until its two largest parts come apart side by side; each
    part then grows back over the mask, and the septum is where they meet.

    Parameters
    ----------
    lung, airway : (ni, nj, nk) bool
        Filled lungs; lumen and wall, which join the lungs at the carina and are left out.
    grid : Grid
        The grid of both.

    Returns
    -------
    (ni, nj, nk) bool or None
        None if two lungs could not be told apart.
    """
    step = tuple(max(1, round(COARSE_VOXEL_MM / float(s))) for s in grid.spacing_mm)
    coarse = tuple(slice(None, None, n) for n in step)
    axes = grid.lps_from_ijk[:3, :3] * step
    sides = _grow_sides(lung[coarse] & ~airway[coarse], axes)
    if sides is None:
        return None
    return _border(sides, step, lung & ~airway)


def _grow_sides(tissue: Mask, axes: Float) -> NDArray[np.int32] | None:
    """Label the two lungs 1 and 2 over `tissue`; the columns of `axes` are its voxel axes in LPS mm."""
    import edt
    from skimage.segmentation import watershed

    spacing = tuple(map(float, np.linalg.norm(axes, axis=0)))
    depth = edt.edt(np.asfortranarray(tissue), anisotropy=spacing, order="F", black_border=True)
    for neck in NECK_WIDTHS_MM:
        markers = _two_largest(depth > neck / 2, axes)
        if markers is not None:
            return np.asarray(watershed(-depth, markers, mask=tissue), dtype=np.int32)
    return None


def _two_largest(mask: Mask, axes: Float) -> NDArray[np.int32] | None:
    """Label the two largest parts of `mask` 1 and 2, if they are a lung's size and lie side by side."""
    from scipy import ndimage

    parts, count = ndimage.label(mask)
    if count < 2:
        return None
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    order = np.argsort(sizes)[::-1]
    if sizes[order[1]] < SMALLER_LUNG_SHARE * sizes[order[0]]:
        return None
    centres = np.array(ndimage.center_of_mass(mask, parts, order[:2]))
    apart = np.abs(axes @ (centres[0] - centres[1]))
    if apart[0] < max(apart[1], apart[2]):
        return None
    markers = np.zeros(mask.shape, dtype=np.int32)
    markers[parts == order[0]] = 1
    markers[parts == order[1]] = 2
    return markers


def _border(sides: NDArray[np.int32], step: tuple[int, ...], tissue: Mask) -> Mask:
    """Mark the voxels of `tissue` whose face neighbour lies on the other side."""
    border = np.zeros(tissue.shape, dtype=bool, order="F")
    meeting = np.argwhere(_differs_from_neighbour(sides))
    if not len(meeting):
        return border
    low = np.maximum(meeting.min(axis=0) - 1, 0)
    high = np.minimum(meeting.max(axis=0) + 2, sides.shape)
    near: NDArray[Any] = sides[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
    for axis, n in enumerate(step):
        near = np.repeat(near, n, axis=axis)
    start = low * step
    stop = np.minimum(start + near.shape, tissue.shape)
    window = tuple(slice(a, b) for a, b in zip(start, stop, strict=True))
    near = near[tuple(slice(0, b - a) for a, b in zip(start, stop, strict=True))]
    border[window] = _differs_from_neighbour(near) & tissue[window]
    return border


def _differs_from_neighbour(sides: NDArray[np.int32]) -> Mask:
    differs = np.zeros(sides.shape, dtype=bool)
    for axis in range(3):
        ahead = [slice(None)] * 3
        behind = [slice(None)] * 3
        ahead[axis] = slice(1, None)
        behind[axis] = slice(None, -1)
        a, b = sides[tuple(ahead)], sides[tuple(behind)]
        pair = (a != b) & (a > 0) & (b > 0)
        differs[tuple(ahead)] |= pair
        differs[tuple(behind)] |= pair
    return differs
