"""A CT as a scanner would have reconstructed it with thicker slices."""

from __future__ import annotations

import numpy as np

from anatomy.grid import Grid, Volume


def thickened(ct: Volume, slice_mm: float) -> Volume:
    """Return a CT with slices along its last axis that are means over `slice_mm` of the CT's own.

    Slices that it has in part are left out at the end.
    """
    share = slice_mm / float(ct.grid.spacing_mm[2])
    own = ct.grid.shape[2]
    count = int(own / share + 1e-6)
    below = np.concatenate(
        [np.zeros((*ct.grid.shape[:2], 1)), np.cumsum(ct.array, axis=2, dtype=np.float64)], 2
    )
    edges = np.minimum(np.arange(count + 1) * share, own)
    first = np.minimum(edges.astype(np.int64), own - 1)
    sums = below[:, :, first] + (edges - first) * ct.array[:, :, first]
    matrix = ct.grid.lps_from_ijk.copy()
    matrix[:3, 2] *= share
    matrix[:3, 3] = ct.grid.lps((0.0, 0.0, (share - 1.0) / 2.0))
    grid = Grid(shape=(*ct.grid.shape[:2], count), lps_from_ijk=matrix)
    means = np.diff(sums, axis=2) / share
    return Volume(grid=grid, array=np.asfortranarray(np.rint(means).astype(ct.array.dtype)))
