"""The CT on cubic voxels of 1 mm, on which plates look the same in every direction."""

from typing import Self

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Array, Float, Float32, Int
from anatomy.grid import Grid

EDGE_MM = 1.0
"""About the blur of a CT, and fine enough for fissures, which are 1 to 2 mm wide in it."""


@frozen_record
class Cubic:
    """Cubic voxels over the same box as a grid; their arrays are `(nk, nj, ni)` and C-contiguous.

    Parameters
    ----------
    grid : Grid
        The grid of the CT.
    shape : tuple of int
        (nk, nj, ni) of the cubic voxels.
    """

    grid: Grid
    shape: tuple[int, int, int]

    @classmethod
    def over(cls, grid: Grid) -> Self:
        """Return the cubic voxels over the box of a grid."""
        nk, nj, ni = (
            max(1, round(n * h / EDGE_MM))
            for n, h in zip(reversed(grid.shape), reversed(grid.spacing_mm), strict=True)
        )
        return cls(grid=grid, shape=(nk, nj, ni))

    def mean(self, image: Array) -> Float32:
        """Return the mean of an image `(ni, nj, nk)` over each cubic voxel; linear between larger voxels."""
        out: Array = image.T
        for axis in range(3):
            out = _mean_along(out, axis, self.shape[axis], float(self.grid.spacing_mm[2 - axis]))
        return np.ascontiguousarray(out)

    def sampled(self, image: Array) -> Array:
        """Return what an image `(ni, nj, nk)` holds at the middle of each cubic voxel."""
        nearest = []
        for axis in range(3):
            middles = (np.arange(self.shape[axis]) + 0.5) * EDGE_MM / self.grid.spacing_mm[2 - axis]
            nearest.append(np.minimum(middles.astype(np.int64), self.grid.shape[2 - axis] - 1))
        return np.ascontiguousarray(image.T[np.ix_(*nearest)])

    def back(self, values: Array) -> Array:
        """Return what cubic voxels `(nk, nj, ni)` hold at the voxels of the grid `(ni, nj, nk)`."""
        nearest = []
        for axis in range(3):
            middles = (np.arange(self.grid.shape[2 - axis]) + 0.5) * self.grid.spacing_mm[2 - axis] / EDGE_MM
            nearest.append(np.minimum(middles.astype(np.int64), self.shape[axis] - 1))
        return np.asfortranarray(values[np.ix_(*nearest)].T)

    def index(self, points_lps: Float) -> Int:
        """Return the indices `(N, 3)` along k, j, i of the cubic voxels at points LPS mm, kept in the box."""
        places = (self.grid.ijk(points_lps) + 0.5) * self.grid.spacing_mm / EDGE_MM
        found = np.floor(places[:, ::-1]).astype(np.int64)
        return np.clip(found, 0, np.array(self.shape) - 1)


def _mean_along(image: Array, axis: int, count: int, spacing_mm: float) -> Float32:
    source = np.moveaxis(image, axis, 0)
    made = np.zeros((count, *source.shape[1:]), dtype=np.float32)
    half_mm = 0.5 * max(EDGE_MM, spacing_mm)
    for at in range(count):
        middle_mm = (at + 0.5) * EDGE_MM
        low = max((middle_mm - half_mm) / spacing_mm, 0.0)
        high = min((middle_mm + half_mm) / spacing_mm, float(len(source)))
        for voxel in range(int(low), min(int(np.ceil(high)), len(source))):
            share = (min(voxel + 1.0, high) - max(float(voxel), low)) / (high - low)
            made[at] += np.float32(share) * source[voxel]
    return np.moveaxis(made, 0, axis)
