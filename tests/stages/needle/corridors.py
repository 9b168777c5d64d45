"""Drawn needle paths, each in a corridor just wide enough for it, in a rotated grid of uneven voxels."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from anatomy.base.records import frozen_value
from anatomy.base.typed import Float
from anatomy.grid import Grid
from anatomy.structures import AIRWAY, BRANCH_SHIFT, LUMEN, VESSEL
from stages.needle.device import Needle
from stages.needle.environment import NeedleEnvironment, begun_at_wall, environment_of_labels
from stages.needle.path import ArcPath, Query, blocker_on_path
from stages.needle.search.resolution import Resolution

SAMPLE_MM = 0.3
SPARE_MM = 0.16
"""Half the spacing of samples, and what a proof of clearance gives up."""
CLEARANCE_MM = 0.8
NEEDLE_MM = 0.8
LARGEST_TURN_RAD = math.radians(178.0)
REACH = 2
"""No voxel farther than so many from one is too near to a point in it."""


@frozen_value
class Corridor:
    """A path within all limits, most of which it just keeps, and the question that it answers."""

    environment: NeedleEnvironment
    query: Query
    path: ArcPath


def drawn_corridor(rng: np.random.Generator, resolution: Resolution | None = None) -> Corridor | None:
    """Return a path in its corridor; None if it crosses its own wall, or comes to the border.

    Args:
        resolution: The path is a word of it: steps of its length, in its directions, on the tightest circle.
    """
    kappa = 1.0 / float(rng.choice((20.0, 30.0, 50.0)))
    arcs = _drawn_arcs(rng, kappa, resolution)
    frame = np.eye(4)
    frame[:3, :3] = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix()
    path = ArcPath(lps_from_start=frame, arcs=arcs)
    tolerance = float(rng.choice((1e-3, 0.5)))
    offset = rng.normal(size=3)
    offset *= (tolerance - 1e-4) * rng.uniform() / np.linalg.norm(offset)
    reference = _drawn_reference(rng, frame[:3, 2])
    inserted, turned = rng.uniform(0.0, 5.0), 0.2 * rng.uniform()
    query = Query(
        lps_from_start=frame,
        target=path.frames()[-1][:3, 3] + offset,
        branch=int(rng.choice((-1, 0))),
        inserted_mm=inserted,
        turned_rad=turned,
        reference=reference,
    )
    needle = Needle(
        diameter_mm=NEEDLE_MM,
        max_curvature_per_mm=kappa,
        max_length_mm=path.length_mm + inserted + float(rng.choice((1e-6, 20.0))),
        max_angle_from_start_deg=min(
            math.degrees(path.max_angle_from_start_rad(reference)) + float(rng.choice((1e-4, 30.0))), 180.0
        ),
        max_accumulated_turn_deg=math.degrees(path.accumulated_turn_rad + turned)
        + float(rng.choice((1e-6, 20.0))),
        exit_exemption_mm=inserted + float(rng.uniform(0.0, 8.0)),
    )
    environment = _carved(rng, path, query, needle, tolerance)
    if environment is None or blocker_on_path(environment, path, query.branch, inserted):
        return None
    return Corridor(environment=environment, query=query, path=path)


def _drawn_arcs(rng: np.random.Generator, kappa: float, resolution: Resolution | None) -> Float:
    """Return arcs, half of them on the tightest circle, of words all; they turn by a half turn at most."""
    arcs: list[tuple[float, float, float]] = []
    turned = length = 0.0
    wanted = rng.uniform(8.0, 45.0)
    winding = rng.uniform(-1.0, 1.0)
    while length < wanted and len(arcs) < 8:
        if resolution is None:
            piece = rng.uniform(1.0, 15.0)
            roll = rng.uniform(-math.pi, math.pi) if rng.uniform() < 0.5 else winding * rng.uniform()
            bend = kappa * rng.choice((0.0, 1.0, 1.0, rng.uniform()))
        else:
            piece = resolution.fine_mm * int(rng.integers(1, resolution.steps + 1))
            roll = 2.0 * math.pi * int(rng.integers(resolution.fine_rolls)) / resolution.fine_rolls
            bend = kappa * (rng.uniform() < 0.8)
        if turned + bend * piece > LARGEST_TURN_RAD:
            break
        arcs.append((piece, roll, bend))
        length, turned = length + piece, turned + bend * piece
    return np.array(arcs or [(8.0, 0.0, 0.0)])


def _drawn_reference(rng: np.random.Generator, forward: Float) -> Float | None:
    """Return a direction up to 60 degrees from the start's; None, the start's own, half the time."""
    if rng.uniform() < 0.5:
        return None
    aside = np.cross(forward, rng.normal(size=3))
    aside /= np.linalg.norm(aside)
    tilt = rng.uniform(0.0, math.pi / 3.0)
    return np.asarray(math.cos(tilt) * forward + math.sin(tilt) * aside)


def _carved(
    rng: np.random.Generator, path: ArcPath, query: Query, needle: Needle, tolerance_mm: float
) -> NeedleEnvironment | None:
    """Block all voxels but those that are too near to the path; in its exit the wall of a branch may stay."""
    points, lengths = path.sample(SAMPLE_MM)
    grid = _drawn_grid(rng, points)
    to_wall = np.full(grid.shape, np.inf)
    in_tissue = to_wall.copy()
    begin = query.inserted_mm
    is_exit = (begin + lengths < needle.exit_exemption_mm - SAMPLE_MM) & (query.branch >= 0)
    for where, nearest in ((is_exit, to_wall), (~is_exit, in_tissue)):
        _measure(grid, points[where], nearest)
    blocked = (in_tissue > CLEARANCE_MM + SPARE_MM) & (to_wall > CLEARANCE_MM + SPARE_MM)
    labels = np.where(blocked, VESSEL, 0).astype(np.uint16)
    code = AIRWAY | (1 << BRANCH_SHIFT)
    wall = ~blocked & (in_tissue > CLEARANCE_MM + SPARE_MM)
    labels[wall] = code
    labels[wall & (to_wall > 0.5 * NEEDLE_MM + SPARE_MM) & (rng.uniform(size=grid.shape) < 0.5)] |= LUMEN
    environment = environment_of_labels(
        labels, grid, needle, required_clearance_mm=CLEARANCE_MM, goal_tolerance_mm=tolerance_mm
    )
    if query.branch >= 0 and rng.uniform() < 0.3:
        environment = begun_at_wall(environment, points[0], (query.branch,))
    return environment


def _drawn_grid(rng: np.random.Generator, points: Float) -> Grid:
    """Return a grid in any rotation that holds points and a margin."""
    spacing = rng.uniform(0.5, 1.3, 3)
    axes = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix()
    seen = points @ axes
    low = seen.min(axis=0) - 3.0 - rng.uniform(0.0, 1.0, 3)
    shape = tuple(int(n) for n in np.ceil((seen.max(axis=0) + 3.0 - low) / spacing) + 1)
    matrix = np.eye(4)
    matrix[:3, :3] = axes * spacing
    matrix[:3, 3] = axes @ low
    return Grid(shape=shape, lps_from_ijk=matrix)


def _measure(grid: Grid, points: Float, nearest: Float) -> None:
    """Lower `nearest` to the distance of voxels, as solid boxes, from points not far from them."""
    if not len(points):
        return
    around = np.stack(np.meshgrid(*[np.arange(-REACH, REACH + 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    at = grid.ijk(points)
    voxels = np.rint(at).astype(int)[:, None] + around
    gap = np.maximum(np.abs(at[:, None] - voxels) - 0.5, 0.0) * grid.spacing_mm
    inside = ((voxels >= 0) & (voxels < grid.shape)).all(axis=-1)
    np.minimum.at(nearest, tuple(voxels[inside].T), np.linalg.norm(gap, axis=-1)[inside])
