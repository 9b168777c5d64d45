"""A wall for airways that came without one."""

from __future__ import annotations

import numpy as np

from anatomy.base.typed import Mask
from anatomy.grid import Grid
from anatomy.morphology import bounds, window
from anatomy.segmentation.closing import distance_mm

WALL_MM = 1.5
"""Walls of lobar bronchi are 1 to 1.5 mm thick; those of thinner ones less."""


def wall_around(lumen: Mask, grid: Grid) -> Mask:
    """Return the wall of airways that came without one: all within `WALL_MM` of the lumen."""
    box = window(*bounds(lumen, np.ceil(WALL_MM / grid.spacing_mm).astype(np.int64) + 1))
    wall = np.zeros(lumen.shape, dtype=np.bool_, order="F")
    wall[box] = (distance_mm(~lumen[box], grid.spacing_mm) <= WALL_MM) & ~lumen[box]
    return wall
