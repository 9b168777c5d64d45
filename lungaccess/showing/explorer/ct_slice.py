"""Slices of the whole CT for the page, at the pixels of any plane: the page itself holds it coarsely."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.typed import Float32
from anatomy.grid import Volume


def ct_slice(
    ct: Volume, origin: ArrayLike, across: ArrayLike, down: ArrayLike, columns: int, rows: int
) -> Float32:
    """Return the values in HU at the pixels of a plane, between the eight voxels around each.

    Parameters
    ----------
    origin, across, down : (3,) array_like, LPS mm
        The place of the first pixel's centre, and the steps to the next column and row.

    Returns
    -------
    values : (rows, columns) float32
        nan beyond the centres of the outermost voxels.
    """
    from scipy.ndimage import map_coordinates

    row, column = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    steps = column[..., None] * np.asarray(across) + row[..., None] * np.asarray(down)
    ijk = ct.grid.ijk((np.asarray(origin) + steps).reshape(-1, 3))
    # Only the voxels around the plane are read: a CT is larger than what a slice of it needs.
    low = np.clip(np.floor(ijk.min(axis=0)), 0, np.array(ct.grid.shape) - 1).astype(np.int64)
    high = np.clip(np.ceil(ijk.max(axis=0)) + 1, low + 1, ct.grid.shape).astype(np.int64)
    part = ct.array[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
    values = map_coordinates(
        part, (ijk - low).T, output=np.float32, order=1, mode="constant", cval=np.nan, prefilter=False
    )
    beyond = ((ijk < 0) | (ijk > np.array(ct.grid.shape) - 1)).any(axis=1)
    values[beyond] = np.nan
    return np.asarray(values).reshape(rows, columns)
