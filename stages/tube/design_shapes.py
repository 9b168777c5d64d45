"""The shapes of the tubes of a system: made or read once a process, and the same for every patient."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from functools import lru_cache

import numpy as np

from anatomy.base.typed import Int
from stages.tube.device import ConcentricTubes, Tube
from stages.tube.shape_store import open_shapes
from stages.tube.shape_tree import ShapeTree, tree_of_shapes
from stages.tube.shapes import ShapeGrid, ShapeLimits, TubeShapes

KEPT = 4
"""Designs in memory: a system, and variants of it that are compared with it."""
ATLAS_ROTATIONS = 12
"""Relative rotations 30 degrees apart: long tubes take up part of that as twist, and the minutes that an
atlas of a patient takes grow with them."""


def shapes_of(tubes: ConcentricTubes) -> TubeShapes:
    """Return all deployments of a design within its own limits, from the cache if they are there."""
    limits = ShapeLimits(
        max_extension_mm=tubes.max_extension_mm,
        max_lateral_sweep_mm=tubes.max_lateral_sweep_mm,
        max_strain=tubes.max_strain,
    )
    return _opened(tubes.nested, limits, _grid(tubes.nested))


def coarser_shapes(shapes: TubeShapes, stop_mm: float) -> tuple[Int, TubeShapes, ShapeTree]:
    """Return which shapes of a set have tubes at stops so far apart, and those as a set and as a tree.

    Where the stops are twice as far apart as in the set or more, so are the relative rotations.
    """
    stride = max(round(stop_mm / shapes.stop_mm), 1)
    return _coarser(shapes, stride)


def shapes_digest(tubes: ConcentricTubes) -> str:
    """Return a hash of the shapes of a design, "" for planar tubes, which have a closed form.

    Shapes near a limit may be in the set on one machine and not on another.
    """
    if tubes.planar:
        return ""
    shapes = shapes_of(tubes)
    parts = (shapes.insertions_mm, shapes.rotations_rad, shapes.arcs, shapes.first_arc)
    return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()


def _grid(tubes: tuple[Tube, ...]) -> ShapeGrid:
    """Return the grid for an atlas, which is as coarse in rotations as time allows."""
    grid = ShapeGrid.default(tubes)
    return replace(grid, rotations=min(grid.rotations, ATLAS_ROTATIONS))


@lru_cache(maxsize=KEPT)
def _opened(tubes: tuple[Tube, ...], limits: ShapeLimits, grid: ShapeGrid) -> TubeShapes:
    return open_shapes(tubes, limits, grid)


@lru_cache(maxsize=2 * KEPT)
def _coarser(shapes: TubeShapes, stride: int) -> tuple[Int, TubeShapes, ShapeTree]:
    places = np.rint(shapes.insertions_mm / shapes.stop_mm).astype(np.int64)
    turns = np.rint(shapes.rotations_rad / (2.0 * np.pi / shapes.grid.rotations)).astype(np.int64)
    members = np.flatnonzero((places % stride == 0).all(axis=1) & (turns % stride == 0).all(axis=1))
    chosen = shapes if stride == 1 else shapes.subset(members)
    return members, chosen, tree_of_shapes(chosen)
