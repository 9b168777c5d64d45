"""Morphological closing with a ball by exact distances, and filling of enclosed holes."""

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.typed import Float32, Mask
from anatomy.morphology import bounds, window

_THREADS = 2


def closed(mask: Mask, radius_mm: float, spacing_mm: ArrayLike) -> Mask:
    """Close a mask with a ball: dilation, then erosion [Fu2018, text of III-A.1].

    Every gap is filled into which no ball of this radius fits.  Beyond the edge of the array the mask is
    taken to go on as it ends there.

    Args:
        mask ((ni, nj, nk) bool): Fortran-contiguous.
        spacing_mm ((3,) float64): Voxel size along the axes.

    Returns:
        (ni, nj, nk) bool: Contains `mask`.
    """
    if not mask.any():
        return mask.copy(order="F")
    grown = distance_mm(~mask, spacing_mm) <= radius_mm
    if grown.all():
        return grown
    shrunk: Mask = distance_mm(grown, spacing_mm) > radius_mm
    shrunk |= mask
    return shrunk


def without_holes(mask: Mask) -> Mask:
    """Fill what cannot be reached from the edge of the array through face neighbours."""
    from scipy import ndimage

    pieces, count = ndimage.label(~mask.T)
    open_to_edge = np.zeros(count + 1, dtype=np.bool_)
    for axis in range(3):
        for end in (0, -1):
            open_to_edge[np.unique(np.take(pieces, end, axis=axis))] = True
    open_to_edge[0] = False
    filled: Mask = ~open_to_edge[pieces].T
    return filled


def largest_piece(mask: Mask) -> Mask:
    """Return the piece of most voxels, joined by faces; the first of several equal ones."""
    from scipy import ndimage

    pieces, count = ndimage.label(mask.T)
    if count < 2:
        return mask
    largest: Mask = (pieces == int(np.argmax(np.bincount(pieces[mask.T])))).T
    return largest


def near(mask: Mask, reach_mm: float, spacing_mm: ArrayLike) -> Mask:
    """Mark what lies within a distance of a mask."""
    box = window(*bounds(mask, np.ceil(reach_mm / np.asarray(spacing_mm)).astype(np.int64)))
    found = np.zeros(mask.shape, dtype=np.bool_, order="F")
    if mask.any():
        found[box] = distance_mm(~mask[box], spacing_mm) <= reach_mm
    return found


def distance_mm(mask: Mask, spacing_mm: ArrayLike) -> Float32:
    """Return the distance of every True voxel to the nearest False one, centre to centre; 0 elsewhere."""
    import edt

    spacing = tuple(float(s) for s in np.asarray(spacing_mm))
    solid = np.require(mask, requirements=["F", "W"])  # the transform takes no read-only arrays
    return np.asarray(edt.edt(solid, anisotropy=spacing, order="F", parallel=_THREADS))
