"""Cost maps in files: obstacles have a finite cost there, because some programs read infinity as 0."""

from __future__ import annotations

import numpy as np

from anatomy.base.typed import Array, Float32

OBSTACLE_COST = 1000.0
"""What a file holds where passing is forbidden: finite, exact in every type, and far from costs of 0 to 1."""
NOTE = f"cost of passing a voxel, 0 to 1; {OBSTACLE_COST:g} is an obstacle"
"""What the header of the file says."""


def as_stored(cost: Float32) -> Float32:
    """Return a cost map as files hold it: `OBSTACLE_COST` in place of infinity."""
    return np.where(np.isposinf(cost), np.float32(OBSTACLE_COST), cost)


def from_stored(values: Array) -> Float32:
    """Return the cost map that a file holds as float32; files may also hold infinity."""
    cost: Float32 = values.astype(np.float32)
    return np.where(cost == np.float32(OBSTACLE_COST), np.float32(np.inf), cost)
