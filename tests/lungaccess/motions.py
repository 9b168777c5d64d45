"""A motion of a patient, by a formula."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from anatomy.base.typed import Float
from anatomy.grid import Grid
from anatomy.motion.motion import Motion

NODE_MM = 5.0


def motion_by(
    lung: Any, displacement: Callable[[Float], Float], *, masks_phase: float = 0.0, **changes: Any
) -> Motion:
    """Return the motion whose displacements `(..., 3)` are a function of places `(..., 3)`, LPS mm."""
    corners = lung.grid.lps(np.array([(0, 0, 0), np.array(lung.labels.shape) - 1]))
    low, high = corners.min(axis=0) - 10.0, corners.max(axis=0) + 10.0
    grid = Grid.from_spacing(np.ceil((high - low) / NODE_MM).astype(int) + 1, (NODE_MM,) * 3, low)
    d = displacement(grid.lps(np.moveaxis(np.indices(grid.shape), 0, -1)))
    values = {
        "grid": grid, "nodes": np.stack([d, d]), "middle_x_mm": 0.0, "masks_phase": masks_phase,
        "amplitude": 1.0, "source": "made for a test", "warning_only": False, "figures": {},
    }  # fmt: skip
    return Motion(**values | changes)
