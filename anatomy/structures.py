"""Names and bits of the structures in a lung's label volume.

Every voxel of a lung carries one `uint16`: a bit for each structure it belongs to and, for airway
voxels, the number of its branch.
"""

from __future__ import annotations

AIRWAY = 1
"""Airway lumen or wall."""
VESSEL = 2
"""Artery or vein."""
OUTSIDE = 4
"""Not lung: mediastinum, chest wall, diaphragm, the septum between two touching lungs."""
FISSURE = 8
"""Between two lobes: crossing it pierces the pleura twice."""
LUMEN = 16
"""Airway lumen; such a voxel is AIRWAY too."""

BRANCH_SHIFT = 5
"""`(label >> BRANCH_SHIFT) - 1` is the branch of an airway voxel in the airway tree, -1 for none."""
MAX_BRANCHES = (1 << (16 - BRANCH_SHIFT)) - 2

OBSTACLES = AIRWAY | VESSEL | OUTSIDE
"""What a needle must always avoid; fissures are added unless they are allowed."""

BITS: dict[str, int] = {
    "airway": AIRWAY,
    "vessel": VESSEL,
    "outside": OUTSIDE,
    "fissure": FISSURE,
    "lumen": LUMEN,
}

FIELD_BITS: dict[str, int] = {
    "airway": AIRWAY,
    "vessel": VESSEL,
    "pleura": OUTSIDE,
    "fissure": FISSURE,
    "obstacle": OBSTACLES,
    "obstacle_fissure": OBSTACLES | FISSURE,
}
"""Clearance fields of a lung, and the structures each measures the distance to."""
