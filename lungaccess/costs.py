"""What a needle path costs: 1 / clearance, the cost map, length."""

from __future__ import annotations

import numpy as np

from anatomy.errors import SettingsError
from anatomy.grid import Float
from anatomy.lung import Lung
from anatomy.structures import FISSURE, OBSTACLES
from stages.needle.kernels.cost import CLEARANCE_FLOOR_MM
from stages.needle.path import ArcPath

OBJECTIVES = ("inverse_clearance", "cost_map", "length_mm")

SAMPLE_MM = 0.1
EXACT_BELOW_VOXELS = 8.0
"""Nearer than so many of the longest voxel sides, distances are exact; farther, the clearance field's lower
bound is less than 0.6 % off."""


def require_objective(objective: str) -> None:
    """Raise SettingsError unless the objective is known."""
    if objective not in OBJECTIVES:
        raise SettingsError(
            f"There is no objective {objective!r}", expected=f"one of {', '.join(OBJECTIVES)}"
        )


def path_cost(lung: Lung, path: ArcPath, objective: str, *, with_fissures: bool) -> float:
    """Return the cost of a needle path.

    Parameters
    ----------
    lung : Lung
    path : ArcPath
    objective : str
        "inverse_clearance": integral of 1 / clearance over arc length, clearance being that of the
        needle's axis to the nearest obstacle, no less than 0.1 mm [Kuntz2015, eq. 1].  "cost_map":
        line integral of the cost map in mm, 0 without a map.  "length_mm".
    with_fissures : bool
        Whether fissures are obstacles.
    """
    if objective == "length_mm":
        return path.length_mm
    points, lengths = path.sample(SAMPLE_MM)
    if objective == "cost_map":
        return _cost_map_integral(lung, points, lengths)
    clearance = obstacle_clearance_mm(lung, points, with_fissures=with_fissures)
    weight = 1.0 / np.maximum(clearance, CLEARANCE_FLOOR_MM)
    return float(np.trapezoid(weight, lengths))


def obstacle_clearance_mm(lung: Lung, points: Float, *, with_fissures: bool) -> Float:
    """Return the distance `(N,)` in mm from points to the nearest obstacle, voxels as solid boxes."""
    clearance = lung.obstacle_field(with_fissures=with_fissures).lower_bound_mm(points)
    exact_below_mm = EXACT_BELOW_VOXELS * float(lung.grid.spacing_mm.max())
    near = np.flatnonzero(clearance < exact_below_mm)
    bits = OBSTACLES | (FISSURE if with_fissures else 0)
    found = lung.exact_clearance_mm(points[near], bits, cap_mm=1.2 * exact_below_mm)
    clearance[near] = np.maximum(found, clearance[near])
    return clearance


def _cost_map_integral(lung: Lung, points: Float, lengths: Float) -> float:
    """Integrate the cost map by the midpoint rule on the voxel that holds each midpoint."""
    if lung.cost is None:
        return 0.0
    middle = 0.5 * (points[1:] + points[:-1])
    ijk = np.floor(lung.grid.ijk(middle) + 0.5).astype(np.int64)
    if ((ijk < 0) | (ijk >= lung.grid.shape)).any():
        return float("inf")
    return float((lung.cost.array[tuple(ijk.T)].astype(np.float64) * np.diff(lengths)).sum())
