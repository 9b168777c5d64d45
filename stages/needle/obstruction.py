"""Why a query has no path: what stands in the way, where, and by how much."""

import math
from dataclasses import replace

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.morphology import voxels_in
from stages.needle.environment import NeedleEnvironment
from stages.needle.kernels import obstruction as kernels
from stages.needle.kernels.connections import seen_from
from stages.needle.kernels.goal_ball import workspace_length
from stages.needle.kernels.proof import Limits, exact_gap
from stages.needle.path import Query, pose_at

SAME_SHARE = 1e-6
"""A radius is found to this share of itself, and limits may be exceeded by it through rounding."""
NEAR_MM = 1e-3
"""Targets outside the workspace by less are not ruled out by it, for the sake of rounding."""


@frozen_record
class Obstruction:
    """What stands in the way of a needle.

    Args:
        place: "reach": the target lies outside the needle's workspace, whatever the obstacles.  "start":
            all paths are blocked at the beginning.  "target": no needle may end there.  "path": neither.
        proved: Whether this alone proves that there is no path.
        label: Of the obstacle voxel that is too near; 0 for "reach".
        point_lps ((3,) float64, LPS mm): The blocked point of the needle's axis: for "path", the tightest
            place of the easiest path that was tried; for "reach", the target.
        obstacle_lps ((3,) float64 or None, LPS mm): The nearest point of what is too near; None for "reach".
        inserted_mm: Length of the needle there, where it is known.
        distance_mm, needed_mm: From that voxel; None for "reach".
        limit: For "reach": "radius", "angle", "turn" or "length".
        radius_mm: For "reach": the largest radius of curvature that would reach the target, None if none.
        direction_rad, straight_mm: Direction of the target off straight ahead, and its distance.
    """

    place: str
    proved: bool
    label: int
    point_lps: Float
    obstacle_lps: Float | None = None
    inserted_mm: float | None = None
    distance_mm: float | None = None
    needed_mm: float | None = None
    limit: str = ""
    radius_mm: float | None = None
    direction_rad: float
    straight_mm: float


def find_obstruction(environment: NeedleEnvironment, query: Query) -> Obstruction | None:
    """Return what rules out all paths at once by reach, at the start or at the target; None if nothing does.

    Only a target out of reach may be so without proof: with a goal tolerance, or wide limits of turning.
    """
    found = _reach(environment, query) or blocked_end(environment, query)
    return found and _with_obstacle(environment, found)


def blocked_end(environment: NeedleEnvironment, query: Query) -> Obstruction | None:
    """Return what proves that no path leaves the start or none ends at the target; None if nothing does.

    It is without `obstacle_lps`, which takes longest.
    An environment whose paths are looked up instead of proved has no such proof.
    """
    if environment.limits.lookup_step_mm > 0.0:
        return None
    return _start(environment, query) or _target(environment, query)


def easiest_obstruction(environment: NeedleEnvironment, query: Query) -> Obstruction | None:
    """Return the tightest place of the easiest of some trial paths; None if there is none or it is free."""
    found = np.zeros(kernels.FOUND_SIZE)
    # Paths that are tried for the easiest one: some milliseconds.
    label, tried = kernels.easiest_trial(
        environment.obstacles, environment.limits, pose_at(query.lps_from_start), query.inserted_mm,
        query.branch, query.goal, 256, np.zeros(1, dtype=np.uint64), np.zeros(kernels.FOUND_SIZE), found,
    )  # fmt: skip
    if not tried or not label or found[kernels.DISTANCE] >= found[kernels.NEEDED]:
        return None
    return _with_obstacle(environment, _found("path", False, label, found, query))


def _seen(query: Query) -> tuple[float, float]:
    rho, h = seen_from(pose_at(query.lps_from_start), query.goal)
    return float(rho), float(h)


def _with_obstacle(environment: NeedleEnvironment, found: Obstruction) -> Obstruction:
    """Add the nearest point of the voxels that are too near."""
    if found.distance_mm is None:
        return found
    grid, point = environment.grid, found.point_lps
    part = grid.window(point, found.distance_mm + float(grid.spacing_mm.max()))
    voxels = voxels_in(part, environment.obstacles.labels[part] == found.label)
    if not len(voxels):
        return found
    half = environment.obstacles.geometry[:, 5]
    nearest = np.clip(grid.ijk(point), voxels - half, voxels + half)
    at = int(np.argmin(np.linalg.norm(grid.lps(nearest) - point, axis=1)))
    return replace(found, obstacle_lps=np.asarray(grid.lps(nearest[at])))


