"""Cases of clearance bounds, arcs of the needle, its start region, and proofs that it has no path."""

import math

import numpy as np

from anatomy.base.typed import Float
from anatomy.fields import corner_geometry, distance_field
from anatomy.kernels.field import MIN_GAP_MM, UNITS_PER_MM, exact_at
from anatomy.poses import pose
from anatomy.structures import LUMEN, OBSTACLES, VESSEL
from lungaccess.judging.selftest import scenes
from stages.needle import (
    ArcPath,
    Needle,
    NeedleEnvironment,
    NoPathProof,
    Query,
    StartRegion,
    TriedStarts,
    blocker_on_path,
    direct_path,
    environment_of_labels,
    prove_starts,
)

REQUIRED_MM = 0.8
SAMPLE_MM = 0.02
"""Paths are sampled so finely where an answer is compared with the truth."""


def distances(rng: scenes.Random) -> scenes.Case:
    """Draw voxels and points; a bound is below the distance by a voxel's diagonal at most."""
    spacing = rng.uniform(0.5, 1.5, 3)
    labels, grid = scenes.empty_labels((0.0, 0.0, 0.0), 9.0 * spacing, spacing)
    labels[tuple(rng.integers(0, 9, (12, 3)).T)] = VESSEL
    points = rng.uniform(0.0, 9.0, (60, 3)) * spacing
    field, exact = distance_field("obstacle", labels != 0, grid), np.zeros(len(points))
    bounds, cap = field.lower_bound_mm(points), float(3.0 * spacing.max())
    exact_at(labels, corner_geometry(grid), points, VESSEL, -1, cap, exact)

    def contradiction() -> str:
        truth = scenes.true_distances(labels, grid, points, VESSEL)
        loss = float(np.linalg.norm(spacing)) + 2.0 / UNITS_PER_MM
        wrong = (bounds > truth + scenes.ROUNDING_MM) | (bounds < truth - loss)
        wrong |= np.abs(exact - np.minimum(truth, cap)) > scenes.ROUNDING_MM
        n = int(np.argmax(wrong))
        said = f"bound {bounds[n]:.6f} mm, exact search {exact[n]:.6f} mm, true distance {truth[n]:.6f} mm"
        return said if wrong.any() else ""

    return scenes.Case(answers=np.concatenate([bounds, exact]), contradiction=contradiction)


def tissue(rng: scenes.Random, vessels: int, wall_mm: float = math.inf) -> NeedleEnvironment:
    """Return a box of 18 mm with an airway behind the start, and vessels beside the way and beyond x."""
    labels, grid = scenes.empty_labels((-9.0, -9.0, -12.0), (9.0, 9.0, 12.0), (1.0, 1.1, 0.9))
    for _ in range(vessels):
        around, away = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(2.0, 6.0)
        place = np.array([away * math.cos(around), away * math.sin(around), rng.uniform(-5.0, 9.0)])
        labels[scenes.near_segment(grid, place, place + 2.0 * scenes.unit(rng), rng.uniform(0.6, 1.0))] = (
            VESSEL
        )
    labels[grid.lps(np.moveaxis(np.indices(grid.shape), 0, -1))[..., 0] > wall_mm] = VESSEL
    scenes.draw_airway(labels, grid, (-9.0, 0.0, -10.0), (9.0, 0.0, -10.0), 1.2)
    needle = Needle(diameter_mm=0.8, max_curvature_per_mm=0.05, exit_exemption_mm=3.0)
    return environment_of_labels(labels, grid, needle, required_clearance_mm=REQUIRED_MM)


START = pose([0.0, 0.0, -7.4], [0.1, 0.0, 1.0])


def _spare_mm(environment: NeedleEnvironment, path: ArcPath, branch: int) -> float:
    """Return the least true clearance of a path beyond what is required, by its samples."""
    labels, grid, limits = environment.obstacles.labels, environment.grid, environment.limits
    points, lengths = path.sample(SAMPLE_MM)
    in_exit = (lengths < limits.exempt_mm) & (branch >= 0)
    spare = scenes.true_distances(labels, grid, points[~in_exit], OBSTACLES) - limits.required_mm
    at_exit = scenes.true_distances(labels, grid, points[in_exit], OBSTACLES, branch) - limits.required_mm
    lumen = scenes.true_distances(labels, grid, points[in_exit], LUMEN) - limits.radius_mm
    return float(np.concatenate([spare, at_exit, lumen]).min())


def arcs(rng: scenes.Random) -> scenes.Case:
    """Draw paths of one and two arcs; a clear one is clear in all samples, another is not."""
    environment, paths = tissue(rng, 5), []
    for _ in range(6):
        pieces = np.column_stack(
            [rng.uniform(3.0, 8.0, 2), rng.uniform(-3.0, 3.0, 2), rng.uniform(0, 0.05, 2)]
        )
        frame = scenes.tilted(START, 0.3 * scenes.unit(rng), rng.uniform(0.0, 0.3), rng.uniform(0.0, 6.0))
        paths.append(ArcPath(lps_from_start=frame, arcs=pieces[: int(rng.integers(1, 3))]))
    branches = rng.integers(-1, 1, len(paths)).tolist()
    labels = [
        blocker_on_path(environment, path, branch) for path, branch in zip(paths, branches, strict=True)
    ]

    def contradiction() -> str:
        for path, branch, label in zip(paths, branches, labels, strict=True):
            spare = _spare_mm(environment, path, branch)
            if spare < -scenes.ROUNDING_MM if label == 0 else spare > MIN_GAP_MM + SAMPLE_MM:
                return f"blocking label {label}, true clearance beyond what is required {spare:.4f} mm"
        return ""

    return scenes.Case(answers=np.array(labels, dtype=np.float64), contradiction=contradiction)


