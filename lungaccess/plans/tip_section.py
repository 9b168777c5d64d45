"""The cross-section of the airway at the tip of a scope: where the lumen ends around it, and what is free."""

from __future__ import annotations

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int
from anatomy.lung import Lung
from anatomy.structures import LUMEN

DIRECTIONS = 90
"""Rays around the tip, every 4 degrees."""
RAY_STEP_MM, FARTHEST_MM = 0.05, 20.0
"""The border of the lumen is found to one step along each ray, as far as the radius of a wide trachea."""


@frozen_record
class TipSections:
    """Cross-sections at M poses of a tip, K directions each.

    Parameters
    ----------
    border_mm : (M, K) float64
        Distance from the axis of the tip to the first voxel that is no lumen, in its plane, clockwise from
        the top of the picture; 0 where the axis itself is beyond the lumen, at most `FARTHEST_MM`.
    gap_mm : (M,) float64
        Least of them minus the radius of the scope: free on the side of `nearest`.
    nearest : (M,) int64
        Direction of the least.
    depth_gap_mm : (M,) float64
        What is free all around the tip, not only in the plane, and is proved: the lower bound of the depth of
        the lumen minus the radius of the scope.
    """

    border_mm: Float
    gap_mm: Float
    nearest: Int
    depth_gap_mm: Float


def tip_sections(lung: Lung, lps_from_tip: Float, radius_mm: float) -> TipSections:
    """Return the cross-sections at poses `(M, 4, 4)` of the tip of a scope of a radius."""
    axes, up, right = lps_from_tip[:, :3, 3], lps_from_tip[:, :3, 0], lps_from_tip[:, :3, 1]
    angle = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    rays = np.cos(angle)[None, :, None] * up[:, None] + np.sin(angle)[None, :, None] * right[:, None]
    rays = rays.reshape(-1, 3)
    starts = np.repeat(axes, DIRECTIONS, axis=0)
    away = np.zeros(len(rays))
    going = np.flatnonzero(lung.labels_at(starts) & LUMEN)
    while len(going):
        away[going] += RAY_STEP_MM
        ahead = starts[going] + away[going, None] * rays[going]
        going = going[(lung.labels_at(ahead) & LUMEN) != 0]
        going = going[away[going] < FARTHEST_MM]
    border = away.reshape(-1, DIRECTIONS)
    return TipSections(
        border_mm=border,
        gap_mm=border.min(axis=1) - radius_mm,
        nearest=border.argmin(axis=1),
        depth_gap_mm=lung.lumen_depth.lower_bound_mm(axes) - radius_mm,
    )
