"""Tiny lungs drawn voxel by voxel, and distances to their voxels without any of the kernels."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from anatomy import poses
from anatomy.airway_tree import AirwayTree
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int, Labels, Mask
from anatomy.fields import distance_field
from anatomy.grid import Grid
from anatomy.lung import Lung
from anatomy.structures import AIRWAY, BRANCH_SHIFT, FIELD_BITS, LUMEN, OUTSIDE, close_border

Random = np.random.Generator
ROUNDING_MM = 1e-7
"""Distances of kernels and of numpy differ by less."""


@frozen_record
class Case:
    """One drawn case of a proof: what the kernels answered, `(N,)`, and a comparison with the truth.

    The comparison returns "" or what contradicts it, with both numbers.
    """

    answers: Float
    contradiction: Callable[[], str]


def empty_labels(low: ArrayLike, high: ArrayLike, spacing_mm: ArrayLike) -> tuple[Labels, Grid]:
    """Return free tissue whose faces lie at `low` and about at `high`, LPS mm."""
    spacing = np.broadcast_to(np.asarray(spacing_mm, dtype=np.float64), 3)
    shape = tuple(int(n) for n in np.rint((np.asarray(high) - np.asarray(low)) / spacing))
    grid = Grid.from_spacing(shape, spacing, np.asarray(low) + 0.5 * spacing)
    return np.zeros(shape, dtype=np.uint16, order="F"), grid


def near_segment(grid: Grid, a: ArrayLike, b: ArrayLike, radius_mm: float) -> Mask:
    """Tell which voxel centres lie within a radius of a segment, or of a point if both ends are one."""
    points = grid.lps(np.moveaxis(np.indices(grid.shape), 0, -1))
    begin = np.asarray(a, dtype=np.float64)
    way = np.asarray(b, dtype=np.float64) - begin
    share = np.clip(((points - begin) @ way) / max(float(way @ way), 1e-300), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - begin - share[..., None] * way, axis=-1) <= radius_mm)


def draw_airway(labels: Labels, grid: Grid, a: ArrayLike, b: ArrayLike, radius_mm: float) -> None:
    """Draw an airway, branch 0, with a wall of 1 mm."""
    code = AIRWAY | (1 << BRANCH_SHIFT)
    labels[near_segment(grid, a, b, radius_mm + 1.0)] = code
    labels[near_segment(grid, a, b, radius_mm)] = code | LUMEN


def line_tree(a: ArrayLike, b: ArrayLike, radius_mm: float) -> AirwayTree:
    """Return a tree of one straight branch with points about 1 mm apart."""
    begin = np.asarray(a, dtype=np.float64)
    way = np.asarray(b, dtype=np.float64) - begin
    length = float(np.linalg.norm(way))
    count = max(round(length), 1) + 1
    share = np.linspace(0.0, 1.0, count)
    return AirwayTree(
        points_lps=begin + share[:, None] * way,
        radius_mm=np.full(count, radius_mm),
        parent_point=np.arange(count) - 1,
        branch_of_point=np.zeros(count, dtype=np.int64),
        branch_start=np.array([0, count]),
        branch_parent=np.array([-1]),
        generation=np.array([0]),
        distance_from_root_mm=share * length,
        tangents=np.tile(way / length, (count, 1)),
    )


def lung_of(labels: Labels, grid: Grid, tree: AirwayTree) -> Lung:
    """Return a lung of labels, whose outermost voxels become OUTSIDE."""
    close_border(labels)
    fields = {name: distance_field(name, (labels & bits) != 0, grid) for name, bits in FIELD_BITS.items()}
    return Lung(
        name="selftest", kind="masks", key="", grid=grid, labels=labels, nodules=None, cost=None, starts=(),
        fields={name: field for name, field in fields.items() if "fissure" not in name},
        targets_lps=(), breath_hold=None, sources={}, warnings=(), tree=tree,
        lumen_depth=distance_field("lumen_depth", (labels & LUMEN) == 0, grid),
    )  # fmt: skip


def true_distances(labels: Labels, grid: Grid, points: Float, bits: int, exempt: int = -1) -> Float:
    """Return the distances `(N,)` of points to the nearest voxel box with any of `bits`; inf without one.

    Voxels of the branch `exempt` that are airway alone, of these structures, are passed over.  All beyond
    the grid is OUTSIDE.
    """
    hit = labels & bits
    chosen = hit != 0
    if exempt >= 0:
        chosen &= ~((hit == AIRWAY) & ((labels >> BRANCH_SHIFT).astype(np.int64) - 1 == exempt))
    local, centres, spacing = grid.ijk(points), np.argwhere(chosen), grid.spacing_mm
    out = np.full(len(points), np.inf)
    if len(centres) and len(points):
        # Voxels whose centres are looked at first for the nearest box.
        some = [*range(1, min(16, len(centres)) + 1)]
        away, voxels = cKDTree(centres * spacing).query(local * spacing, k=some)
        out = _to_boxes(local[:, None], centres[voxels], spacing)
        # A box whose centre is farther than these may yet be nearer.
        for n in np.flatnonzero(away[:, -1] - 0.5 * np.linalg.norm(spacing) < out):
            out[n] = _to_boxes(local[n], centres, spacing)
    if bits & OUTSIDE:
        faces = np.hstack([local + 0.5, np.array(grid.shape) - 0.5 - local]) * np.tile(spacing, 2)
        out = np.minimum(out, np.maximum(faces.min(axis=1), 0.0))
    return out


def _to_boxes(places: Float, centres: Int, spacing: Float) -> Float:
    gaps = np.maximum(np.abs(centres - places) - 0.5, 0.0) * spacing
    return np.asarray(np.sqrt((gaps**2).sum(axis=-1)).min(axis=-1))


def unit(rng: Random) -> Float:
    """Return a random direction `(3,)`."""
    direction = rng.normal(size=3)
    return np.asarray(direction / np.linalg.norm(direction))


def tilted(frame: Float, moved: Float, tilt_rad: float, around_rad: float) -> Float:
    """Return a pose moved by a vector, its direction tilted."""
    aside = math.cos(around_rad) * frame[:3, 0] + math.sin(around_rad) * frame[:3, 1]
    return poses.pose(frame[:3, 3] + moved, math.cos(tilt_rad) * frame[:3, 2] + math.sin(tilt_rad) * aside)
