"""Carries the breathing of a patient with landmark pairs onto the lungs of another: the motion is borrowed.

A quadratic in the normalised height, left-right and front-back coordinates of each lung's box is fitted to
the pairs and evaluated at the same coordinates of the other lung; nothing is scaled.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from anatomy.base.typed import Float
from anatomy.grid import Grid
from anatomy.lung import Lung
from anatomy.motion.motion import Motion
from anatomy.motion.prepare import prepare_motion
from anatomy.motion.source import MotionSource
from anatomy.structures import OUTSIDE

SPACING_MM = 4.0
"""Of the carried field: a quadratic over a lung varies slowly."""
LPS_FROM_IMAGE = np.array([1.0, 1.0, -1.0])
"""The axes of the landmarks' images: x to the patient's left, y to the back, z to the feet."""


def carried(pairs: str | Path, lung: Lung) -> MotionSource:
    """Return the motion of landmark pairs as a displacement field over the lungs of another patient.

    `pairs` is a CSV of x, y, z at end-exhale and at end-inhale in mm, with the axes of `LPS_FROM_IMAGE`.
    The masks are taken to show end-exhale.
    """
    table = np.loadtxt(pairs, delimiter=",", comments="#")
    exhale, vectors = table[:, :3] * LPS_FROM_IMAGE, (table[:, 3:] - table[:, :3]) * LPS_FROM_IMAGE
    middle = 0.5 * (exhale[:, 0].min() + exhale[:, 0].max())
    grid = _grid(lung)
    at = grid.lps(np.moveaxis(np.indices(grid.shape), 0, -1)).reshape(-1, 3)
    places = lung.grid.lps(4 * np.argwhere((lung.labels[::4, ::4, ::4] & OUTSIDE) == 0))
    carina_x = float(lung.tree.carina_lps[0])
    field = np.zeros_like(at)
    for left in (False, True):
        of_pairs, of_lung, here = (
            (exhale[:, 0] > middle) == left,
            places[(places[:, 0] > carina_x) == left],
            (at[:, 0] > carina_x) == left,
        )
        known = exhale[of_pairs]
        normal = _normalised(known, known)
        coefficients = np.linalg.lstsq(_quadratic(normal), vectors[of_pairs], rcond=None)[0]
        field[here] = _quadratic(np.clip(_normalised(at[here], of_lung), 0.0, 1.0)) @ coefficients
    return MotionSource(
        description=f"borrowed: {Path(pairs).stem}, carried onto {lung.name}",
        masks_phase=0.0,
        grid=grid,
        vectors=field.reshape(*grid.shape, 3),
    )


def borrowed_motion(pairs: str | Path, lung: Lung) -> Motion:
    """Return the motion that `carried` gives, prepared for a lung."""
    return prepare_motion(carried(pairs, lung), lung.labels, lung.grid, float(lung.tree.carina_lps[0]))


def _grid(lung: Lung) -> Grid:
    corners = lung.grid.lps(np.array([(0, 0, 0), np.array(lung.grid.shape) - 1]))
    low, high = corners.min(axis=0), corners.max(axis=0)
    return Grid.from_spacing(np.ceil((high - low) / SPACING_MM).astype(int) + 1, (SPACING_MM,) * 3, low)


def _normalised(points: Float, box_of: Float) -> Float:
    low, high = box_of.min(axis=0), box_of.max(axis=0)
    return np.asarray((points - low) / (high - low))


def _quadratic(u: Float) -> Float:
    x, y, z = u.T
    return np.stack([np.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, x * z, y * z], axis=1)
