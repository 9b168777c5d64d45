"""A wall for airways that came without one."""

from __future__ import annotations

import numpy as np

from anatomy.grid import Grid
from anatomy.morphology import bounds
from anatomy.segmentation.box import Box
from anatomy.segmentation.closing import distance_mm
from anatomy.typed import Mask

WALL_MM = 1.5
"""Walls of lobar bronchi are 1 to 1.5 mm thick; those of thinner ones less."""


def wall_around(lumen: Mask, grid: Grid) -> Mask:
    """Return the wall of airways that came without one: all within `WALL_MM` of the lumen."""
    low, high = bounds(lumen, np.ceil(WALL_MM / grid.spacing_mm).astype(np.int64) + 1)
    box = Box(grid=grid, low=low, high=high)
    inside = box.cut(lumen)
    return box.whole((distance_mm(~inside, grid.spacing_mm) <= WALL_MM) & ~inside)
