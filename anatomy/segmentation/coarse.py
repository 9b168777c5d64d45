"""A CT on coarse voxels with axes along LPS, where decisions about the whole chest are cheap."""

from typing import Self

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Array, Float, Float32, Int, Mask
from anatomy.grid import Grid, Volume
from anatomy.morphology import bounds

COARSE_MM = 1.5
"""Blocks of voxels come as near to this size as whole numbers of voxels allow."""
LEAST_HU = -1200
"""Air that is shifted by 100 HU with its noise is above; scanners write lower values where they measured
nothing."""


@frozen_record
class CoarseCt:
    """Means over blocks of the voxels of a CT in the order of `canonical`: to the left, the back, and up.

    `hu` `(Ni, Nj, Nk)` is not below -1200; `fine_shape` is that of the CT, and `step` the voxels of a block.
    """

    hu: Float32
    grid: Grid
    fine_shape: tuple[int, int, int]
    step: tuple[int, int, int]

    @classmethod
    def of(cls, ct: Volume) -> Self:
        """Average the blocks of a CT; blocks at the end may hold fewer voxels."""
        step = tuple(max(1, round(COARSE_MM / float(s))) for s in ct.grid.spacing_mm)
        blocks = _block_means(ct.array, step)
        matrix = ct.grid.lps_from_ijk.copy()
        matrix[:3, :3] = matrix[:3, :3] * step
        matrix[:3, 3] = ct.grid.lps((np.asarray(step) - 1) / 2)
        grid = Grid(shape=blocks.shape, lps_from_ijk=matrix)
        return cls(hu=blocks, grid=grid, fine_shape=ct.grid.shape, step=(step[0], step[1], step[2]))

    @property
    def spacing_mm(self) -> tuple[float, float, float]:
        """Size of a block along the axes here."""
        a, b, c = (float(s) for s in self.grid.spacing_mm)
        return a, b, c

    @property
    def voxel_ml(self) -> float:
        """Volume of a block."""
        return self.grid.voxel_volume_mm3 / 1000.0

    def to_ct(self, blocks: Array, low: Int, high: Int) -> Array:
        """Return the values of the blocks that the CT's voxels `low <= ijk < high` lie in."""
        # Transposed, so that the last pass, over the most voxels, copies whole planes.
        values = np.ascontiguousarray(blocks.T)
        for axis in range(3):
            values = np.take(values, np.arange(low[axis], high[axis]) // self.step[axis], axis=2 - axis)
        return values.T

    def box_in_ct(self, mask: Mask, pad_mm: float) -> tuple[Int, Int]:
        """Return `low` and `high` of the CT's voxels around a mask of blocks, wider by `pad_mm`."""
        low, high = bounds(mask)
        step = np.asarray(self.step)
        pad = np.ceil(pad_mm / (np.asarray(self.spacing_mm) / step)).astype(np.int64)
        return np.maximum(low * step - pad, 0), np.minimum(high * step + pad, self.fine_shape)

    def ct_voxel(self, block: Int) -> Int:
        """Return the voxel of the CT in the middle of a block."""
        middle = np.asarray(block) * self.step + np.asarray(self.step) // 2
        return np.asarray(np.minimum(middle, np.asarray(self.fine_shape) - 1), dtype=np.int64)

    def block(self, lps: Float) -> tuple[int, int, int] | None:
        """Return the block that a point lies in, or None outside the CT."""
        i, j, k = (int(n) for n in self.grid.voxels(lps))
        return (i, j, k) if bool(self.grid.contains(lps)) else None


def _block_means(values: Array, step: tuple[int, ...]) -> Float32:
    shape = tuple(-(-n // s) for n, s in zip(values.shape, step, strict=True))
    total = np.zeros(shape, dtype=np.float32, order="F")
    count = np.zeros(shape, dtype=np.float32, order="F")
    for offset in np.ndindex(*step):
        part = values[tuple(slice(first, None, s) for first, s in zip(offset, step, strict=True))]
        where = tuple(slice(0, n) for n in part.shape)
        total[where] += np.maximum(part, LEAST_HU)
        count[where] += 1.0
    total /= count
    return total
