"""The shapes of the tubes of a system: made or read once a process, and the same for every patient."""

import hashlib
import os
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.settings import to_mapping
from anatomy.base.typed import Float, Int
from anatomy.grid import read_only
from anatomy.kept_records import kept_record, record_path
from anatomy.machine_code.sources import kernel_digest
from stages.tube.device import ConcentricTubes, Tube
from stages.tube.kernels import placing
from stages.tube.shapes import ShapeGrid, ShapeLimits, TubeShapes, tube_shapes

TOLERANCE_MM = 0.1
"""Shapes nearer to each other share a beginning: less than what tubes are off by anyway."""
EXACT_MM = 1e-9
"""The tolerance where nothing twists: shapes are few then, and those with one beginning have it exactly."""
SWEEP_CLASSES = np.array([0.0, 0.125, 0.25, 0.5, 1.0])
"""Shares of the largest sweep, up to which sweeps are rounded where they enter the clearance."""
STILL_MM = 1e-6
"""Less sweep is rounding."""


@frozen_record
class ShapeTree:
    """The stretches of the shapes of a design, M nodes, each followed right after those before it.

    Args:
        depth, skip ((M,) int64): Level from 1 on; the node to go on with where this one is refused.
        first ((M + 1,) int64): Where the `stretches` of each node begin.
        stretches ((R, 12) float64): See `stages.tube.kernels.placing`.
        radius, clearance ((M,) float64): Outermost radius; what sweep and tolerance need beside it; mm.
        first_shape ((M + 1,) int64): Where the `shapes` (S,) begin that end with each node.
    """

    depth: Int
    skip: Int
    first: Int
    stretches: Float
    radius: Float
    clearance: Float
    first_shape: Int
    shapes: Int

    def with_margin(self, margin_mm: float) -> tuple[np.ndarray, ...]:
        """Return the tree as `placing.place_tree` takes it, every clearance larger by a margin."""
        return (
            self.depth, self.skip, self.first, self.stretches, self.radius,
            self.clearance + margin_mm, self.first_shape, self.shapes,
        )  # fmt: skip


def tree_of_shapes(shapes: TubeShapes, *, tolerance_mm: float | None = None) -> ShapeTree:
    """Return the tree of shapes that share their beginnings within a tolerance.

    How far they really are apart enters clearances.  The tolerance is TOLERANCE_MM, or EXACT_MM where nothing
    twists, if None.
    """
    if tolerance_mm is None:
        tolerance_mm = TOLERANCE_MM if shapes.rotations_rad.any() else EXACT_MM
    stop = shapes.stop_mm
    places = np.rint(shapes.insertions_mm[:, 0] / stop).astype(np.int64)
    most = int(places.max(initial=0))
    ends, middles = np.zeros((shapes.count, most + 1, 3)), np.zeros((shapes.count, most + 1, 3))
    radii = np.zeros((shapes.count, most + 1))
    cut = [np.zeros((0, placing.STRETCH_COLUMNS))] * shapes.count
    room = np.zeros((most + int(np.diff(shapes.first_arc).max(initial=0)) + 1, placing.STRETCH_COLUMNS))
    for n in range(shapes.count):
        rows = placing.cut_at_stops(shapes.arcs_of(n), stop, room, ends[n], middles[n], radii[n])
        cut[n] = room[:rows].copy()
    groups, sweeps = _sweep_classes(shapes)
    nodes, errors, leaf = _grown(places, groups, ends, middles, radii, tolerance_mm)
    firsts, places = nodes[:, 2], nodes[:, 1]
    clearance = sweeps[groups][firsts] + errors
    return _in_order(shapes, cut, nodes, leaf, radii[firsts, places], clearance)


def _sweep_classes(shapes: TubeShapes) -> tuple[Int, Float]:
    """Return the class of each shape's sweep `(S,)`, and up to where each class reaches, mm."""
    reach = SWEEP_CLASSES * max(float(shapes.lateral_sweep_mm.max(initial=0.0)), STILL_MM)
    reach[0] = STILL_MM
    groups = np.searchsorted(reach, shapes.lateral_sweep_mm).astype(np.int64)
    reach[0] = 0.0
    return groups, reach


