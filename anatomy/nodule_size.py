"""The size of a nodule as radiologists state it: volume, long axis and the diameter across it."""

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Int
from anatomy.grid import Grid

DIRECTIONS = 180
"""Diameters are measured in so many directions of a half turn."""


@frozen_record
class NoduleSize:
    """Volume of a nodule, its greatest diameter in an axial slice, and its width across that in the slice."""

    volume_ml: float
    long_axis_mm: float
    perpendicular_mm: float


def nodule_size(voxels: Int, grid: Grid) -> NoduleSize:
    """Measure a nodule's voxels `(N, 3)`, as wide as the mean of their sides, in slices across feet-head."""
    through = int(np.argmax(np.abs(grid.lps_from_ijk[2, :3]) / grid.spacing_mm))
    angles = np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    along = grid.lps(voxels)[:, :2] @ np.stack([np.cos(angles), np.sin(angles)])
    long_mm, across_mm = 0.0, 0.0
    for k in np.unique(voxels[:, through]):
        widths = np.ptp(along[voxels[:, through] == k], axis=0)
        longest = int(np.argmax(widths))
        if widths[longest] >= long_mm:
            long_mm, across_mm = (
                float(widths[longest]),
                float(widths[(longest + DIRECTIONS // 2) % DIRECTIONS]),
            )
    side_mm = float(np.delete(grid.spacing_mm, through).mean())
    return NoduleSize(
        volume_ml=len(voxels) * grid.voxel_volume_mm3 / 1000.0,
        long_axis_mm=long_mm + side_mm,
        perpendicular_mm=across_mm + side_mm,
    )
