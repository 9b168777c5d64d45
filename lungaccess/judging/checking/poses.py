"""Comparison of poses and directions."""

import numpy as np

from anatomy.base.typed import Float
from lungaccess.judging.checking.findings import Findings

POSITION_TOLERANCE_MM = 1e-3
"""Closed form and integration agree far better; a device cannot be placed to a micrometre."""
ANGLE_TOLERANCE_RAD = 1e-4
"""Over 100 mm of needle an angle of this size moves the tip by 0.01 mm."""
LENGTH_TOLERANCE_MM = 1e-6
"""Lengths are sums of a few numbers and agree up to rounding."""


def angle_between(a: Float, b: Float) -> Float:
    """Return the angles in rad between vectors `(..., 3)`, accurate for small ones too."""
    sine = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.asarray(np.arctan2(sine, (a * b).sum(axis=-1)))


def check_rigid(name: str, pose: Float, found: Findings) -> bool:
    """Record whether a 4x4 matrix is a rigid, right-handed pose."""
    rotation = pose[:3, :3]
    error = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    # Rounding of a matrix that is the product of a hundred rotations is less by far.
    rigid = error <= 1e-6 and float(np.linalg.det(rotation)) > 0.0
    rigid &= bool(np.array_equal(pose[3], [0.0, 0.0, 0.0, 1.0]))
    return found.true(f"{name}.rigid", rigid, f"deviation from a rotation {error:.2g}")


def check_same_pose(name: str, stated: Float, recomputed: Float, found: Findings) -> None:
    """Record whether two poses agree in position and in every axis."""
    found.agrees(f"{name}.position", stated[:3, 3], recomputed[:3, 3], POSITION_TOLERANCE_MM, "mm")
    gap = float(angle_between(stated[:3, :3].T, recomputed[:3, :3].T).max())
    found.at_most(f"{name}.direction", gap, ANGLE_TOLERANCE_RAD, "rad", "largest angle between the axes")