def _grown(
    places: Int, groups: Int, ends: Float, middles: Float, radii: Float, tolerance: float
) -> tuple[Int, Float, Int]:
    room = 4 * len(places) + 16
    while True:
        nodes, errors = np.zeros((room, 4), dtype=np.int64), np.zeros(room)
        leaf = np.zeros(len(places), dtype=np.int64)
        count = placing.grow(places, groups, ends, middles, radii, tolerance, nodes, errors, leaf)
        if count >= 0:
            return nodes[:count], errors[:count], leaf
        room *= 2


def _in_order(
    shapes: TubeShapes, cut: list[Float], nodes: Int, leaf: Int, radius: Float, clearance: Float
) -> ShapeTree:
    """Return the tree with its nodes as they are followed; errors of arcs are added to the clearances."""
    count, stop = len(nodes), shapes.stop_mm
    parents, places, firsts = nodes[:, 0], nodes[:, 1], nodes[:, 2]
    ending = np.bincount(leaf, minlength=count)
    size, arc_errors = np.ones(count, dtype=np.int64), np.zeros(count)
    np.maximum.at(arc_errors, leaf, shapes.arc_error_mm)
    for node in range(count - 1, -1, -1):  # children come after their parents
        if parents[node] >= 0:
            size[parents[node]] += size[node]
            arc_errors[parents[node]] = max(arc_errors[parents[node]], arc_errors[node])
    rank, room = np.zeros(count, dtype=np.int64), np.zeros(count + 1, dtype=np.int64)
    for node in range(count):
        rank[node] = room[parents[node] + 1]
        room[parents[node] + 1] += size[node]
        room[node + 1] = rank[node] + 1
    order = np.argsort(rank)
    stop_of = [np.floor((rows[:, placing.BEGINS] + STILL_MM) / stop).astype(np.int64) + 1 for rows in cut]
    own = [cut[firsts[node]][stop_of[firsts[node]] == places[node]] for node in order]
    return ShapeTree(
        depth=read_only(places[order]),
        skip=read_only((rank + size)[order]),
        first=read_only(np.concatenate([[0], np.cumsum([len(rows) for rows in own])]).astype(np.int64)),
        stretches=read_only(np.concatenate([np.zeros((0, placing.STRETCH_COLUMNS)), *own])),
        radius=read_only(radius[order]),
        clearance=read_only((clearance + arc_errors)[order]),
        first_shape=read_only(np.concatenate([[0], np.cumsum(ending[order])]).astype(np.int64)),
        shapes=read_only(np.argsort(rank[leaf], kind="stable").astype(np.int64)),
    )


KEPT = 4
"""Designs in memory: a system, and variants of it that are compared with it."""


def shapes_of(tubes: ConcentricTubes) -> TubeShapes:
    """Return all deployments of a design within its own limits, from the cache if they are there.

    Of planar tubes they are those that sweep nothing: few others keep the limit, and the tree of shapes would
    be twice as large for them.
    """
    return _opened(tubes.nested, _limits(tubes), _grid(tubes.nested), tubes.needle_shaft)


def shapes_at_hand(tubes: ConcentricTubes) -> bool:
    """Tell whether `shapes_of` a design takes no time: it is in the cache, or no tubes twist each other."""
    nested = tubes.nested
    if sum(bool(tube.bends) for tube in nested) <= 1:
        return True
    key = _key(nested, _limits(tubes), _grid(nested), tubes.needle_shaft)
    return record_path("shapes", shapes_format(), key).is_file()


def _limits(tubes: ConcentricTubes) -> ShapeLimits:
    sweep_mm = tubes.max_lateral_sweep_mm
    return ShapeLimits(
        max_extension_mm=tubes.max_extension_mm,
        max_lateral_sweep_mm=min(sweep_mm, STILL_MM) if tubes.planar else sweep_mm,
        max_strain=tubes.max_strain,
    )


