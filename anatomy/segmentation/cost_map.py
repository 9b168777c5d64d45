"""The pulmonary cost map [Fu2018]: what it costs a needle to cross a voxel, infinite in obstacles."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from anatomy.base.errors import GridMismatchError
from anatomy.base.typed import Mask
from anatomy.grid import Grid, Volume

if TYPE_CHECKING:
    from anatomy.segmentation.airway import Airways
    from anatomy.segmentation.vessels import Vessels


def cost_map(vessels: Vessels, airways: Airways, lung_mask: Mask, grid: Grid) -> Volume:
    """Return M_cost [Fu2018, sec. IV-A]: infinite in obstacles, elsewhere the vesselness, 0 to 1.

    Obstacles are all voxels outside the lungs, which are filled, the lumen and wall of the airways, and the
    large vessels.  They are not grown: the planners keep their clearance by a proved distance.  Raises
    GridMismatchError if a mask has another shape.
    """
    parts = {
        "vesselness": vessels.vesselness,
        "large vessels": vessels.large,
        "lumen": airways.lumen,
        "wall": airways.wall,
        "lung": lung_mask,
    }
    for name, part in parts.items():
        if part.shape != grid.shape:
            raise GridMismatchError(
                f"The {name} has the shape {part.shape}", expected=f"that of the grid, {grid.shape}"
            )
    barred = ~lung_mask | airways.lumen | airways.wall | vessels.large
    values = np.clip(vessels.vesselness, np.float32(0.0), np.float32(1.0))
    return Volume(grid=grid, array=np.where(barred, np.float32(np.inf), values))
