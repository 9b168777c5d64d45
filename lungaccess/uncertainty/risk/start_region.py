"""The safe start region of a plan: from which poses of the tubes' tip its needle still reaches the target."""

import math

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.lung import Lung
from anatomy.meshes import SurfaceMesh
from lungaccess.plans.curves import needle_pieces
from lungaccess.plans.plan import Plan
from lungaccess.plans.tissue import goal_radius
from stages.needle import ArcPath, Query, StartRegion, needle_environment, prove_starts, try_starts

OFFSET_MM, TILT_DEG = 5.0, 15.0
"""Poses tried: published errors of a scope's tip are 1.3 to 2.1 mm an axis and 1 to 7 degrees."""
POSES = 10_000
ITERATIONS = 100
"""Of the RRT from a pose that nothing simpler leads from: all of them together take half a second."""
AHEAD_MM = 10.0
"""The cone of directions is drawn so far ahead: about as long as a view of the tip is wide."""
SIDES, RINGS = 32, 16
"""Corners of a circle, and circles of a half ball: smooth to the eye at the size of a tube."""


def safe_start_region(
    plan: Plan,
    lung: Lung,
    *,
    radius_mm: float | None = None,
    offset_mm: float = OFFSET_MM,
    tilt_deg: float = TILT_DEG,
    poses: int = POSES,
    iterations: int = ITERATIONS,
    seed: int = 0,
) -> StartRegion:
    """Return from which start poses near the planned one the needle still reaches the target.

    A needle steered anew from each pose is meant, clear of obstacles and within all its limits; what is
    proved holds for every pose of a ball of places times a cone of directions.  The same input and seed give
    the same region.

    Args:
        radius_mm: How far from the target a path may end; by default the radius of the goal of `assess`, 0
            for exactly at the target.
        offset_mm, tilt_deg: Largest distance and angle from the planned start of the poses that are tried.
        iterations: Of the search from a pose from which no simple path is clear.

    Raises:
        PlanFileError: If the plan was made for another lung.
        SettingsError: If the plan has no needle, a number is out of its range, or a cost map forbids voxels.
    """
    plan.require_lung(lung)
    needle = plan.system.require_needle("A safe start region")
    if plan.needle is None or not plan.needle.arcs:
        raise SettingsError(
            "The needle of the plan has no arc",
            expected="a needle that starts away from its target",
            remedy="Choose a plan whose needle leaves the tubes",
        )
    if lung.cost is not None and not np.isfinite(lung.cost.array).all():
        raise SettingsError(
            "The cost map forbids voxels, of which the proof knows nothing",
            expected="a patient whose cost map is finite, or without one",
            remedy="Give the voxels that must not be entered as vessels",
        )
    radius = goal_radius(lung, plan.target_lps)[0] if radius_mm is None else float(radius_mm)
    environment = needle_environment(
        lung, needle, plan.system.margins, with_fissures=plan.fissures_are_obstacles, goal_tolerance_mm=radius
    )
    start = plan.needle.lps_from_start
    query = Query(lps_from_start=start, target=plan.goal_lps, branch=plan.exemption.branch)
    path = ArcPath(lps_from_start=start, arcs=needle_pieces(plan.needle))
    return StartRegion(
        lps_from_start=start,
        target=plan.goal_lps,
        radius_mm=radius,
        max_curvature_per_mm=environment.limits.kappa,
        proved=prove_starts(environment, query, path),
        tried=try_starts(
            environment,
            query,
            path,
            offset_mm=offset_mm,
            tilt_rad=math.radians(tilt_deg),
            poses=poses,
            iterations=iterations,
            seed=seed,
        ),
    )


def proved_body(region: StartRegion) -> SurfaceMesh | None:
    """Return where needles of all proved starts begin and are headed; None where nothing is proved.

    It is the ball of places, and ahead of it the cone in which their first directions lie.
    """
    proved = region.proved
    if proved.volume <= 0.0:
        return None
    radius, slope = proved.offset_mm, math.tan(proved.tilt_rad)
    behind = np.linspace(math.pi, 0.5 * math.pi, RINGS + 1)[1:]
    heights = np.concatenate([radius * np.cos(behind), [AHEAD_MM]])
    radii = np.concatenate([radius * np.sin(behind), [radius + AHEAD_MM * slope]])
    around = 2.0 * math.pi * np.arange(SIDES) / SIDES
    circle = np.stack([np.cos(around), np.sin(around)], axis=1)
    rings = np.concatenate(
        [radii[:, None, None] * circle, np.broadcast_to(heights[:, None, None], (len(radii), SIDES, 1))],
        axis=2,
    )
    local = np.vstack([rings.reshape(-1, 3), [[0.0, 0.0, -radius], [0.0, 0.0, AHEAD_MM]]])
    here = np.arange(SIDES)
    after = (here + 1) % SIDES
    back, front, last = len(local) - 2, len(local) - 1, (len(radii) - 1) * SIDES
    faces = [np.stack([np.full(SIDES, back), after, here], axis=1)]
    for low in range(0, last, SIDES):
        high = low + SIDES
        faces.append(np.stack([low + here, low + after, high + after], axis=1))
        faces.append(np.stack([low + here, high + after, high + here], axis=1))
    faces.append(np.stack([np.full(SIDES, front), last + here, last + after], axis=1))
    frame = region.lps_from_start
    return SurfaceMesh(
        vertices_lps=local @ frame[:3, :3].T + frame[:3, 3], faces=np.concatenate(faces), bound_mm=0.0
    )


def tried_body(region: StartRegion) -> SurfaceMesh | None:
    """Return the places from which at least half of the directions have a path; None where there is none.

    The surface lies between the places that were tried, by linear interpolation.
    """
    from skimage.measure import marching_cubes

    tried, frame = region.tried, region.lps_from_start
    low = tried.lattice.min(axis=0) - 1
    field = np.zeros(tried.lattice.max(axis=0) - low + 2, dtype=np.float32)
    field[tuple((tried.lattice - low).T)] = tried.share_by_place
    if field.max() < 0.5:
        return None
    # A level between two possible shares: no vertex falls on a place of the lattice.
    vertices, faces, _, _ = marching_cubes(
        field, level=0.5 - 0.5 / tried.kinds.shape[1], gradient_direction="ascent"
    )
    local = tried.spacing_mm * (vertices + low)
    return SurfaceMesh(
        vertices_lps=local @ frame[:3, :3].T + frame[:3, 3], faces=faces, bound_mm=tried.spacing_mm
    )