def start_region(rng: scenes.Random) -> scenes.Case:
    """Draw a wall beside a path; from starts of the proved part, aside to the wall, the path is clear."""
    environment = tissue(rng, 2, wall_mm=rng.uniform(1.8, 3.0))
    target = np.array([*rng.uniform(-0.5, 0.5, 2), 4.0])
    planned = direct_path(START, target)
    proved = prove_starts(environment, Query(lps_from_start=START, target=target, branch=0), planned)
    region = StartRegion(
        lps_from_start=START, target=target, radius_mm=0.0, proved=proved, tried=NOTHING_TRIED,
        max_curvature_per_mm=environment.limits.kappa,
    )  # fmt: skip
    aside, around = np.array([1.0, 0.0, 0.0]), math.atan2(START[0, 1], START[0, 0])
    drawn = [(around, aside), (around + math.pi, aside), (rng.uniform(0.0, 6.3), scenes.unit(rng))]

    def contradiction() -> str:
        for n in range(0, len(proved.offsets_mm), 3):
            for around, aside in drawn:
                offset, tilt = float(proved.offsets_mm[n]), float(proved.tilts_rad[n])
                moved = scenes.tilted(START, (1.0 - 1e-9) * offset * aside, max(tilt - 1e-9, 0.0), around)
                path = region.path_from(moved)
                if path is None or not _reaches(environment, path, target):
                    return f"{offset:.4f} mm and {tilt:.4f} rad proved, but a start there has no such path"
        return ""

    return scenes.Case(
        answers=np.concatenate([proved.offsets_mm, proved.tilts_rad]), contradiction=contradiction
    )


NOTHING_TRIED = TriedStarts(
    offset_mm=0.0, tilt_rad=0.0, positions=np.zeros((0, 3)), tangents=np.zeros((0, 0, 3)),
    offsets_mm=np.zeros(0), tilts_rad=np.zeros((0, 0)), kinds=np.zeros((0, 0), dtype=np.uint8),
    spacing_mm=1.0, lattice=np.zeros((0, 3), dtype=np.int64),
)  # fmt: skip


def _reaches(environment: NeedleEnvironment, path: ArcPath, target: Float) -> bool:
    limits = environment.limits
    return bool(
        np.linalg.norm(path.frames()[-1][:3, 3] - target) < 1e-6
        and path.arcs[:, 2].max() <= limits.kappa * (1.0 + 1e-6)
        and path.max_angle_from_start_rad() <= limits.max_angle_rad + 1e-6
        and _spare_mm(environment, path, 0) >= -scenes.ROUNDING_MM
    )


def no_path(rng: scenes.Random) -> scenes.Case:
    """Draw a path in a corridor just wide enough, open or walled off, and a needle that just bends so."""
    kappa = 1.0 / float(rng.uniform(5.0, 12.0))
    pieces = np.column_stack([rng.uniform(3.0, 6.0, 3), rng.uniform(-3.0, 3.0, 3), kappa * np.ones(3)])
    pieces = pieces[: int(rng.integers(1, 4))]
    pieces[:, 0] *= min(3.0 / float(kappa * pieces[:, 0].sum()), 1.0)
    path = ArcPath(lps_from_start=pose(np.zeros(3), scenes.unit(rng)), arcs=pieces)
    walled = bool(rng.random() < 0.3)
    environment = _corridor(path, kappa, walled)
    target = path.frames()[-1][:3, 3]
    proof = NoPathProof(environment, Query(lps_from_start=path.lps_from_start, target=target))
    # The cubes, and the planes of the first one or two levels.
    for _ in range(25):
        # Where there are more, the next planes take seconds in Python.
        if proof.advance() or proof.states > 800:
            break
    denied = proof.outcome == "no path"

    def contradiction() -> str:
        exists = not walled and _spare_mm(environment, path, -1) >= 0.0
        return f"outcome: {proof.outcome}; a path exists: {exists}" if denied and exists else ""

    return scenes.Case(answers=np.array([denied, proof.states, proof.cell_mm]), contradiction=contradiction)


SPACING_MM = 1.0


def _corridor(path: ArcPath, kappa: float, walled: bool) -> NeedleEnvironment:
    """Return tissue that is all vessel but for the voxels that are too near to a path."""
    points, lengths = path.sample(0.2)
    labels, grid = scenes.empty_labels(points.min(axis=0) - 3.0, points.max(axis=0) + 3.0, SPACING_MM)
    places = grid.lps(np.moveaxis(np.indices(grid.shape), 0, -1))
    nearest = np.full(grid.shape, np.inf)
    for point in points if not walled else points[np.abs(lengths - 0.5 * lengths[-1]) > 1.6]:
        gap = np.maximum(np.abs(places - point) - 0.5 * SPACING_MM, 0.0)
        nearest = np.minimum(nearest, np.linalg.norm(gap, axis=-1))
    labels[nearest > REQUIRED_MM + 0.11] = VESSEL
    needle = Needle(
        diameter_mm=0.8, max_curvature_per_mm=kappa * (1.0 + 1e-9), max_length_mm=path.length_mm + 0.5,
        max_accumulated_turn_deg=180.0, max_angle_from_start_deg=180.0,
    )  # fmt: skip
    return environment_of_labels(
        labels, grid, needle, required_clearance_mm=REQUIRED_MM, goal_tolerance_mm=1e-3
    )
