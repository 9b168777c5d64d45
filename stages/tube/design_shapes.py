"""The shapes of the tubes of a system: made or read once a process, and the same for every patient."""

import hashlib
import os
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import numpy as np

from anatomy.base.settings import to_mapping
from anatomy.base.typed import Int
from anatomy.kept_records import kept_record, record_path
from anatomy.machine_code.sources import kernel_digest
from stages.tube.device import ConcentricTubes, Tube
from stages.tube.shape_tree import STILL_MM, ShapeTree, tree_of_shapes
from stages.tube.shapes import ShapeGrid, ShapeLimits, TubeShapes, tube_shapes

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
    design = _design(nested, _limits(tubes), _grid(nested), tubes.needle_shaft)
    return record_path("shapes", shapes_format(), design).is_file()


def _limits(tubes: ConcentricTubes) -> ShapeLimits:
    sweep_mm = tubes.max_lateral_sweep_mm
    return ShapeLimits(
        max_extension_mm=tubes.max_extension_mm,
        max_lateral_sweep_mm=min(sweep_mm, STILL_MM) if tubes.planar else sweep_mm,
        max_strain=tubes.max_strain,
    )


def _design(
    tubes: Sequence[Tube], limits: ShapeLimits, grid: ShapeGrid, needle: Tube | None
) -> dict[str, Any]:
    """Return what the shapes of a design depend on."""
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
    stride = max(round(stop_mm / shapes.stop_mm), 1)
    return _coarser(shapes, stride)


def shapes_digest(tubes: ConcentricTubes) -> str:
    """Return a hash of the shapes of a design.

    Shapes near a limit may be in the set on one machine and not on another.
    """
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
    design = _design(tubes, limits, grid, needle)
    made = partial(tube_shapes, tubes, limits, grid, needle=needle)
    return kept_record("shapes", shapes_format(), design, TubeShapes, make=made, cache=cache)