def _key(tubes: Sequence[Tube], limits: ShapeLimits, grid: ShapeGrid, needle: Tube | None) -> dict[str, Any]:
    return {
        "tubes": [to_mapping(tube) for tube in tubes],
        "limits": to_mapping(limits),
        "grid": to_mapping(grid),
        "needle": None if needle is None else to_mapping(needle),
    }


def longest_mm(tubes: ConcentricTubes) -> float:
    """Return the greatest insertion of the shapes of a design, mm."""
    return float(shapes_of(tubes).insertions_mm[:, 0].max(initial=0.0))


def coarser_shapes(shapes: TubeShapes, stop_mm: float) -> tuple[Int, TubeShapes, ShapeTree]:
    """Return which shapes of a set have tubes at stops so far apart, and those as a set and as a tree.

    Where the stops are twice as far apart as in the set or more, so are the relative rotations.
    """
    return _coarser(shapes, max(round(stop_mm / shapes.stop_mm), 1))


def shapes_digest(tubes: ConcentricTubes) -> str:
    """Return a hash of a design's shapes; one near a limit may be there on one machine and not on another."""
    shapes = shapes_of(tubes)
    parts = (shapes.insertions_mm, shapes.rotations_rad, shapes.arcs, shapes.first_arc)
    return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()


def _grid(tubes: tuple[Tube, ...]) -> ShapeGrid:
    """Return the grid for an atlas, which is as coarse in rotations as time allows."""
    grid = ShapeGrid.default(tubes)
    # Relative rotations 30 degrees apart: long tubes take up part of that as twist, and the minutes that an
    # atlas of a patient takes grow with them.
    return replace(grid, rotations=min(grid.rotations, 12))


@lru_cache(maxsize=KEPT)
def _opened(tubes: tuple[Tube, ...], limits: ShapeLimits, grid: ShapeGrid, needle: Tube | None) -> TubeShapes:
    return open_shapes(tubes, limits, grid, needle=needle)


@lru_cache(maxsize=2 * KEPT)
def _coarser(shapes: TubeShapes, stride: int) -> tuple[Int, TubeShapes, ShapeTree]:
    places = np.rint(shapes.insertions_mm / shapes.stop_mm).astype(np.int64)
    # From the farthest stop back, so that the longest tubes are among them.
    at_stops = ((places.max(initial=0) - places) % stride == 0) | (places == 0)
    turns = np.rint(shapes.rotations_rad / (2.0 * np.pi / shapes.grid.rotations)).astype(np.int64)
    members = np.flatnonzero(at_stops.all(axis=1) & (turns % stride == 0).all(axis=1))
    chosen = shapes if stride == 1 else shapes.subset(members)
    return members, chosen, tree_of_shapes(chosen)


SHAPES_FORMAT = 3
"""Raise it when shapes change: stored ones of another format are made anew."""


def shapes_format() -> str:
    """Return what tells shapes of this version and these kernels from all others."""
    return f"{SHAPES_FORMAT}-{kernel_digest('stages.tube')}"


def open_shapes(
    tubes: Sequence[Tube],
    limits: ShapeLimits | None = None,
    grid: ShapeGrid | None = None,
    *,
    needle: Tube | None = None,
    cache: str | os.PathLike[str] | None = None,
) -> TubeShapes:
    """Return the shapes of a design from the cache, or make and keep them.

    Parameters and errors are those of `stages.tube.shapes.tube_shapes` and, for the cache, of
    `anatomy.kept_records.kept_record`.
    """
    limits, grid = limits or ShapeLimits(), grid or ShapeGrid.default(tubes)
    key, made = _key(tubes, limits, grid, needle), partial(tube_shapes, tubes, limits, grid, needle=needle)
    return kept_record("shapes", shapes_format(), key, TubeShapes, make=made, cache=cache)
