"""The map of local minima of a CT: how much darker a voxel is than what surrounds it [Fu2018, Aykac2003]."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np

from anatomy.base.typed import Float, Int16
from anatomy.segmentation.kernels.local_minima import depth_slice, smooth_slice

LARGEST_SCALE = 12
"""N: the largest structuring element of the paper reaches this many pixels."""
LARGEST_SCALE_MM = 8.0
"""... but not farther than this: larger elements would close small lungs."""
SQUARE_RATIO = 1.5
"""Slices are used in the directions in which their pixels are squarer than this."""

_THREADS = 2


def local_minima_map(hu: Int16, spacing_mm: Float, upright: int) -> Int16:
    """Return the local minima map of a volume.

    Of one direction of slices it is the map of the paper.  Where the voxels are near to cubes, it is the
    median of the maps of all three directions.

    Parameters
    ----------
    hu : (nk, nj, ni) int16, C-contiguous
        Hounsfield units.
    spacing_mm : (3,) float64
        Voxel size along these axes.
    upright : int
        The axis along which a CT is sliced, used alone where the voxels are not near to cubes.

    Returns
    -------
    (nk, nj, ni) int16, C-contiguous
        Not negative, HU.

    Notes
    -----
    The paper takes the maximum over the scales 1 to N.  A closing with a larger diamond is nowhere lower,
    nor is what is reconstructed from it: the largest scale alone gives that maximum.
    """
    if spacing_mm.max() > SQUARE_RATIO * spacing_mm.min():
        return _sliced(hu, upright, spacing_mm)
    first, second, third = (_sliced(hu, axis, spacing_mm) for axis in range(3))
    low = np.minimum(first, second)
    np.maximum(first, second, out=first)
    np.minimum(first, third, out=first)
    return np.maximum(low, first, out=low)


def scale_of(pixel_mm: Float) -> int:
    """Return the reach of the largest structuring element in pixels, for pixels of two sides in mm."""
    return int(np.clip(round(LARGEST_SCALE_MM / float(np.sqrt(pixel_mm.prod()))), 1, LARGEST_SCALE))


def _sliced(hu: Int16, axis: int, spacing_mm: Float) -> Int16:
    slices = np.moveaxis(hu, axis, 0)
    out = np.zeros_like(hu)
    target = np.moveaxis(out, axis, 0)
    scale = scale_of(np.delete(spacing_mm, axis))
    with ThreadPoolExecutor(_THREADS) as pool:
        for _ in pool.map(partial(_some, slices, scale, target), range(_THREADS)):
            pass
    return out


def _some(slices: Int16, scale: int, out: Int16, first: int) -> None:
    """Fill every slice whose number leaves `first` when divided by the number of threads."""
    shape = slices.shape[1:]
    work = np.zeros((4, *shape), dtype=np.int16)
    queue = np.zeros(shape[0] * shape[1] + 1, dtype=np.int32)
    waiting = np.zeros(shape, dtype=np.bool_)
    for n in range(first, len(slices), _THREADS):
        work[0] = slices[n]
        smooth_slice(work[0], work[1])
        depth_slice(work[1], scale, work[2:], queue, waiting, work[0])
        out[n] = work[0]
