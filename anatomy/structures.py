"""Names and bits of the structures in a lung's label volume; `anatomy.kernels.labels` has the bits."""

import numpy as np

from anatomy.base.typed import Labels
from anatomy.kernels.labels import AIRWAY, BRANCH_SHIFT, FISSURE, LUMEN, OUTSIDE, VESSEL

__all__ = (
    "AIRWAY", "BITS", "BRANCH_SHIFT", "FIELD_BITS", "FISSURE", "LUMEN", "MAX_BRANCHES", "OBSTACLES",
    "OUTSIDE", "VESSEL", "close_border", "obstacle_bits",
)  # fmt: skip

MAX_BRANCHES = (1 << (16 - BRANCH_SHIFT)) - 1
"""Most branches that a label can tell apart."""

OBSTACLES = AIRWAY | VESSEL | OUTSIDE
"""A needle must always avoid these."""

BITS: dict[str, int] = {
    "airway": AIRWAY, "vessel": VESSEL, "outside": OUTSIDE, "fissure": FISSURE, "lumen": LUMEN,
}  # fmt: skip

FIELD_BITS: dict[str, int] = {
    "airway": AIRWAY, "vessel": VESSEL, "pleura": OUTSIDE, "fissure": FISSURE, "obstacle": OBSTACLES,
    "obstacle_fissure": OBSTACLES | FISSURE,
}  # fmt: skip
"""Clearance fields of a lung, and the structures each measures the distance to."""


def obstacle_bits(with_fissures: bool) -> int:
    """Return the bits of the structures that a needle must avoid, fissures among them or not."""
    return OBSTACLES | FISSURE if with_fissures else OBSTACLES


def close_border(labels: Labels) -> None:
    """Make the outermost voxels OUTSIDE: distances know nothing of what lies beyond the grid."""
    for axis in range(3):
        np.moveaxis(labels, axis, 0)[[0, -1]] |= OUTSIDE
