"""How far a plan may be off: errors of each kind alone before it fails, and the safe starts of its needle."""

import itertools
import math
from collections.abc import Callable

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_value
from anatomy.base.typed import Float
from anatomy.lung import Lung
from anatomy.meshes import SurfaceMesh
from lungaccess.plans.curves import needle_pieces
from lungaccess.plans.plan import Plan
from lungaccess.plans.tissue import goal_radius
from lungaccess.problem.error_files import load_errors
from lungaccess.problem.errors import BREATHING, CURVATURE, UNITS, ErrorModel
from lungaccess.uncertainty.risk.assessor import RiskAssessor
from lungaccess.uncertainty.risk.deviations import FIELD_OF, Deviations, Draws
from lungaccess.uncertainty.risk.patient_errors import model_for
from lungaccess.uncertainty.risk.statistics import Share
from stages.needle import ArcPath, Query, StartRegion, needle_environment, prove_starts, try_starts

DEFAULT_PROBABILITY = 0.95
"""The usual level of confidence."""
DEFAULT_SAMPLES = 2000
"""A share of 0.95 is then known to 1 % with 95 % confidence, at every size that is tried."""
LARGEST = {"mm": 20.0, "deg": 90.0, "ln": 1.0}
"""Sizes beyond which no tolerance is looked for."""
LADDER = 64
"""Sizes tried at once for a margin, and again between the last that holds and the first that fails."""
AZIMUTHS = 16
"""Directions in which a tilt is tried: one every 22.5 degrees."""


@frozen_value
class Tolerance:
    """How large errors of one kind may be, all others being 0.

    Args:
        kind, unit: See `lungaccess.problem.errors.UNITS`.
        stated: The size in the error model, of patient and attempt together; see
            `lungaccess.problem.errors.Term`.
        largest: The largest size at which successes are that probable, at most `LARGEST`; 0 if none was
            found.
        margin ((float, float)): Errors up to this size never fail: (below 0, above 0) for errors with a sign,
            the same twice for errors with directions; factors for the curvature.  Tried at steps and in some
            directions, not proved.
        alone: Successes at the stated size.
    """

    kind: str
    unit: str
    stated: float
    probability: float
    largest: float
    margin: tuple[float, float]
    alone: Share


def find_tolerances(
    plan: Plan,
    lung: Lung,
    *,
    model: ErrorModel | None = None,
    probability: float = DEFAULT_PROBABILITY,
    samples: int = DEFAULT_SAMPLES,
    seed: int = 0,
    radius_mm: float | None = None,
) -> tuple[Tolerance, ...]:
    """Return the tolerance of a plan to each kind of error alone.

    The largest size is found by bisection over a scale, every size with the same draws.  Breathing is left
    out: it is an error of the target in one direction.  PlanFileError and SettingsError are raised as by
    `RiskAssessor`, also if the probability is not between 0 and 1.

    Args:
        probability: Probability of success that is asked for, above 0 and below 1.
        samples, seed: Draws for each size.
    """
    if not 0.0 < probability < 1.0:
        raise SettingsError(
            f"The probability is {probability}",
            expected="above 0 and below 1",
            remedy="Choose a share such as 0.95",
        )
    stated = model_for(model or load_errors(), plan, lung)
    assessor = RiskAssessor(plan, lung, radius_mm=radius_mm)
    draws = assessor.draws(samples, seed)
    kinds = (kind for kind in assessor.kinds if kind != BREATHING)
    return tuple(_tolerance(assessor, draws, stated, kind, probability) for kind in kinds)


def _tolerance(
    assessor: RiskAssessor, draws: Draws, model: ErrorModel, name: str, probability: float
) -> Tolerance:
    unit = UNITS[name]

    def holds(size: float) -> bool:
        return assessor.success(draws, model.only(name, size)).value >= probability

    return Tolerance(
        kind=name,
        unit=unit,
        stated=model.term(name).size,
        probability=probability,
        largest=_largest(holds, LARGEST[unit]),
        margin=_curvature_margin(assessor) if name == CURVATURE else _margin(assessor, name),
        alone=assessor.success(draws, model.only(name)),
    )


