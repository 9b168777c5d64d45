"""The plan of all three stages: what each device does, why it is allowed, and where it came from."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Any, Self

import numpy as np

from anatomy.errors import PlanFileError
from anatomy.grid import read_only
from anatomy.typed import Array, Float, Int
from lungaccess.problem.system import System

SCHEMA = "lungaccess-plan-1"
"""Name and version of the file format; a reader refuses any other."""

_POSE: dict[str, Any] = {"shape": (4, 4)}
_POINT: dict[str, Any] = {"shape": (3,)}


class _Record:
    """Makes arrays read-only float64 (or int64) of the declared shape, and mappings read-only and sorted."""

    def __post_init__(self) -> None:
        for item in fields(self):  # type: ignore[arg-type]
            value = getattr(self, item.name)
            if "shape" in item.metadata:
                dtype = item.metadata.get("dtype", np.float64)
                value = _frozen_array(value, item.metadata["shape"], dtype, item.name)
            elif isinstance(value, Mapping):
                value = _frozen_mapping(value)
            else:
                continue
            object.__setattr__(self, item.name, value)


def _frozen_array(value: Any, shape: tuple[int | None, ...], dtype: type, name: str) -> Array:
    try:
        array: Array = np.array(value, dtype=dtype)
    except (TypeError, ValueError) as error:
        raise PlanFileError(f"{name} of a plan is not an array of numbers ({error})") from error
    if array.ndim == 1 and array.size == 0:
        array = array.reshape(tuple(n or 0 for n in shape))
    wanted = tuple(n if m is None else m for n, m in zip(array.shape, shape, strict=False))
    if array.ndim != len(shape) or array.shape != wanted:
        raise PlanFileError(
            f"{name} of a plan has the shape {array.shape}",
            expected="(" + ", ".join("N" if n is None else str(n) for n in shape) + ")",
        )
    return read_only(array)


def _frozen_mapping(value: Mapping[str, Any]) -> Mapping[str, Any]:
    return MappingProxyType(
        {key: _frozen_mapping(v) if isinstance(v, Mapping) else v for key, v in sorted(value.items())}
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class ScopeRoute(_Record):
    """Where the bronchoscope runs and where its tip stands.

    Parameters
    ----------
    points_lps : (M, 3) float64, LPS mm
        Route along the airway tree from its root in the trachea to the site.
    lumen_radius_mm : (M,) float64
        Distance from each point to the border of the lumen.
    branches : (M,) int64
        Branch of the airway tree at each point.
    lps_from_scope_tip : (4, 4) float64
        Pose of the tip at the last point; +z is forward.
    site_point : int
        Index of the tree point of the site, -1 if it lies between tree points.
    generation : int
        Generation of the last branch; the trachea is 0.
    length_mm, length_from_carina_mm : float
        Length of the route, in all and beyond the carina.
    min_lumen_margin_mm : float
        Smallest lumen radius along the route minus the radius of the scope.
    """

    points_lps: Float = field(metadata={"shape": (None, 3)})
    lumen_radius_mm: Float = field(metadata={"shape": (None,)})
    branches: Int = field(metadata={"shape": (None,), "dtype": np.int64})
    lps_from_scope_tip: Float = field(metadata=_POSE)
    site_point: int
    generation: int
    length_mm: float
    length_from_carina_mm: float
    min_lumen_margin_mm: float


@dataclass(frozen=True, kw_only=True, eq=False)
class WallExit(_Record):
    """Where the axis of the tube leaves the airway lumen.

    Parameters
    ----------
    branch : int
        Branch whose wall is pierced.
    point_lps : (3,) float64, LPS mm
    arc_length_mm : float
        Length of tube between the tip of the scope and that point.
    wall_angle_rad : float
        Angle between tube and wall; pi/2 is perpendicular.
    """

    branch: int
    point_lps: Float = field(metadata=_POINT)
    arc_length_mm: float
    wall_angle_rad: float


@dataclass(frozen=True, kw_only=True, eq=False)
class TubeDeployment(_Record):
    """How the concentric tubes are turned and inserted, and what that does.

    Parameters
    ----------
    rotation_rad : float
        Both tubes are turned by this; the inner one bends towards local (cos, sin) of the scope tip.
    outer_insertion_mm, inner_insertion_mm : float
        Lengths of outer and inner tube beyond the tip of the scope.
    lps_from_tip : (4, 4) float64
        Pose of the tip of the inner tube; +z is forward.
    exit : WallExit
    lateral_sweep_mm : float
        Largest sideways motion of the tubes while they are deployed.
    follow_the_leader_error_mm : float
        Largest distance between the path of the tip and the final shape.
    """

    rotation_rad: float
    outer_insertion_mm: float
    inner_insertion_mm: float
    lps_from_tip: Float = field(metadata=_POSE)
    exit: WallExit
    lateral_sweep_mm: float
    follow_the_leader_error_mm: float


@dataclass(frozen=True, kw_only=True, eq=False)
class NeedleArc(_Record):
    """One arc: turn by `roll_rad` about the axis, then insert `length_mm`, bending towards local +x.

    The turn stays in the frame: the next roll starts from it.
    """

    length_mm: float
    roll_rad: float
    curvature_per_mm: float


@dataclass(frozen=True, kw_only=True, eq=False)
class NeedlePath(_Record):
    """The arcs of the steerable needle, from the tip of the tube to the target.

    Parameters
    ----------
    lps_from_start : (4, 4) float64
        Pose of the needle where it leaves the tube.
    arcs : tuple of NeedleArc
    end_lps : (3,) float64, LPS mm
    length_mm : float
    max_angle_from_start_rad : float
        Largest angle between the needle and its start direction.
    accumulated_turn_rad : float
        Sum of the angles of all arcs.
    """

    lps_from_start: Float = field(metadata=_POSE)
    arcs: tuple[NeedleArc, ...]
    end_lps: Float = field(metadata=_POINT)
    length_mm: float
    max_angle_from_start_rad: float
    accumulated_turn_rad: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Exemption(_Record):
    """The one obstacle that may be touched: the wall of the pierced branch.

    It holds for the tube and for the first `needle_length_mm` of the needle.
    """

    branch: int
    exit_point_lps: Float = field(metadata=_POINT)
    needle_length_mm: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan(_Record):
    """One plan: scope route, tube deployment and needle arcs, with costs, margins and provenance.

    Parameters
    ----------
    schema : str
        `SCHEMA`.
    software_version : str
    patient_name, lung_key : str
        The patient, and the content hash of the lung planned on.
    sources : mapping of str to str
        SHA-256 of every image file.
    breath_hold : str or None
        In which breath-hold the image was taken.
    system : System
    system_fingerprint : str
        SHA-256 of the system's settings.
    target_lps : (3,) float64, LPS mm
    target_origin : str
        Where the target came from; starts with "nodule" if it is the nodule mask.
    fissures_are_obstacles : bool
    objective : str
        What was minimised: a key of `costs`; see `stages.needle.objective.Objective`.
    scope, tube, needle
        The three stages.
    exemption : Exemption
    required_clearance_mm : mapping of str to float
        Radius plus margins of "outer_tube", "inner_tube" and "needle".
    clearance_mm : mapping of str to mapping of str to float
        For "tube" and "needle": smallest distance of the axis from each structure ("airway", "vessel",
        "outside", "fissure"; voxels as solid boxes) where it must be kept.  A structure may be left out.
    costs : mapping of str to float
        "inverse_clearance", "cost_map", "voxel_sum" and "length_mm" of the needle, and the cost under the
        objective where that is a weighted sum; a plan of an earlier version may lack "voxel_sum".
    method : str
    seed, iterations : int
    timing : mapping of str to float
        Seconds; the only values that differ between two equal runs.
    """

    schema: str = SCHEMA
    software_version: str
    patient_name: str
    lung_key: str
    sources: Mapping[str, str]
    breath_hold: str | None
    system: System
    system_fingerprint: str
    target_lps: Float = field(metadata=_POINT)
    target_origin: str
    fissures_are_obstacles: bool
    objective: str
    scope: ScopeRoute
    tube: TubeDeployment
    needle: NeedlePath
    exemption: Exemption
    required_clearance_mm: Mapping[str, float]
    clearance_mm: Mapping[str, Mapping[str, float]]
    costs: Mapping[str, float]
    method: str
    seed: int
    iterations: int
    timing: Mapping[str, float]

    def _repr_html_(self) -> str:
        """Return what a notebook shows."""
        from lungaccess.plans.display import plan_html

        return plan_html(self)

    @property
    def cost(self) -> float:
        """Cost under the plan's own objective."""
        return float(self.costs[self.objective])

    @property
    def digest(self) -> str:
        """SHA-256 (hex) of the canonical JSON of everything except `timing`."""
        from lungaccess.plans import file as plan_file

        return plan_file.digest(self)

    def to_json(self) -> str:
        """Return the plan as JSON text, with its digest; `from_json` restores it without loss.

        Raises
        ------
        PlanFileError
            If a number is not finite.
        """
        from lungaccess.plans import file as plan_file

        return plan_file.to_json(self)

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Return the plan that `to_json` wrote.

        Raises
        ------
        PlanFileError
            If the text is no JSON, of another schema, incomplete, or not what its digest was made from.
        """
        from lungaccess.plans import file as plan_file

        return plan_file.from_json(cls, text)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the plan to `path`, all or nothing.

        Raises
        ------
        FileError
            If the file cannot be written.
        PlanFileError
            If a number is not finite.
        """
        from lungaccess.plans import file as plan_file

        plan_file.save(self, path)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read a plan from `path`.

        Raises
        ------
        PlanFileError
            If there is no such file or it is not an intact plan.
        """
        from lungaccess.plans import file as plan_file

        return plan_file.load(cls, path)
