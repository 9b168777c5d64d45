"""The box around the lungs and trachea, in which the slower steps run."""

from __future__ import annotations

import numpy as np

from anatomy.grid import Grid, Volume
from anatomy.morphology import bounds, window
from anatomy.records import frozen_record
from anatomy.segmentation.lungs import Lungs
from anatomy.typed import Array, Int

BOX_PAD_MM = 10.0
"""More than any filter of the segmentation looks beyond a voxel of the lung."""


@frozen_record
class Box:
    """The voxels `low <= ijk < high` of a whole grid; both ends `(3,)` int64."""

    grid: Grid
    low: Int
    high: Int

    @classmethod
    def around(cls, lungs: Lungs, grid: Grid) -> Box:
        """Return the box of lungs and central airway, 10 mm wider where the image allows."""
        parts = [bounds(mask) for mask in (lungs.left, lungs.right, lungs.central_airway) if mask.any()]
        pad = np.ceil(BOX_PAD_MM / grid.spacing_mm).astype(np.int64)
        low = np.maximum(np.min([low for low, _ in parts], axis=0) - pad, 0)
        high = np.minimum(np.max([high for _, high in parts], axis=0) + pad, grid.shape)
        return cls(grid=grid, low=low, high=high)

    @property
    def inner(self) -> Grid:
        """The grid of the box."""
        return self.grid.crop(self.low, self.high)

    def cut(self, array: Array) -> Array:
        """Copy the part of an array in the box."""
        return np.array(array[window(self.low, self.high)], order="F")

    def volume(self, volume: Volume) -> Volume:
        """Return the part of a volume in the box."""
        return Volume(grid=self.inner, array=self.cut(volume.array))

    def lungs(self, lungs: Lungs) -> Lungs:
        """Return lungs on the grid of the box."""
        return Lungs(
            left=self.cut(lungs.left),
            right=self.cut(lungs.right),
            trachea_seed_ijk=lungs.trachea_seed_ijk - self.low,
            central_airway=self.cut(lungs.central_airway),
            threshold_hu=lungs.threshold_hu,
            offset_hu=lungs.offset_hu,
            warnings=lungs.warnings,
        )

    def whole(self, part: Array, fill: float = 0) -> Array:
        """Return an array on the whole grid that holds `part` in the box, and `fill` elsewhere."""
        whole = np.full(self.grid.shape, fill, dtype=part.dtype, order="F")
        whole[window(self.low, self.high)] = part
        return whole