def _largest(holds: Callable[[float], bool], most: float) -> float:
    """Return the largest size up to another that holds; 0 if none does."""
    if holds(most):
        return most
    low, high = 0.0, most
    # A tolerance is then known to a thousandth of the largest size.
    for _ in range(10):
        middle = 0.5 * (low + high)
        if holds(middle):
            low = middle
        else:
            high = middle
    return low


def _margin(assessor: RiskAssessor, name: str) -> tuple[float, float]:
    """Return the sizes up to which errors of a kind never fail: of both signs, or of all directions."""
    field = FIELD_OF[name]
    shape = assessor.no_deviations(1)[field].shape[1:]
    directions = _directions(name, shape[0] if shape else 1)

    def made(sizes: Float, chosen: Float) -> Deviations:
        scaled = np.radians(sizes) if UNITS[name] == "deg" else sizes
        errors = (scaled[:, None, None] * chosen).reshape(-1, *shape)
        return Deviations(**{**assessor.no_deviations(len(errors)), field: errors})

    if not shape or shape == (1,):
        low, high = (_unfailing(assessor, made, directions[[n]], LARGEST[UNITS[name]]) for n in (0, 1))
        return low, high
    size = _unfailing(assessor, made, directions, LARGEST[UNITS[name]])
    return size, size


def _curvature_margin(assessor: RiskAssessor) -> tuple[float, float]:
    """Return the factors of curvature down to which, and up to which, nothing fails."""

    def made(sizes: Float, chosen: Float) -> Deviations:
        factors = np.maximum(1.0 + (sizes[:, None] * chosen[None, :, 0]).ravel(), 0.0)
        return Deviations(**{**assessor.no_deviations(len(factors)), "factor": factors})

    below = _unfailing(assessor, made, np.array([[-1.0]]), 1.0)
    # Factor of the curvature beyond which no margin is looked for.
    above = _unfailing(assessor, made, np.array([[1.0]]), 3.0 - 1.0)
    return 1.0 - below, 1.0 + above


def _unfailing(
    assessor: RiskAssessor, made: Callable[[Float, Float], Deviations], directions: Float, most: float
) -> float:
    """Return the size up to which no step of a ladder fails in any direction, refined once."""

    def first_failure(sizes: Float) -> int:
        done = assessor.successes(made(sizes, directions))
        failed = ~done.reshape(len(sizes), len(directions)).all(axis=1)
        return int(np.argmax(failed)) if failed.any() else len(sizes)

    # Squares: small sizes matter most.
    sizes = np.concatenate([[0.0], most * (np.arange(1, LADDER + 1) / LADDER) ** 2])
    first = first_failure(sizes)
    if first == 0:
        return 0.0
    if first == len(sizes):
        return most
    between = np.linspace(sizes[first - 1], sizes[first], LADDER)
    return float(between[max(first_failure(between) - 1, 0)])


def _directions(name: str, n: int) -> Float:
    """Return the unit errors `(D, n)` of a kind that are tried."""
    if name in ("scope_position", "target_position"):
        steps = np.array([step for step in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(step)])
        return np.asarray(steps / np.linalg.norm(steps, axis=1)[:, None])
    if name == "scope_direction":
        turns = 2.0 * math.pi * np.arange(AZIMUTHS) / AZIMUTHS
        return np.stack([np.cos(turns), np.sin(turns)], axis=1)
    if name == "tube_rotation":
        return np.array([[-1.0], [1.0]])
    signs = (-1.0, 1.0)
    single = [sign * row for row in np.eye(n) for sign in signs]
    return np.array(single + ([sign * np.ones(n) for sign in signs] if n > 1 else []))


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
