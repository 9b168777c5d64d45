"""Bits of a voxel's uint16 label, one a structure; above them is the number of the airway branch."""

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