def _found(place: str, proved: bool, label: int, found: Float, query: Query) -> Obstruction:
    rho, h = _seen(query)
    return Obstruction(
        place=place,
        proved=proved,
        label=int(label),
        point_lps=found[: kernels.INSERTED].copy(),
        inserted_mm=float(found[kernels.INSERTED]) if place != "target" else None,
        distance_mm=float(found[kernels.DISTANCE]),
        needed_mm=float(found[kernels.NEEDED]),
        direction_rad=math.atan2(rho, h),
        straight_mm=math.hypot(rho, h),
    )


def _reach(environment: NeedleEnvironment, query: Query) -> Obstruction | None:
    """Tell whether the target lies outside the workspace, and which limit keeps it there."""
    # The limits less what is behind the start.  The angle counts from the reference: where that is another
    # direction, nothing is taken from the angle.
    limits = environment.limits._replace(
        max_length_mm=environment.limits.max_length_mm - query.inserted_mm,
        max_turn_rad=environment.limits.max_turn_rad - query.turned_rad,
        max_angle_rad=environment.limits.max_angle_rad if query.reference is None else math.pi,
    )
    rho, h = _seen(query)
    far = math.hypot(rho, h)
    tolerance = environment.goal_tolerance_mm
    if far <= tolerance or _reaches(rho, h, limits):
        return None
    if far - tolerance > limits.max_length_mm or _reaches(rho, h, limits._replace(max_length_mm=math.inf)):
        limit = "length"
    elif math.atan2(rho, h) > limits.max_angle_rad:
        limit = "angle"
    elif math.atan2(rho, h) > limits.max_turn_rad:
        limit = "turn"
    else:
        limit = "radius"
    return Obstruction(
        place="reach",
        proved=_rules_out(rho, h, tolerance, limit, limits),
        label=0,
        point_lps=np.array(query.target),
        limit=limit,
        radius_mm=_largest_radius(rho, h, limits) if limit == "radius" else None,
        direction_rad=math.atan2(rho, h),
        straight_mm=far,
    )


def _rules_out(rho: float, h: float, tolerance_mm: float, limit: str, limits: Limits) -> bool:
    """Tell whether it is proved that no path ends within the tolerance of a target outside the workspace.

    That holds for targets farther than the needle is long; for those behind the start, if paths never turn
    back; for those in the torus of tightest circles by more than the tolerance, if paths turn by 180 degrees
    at most; and without a tolerance where the workspace is exact: see docs/theory/proofs.md, "Workspace".
    """
    if math.hypot(rho, h) - tolerance_mm > limits.max_length_mm:
        return True
    radius = 1.0 / limits.kappa
    inside = radius - math.hypot(radius - rho, h) > tolerance_mm + NEAR_MM
    if limit == "radius" and inside and limits.max_turn_rad <= math.pi * (1.0 + SAME_SHARE):
        return True
    if h < -tolerance_mm - NEAR_MM and min(limits.max_angle_rad, limits.max_turn_rad) <= 0.5 * math.pi:
        return True
    return tolerance_mm == 0.0 and limits.max_angle_rad <= 0.5 * math.pi * (1.0 + SAME_SHARE)


def _reaches(rho: float, h: float, limits: Limits) -> bool:
    return bool(workspace_length(rho, h, limits) < math.inf)


def _largest_radius(rho: float, h: float, limits: Limits) -> float | None:
    """Return the largest radius of curvature with which a target is reached, rounded down; None if none."""
    low, high = 1.0, 1.0 / limits.kappa
    if not _reaches(rho, h, limits._replace(kappa=1.0 / low)):
        return None
    while high - low > SAME_SHARE * high:
        middle = 0.5 * (low + high)
        if _reaches(rho, h, limits._replace(kappa=1.0 / middle)):
            low = middle
        else:
            high = middle
    return low


def _start(environment: NeedleEnvironment, query: Query) -> Obstruction | None:
    rho, h = _seen(query)
    longest = math.hypot(rho, h) - environment.goal_tolerance_mm
    found = np.zeros(kernels.FOUND_SIZE)
    label = kernels.blocked_start(
        environment.obstacles, environment.limits, pose_at(query.lps_from_start), query.inserted_mm, longest,
        query.branch, found,
    )  # fmt: skip
    return _found("start", True, label, found, query) if label else None


def _target(environment: NeedleEnvironment, query: Query) -> Obstruction | None:
    """Tell whether every point at which a path may end is too near to an obstacle."""
    rho, h = _seen(query)
    if math.hypot(rho, h) - environment.goal_tolerance_mm < environment.limits.exempt_mm - query.inserted_mm:
        return None
    x, y, z = query.goal
    beyond = environment.limits.exempt_mm
    _gap, label, distance, needed = exact_gap(environment.obstacles, environment.limits, beyond, x, y, z, -1)
    if distance + environment.goal_tolerance_mm >= needed - kernels.SPARE_MM:
        return None
    return _found("target", True, label, np.array([x, y, z, math.nan, distance, needed]), query)
