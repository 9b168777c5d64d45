"""What a needle path costs in a lung: 1 / clearance, the cost map, length."""

from __future__ import annotations

from anatomy.errors import SettingsError
from anatomy.lung import Lung
from anatomy.structures import obstacle_bits
from anatomy.typed import Float
from lungaccess.problem.suggestion import did_you_mean
from stages.needle import ArcPath, SpaceArrays, costs

OBJECTIVES = ("inverse_clearance", "cost_map", "voxel_sum", "length_mm")


def require_objective(objective: str) -> None:
    """Raise SettingsError unless the objective is known."""
    if objective not in OBJECTIVES:
        raise SettingsError(
            f"There is no objective {objective!r}",
            expected=f"one of {', '.join(OBJECTIVES)}",
            remedy=did_you_mean(objective, OBJECTIVES),
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
        line integral of the cost map in mm, 0 without a map.  "voxel_sum": sum of the cost map over the
        set of voxels crossed, 0 without a map [Fu2018, eq. 1].  "length_mm".
    with_fissures : bool
        Whether fissures are obstacles.
    """
    if objective == "length_mm":
        return path.length_mm
    if objective == "cost_map":
        return costs.map_integral(lung.cost, path)
    if objective == "voxel_sum":
        return costs.voxel_sum(lung.cost, path)
    return costs.inverse_clearance(_obstacles(lung, with_fissures), path)


def obstacle_clearance_mm(lung: Lung, points: Float, *, with_fissures: bool) -> Float:
    """Return the distance `(N,)` in mm from points to the nearest obstacle, voxels as solid boxes."""
    return costs.obstacle_clearance_mm(_obstacles(lung, with_fissures), points)


def _obstacles(lung: Lung, with_fissures: bool) -> SpaceArrays:
    """Return the arrays of a lung as a `NeedleSpace` holds them."""
    bits = obstacle_bits(with_fissures)
    return lung.obstacle_field(with_fissures=with_fissures).corners, lung.labels, lung.geometry, bits
