"""The shapes of the tubes of a system: made or read once a process, and the same for every patient."""

from __future__ import annotations

import hashlib
from functools import lru_cache

from stages.tube.device import ConcentricTubes, Tube
from stages.tube.shape_store import open_shapes
from stages.tube.shape_tree import ShapeTree, tree_of_shapes
from stages.tube.shapes import ShapeLimits, TubeShapes

KEPT = 4
"""Designs in memory: a system, and variants of it that are compared with it."""


def shapes_of(tubes: ConcentricTubes) -> TubeShapes:
    """Return all deployments of a design within its own limits, from the cache if they are there."""
    limits = ShapeLimits(
        max_extension_mm=tubes.max_extension_mm,
        max_lateral_sweep_mm=tubes.max_lateral_sweep_mm,
        max_strain=tubes.max_strain,
    )
    return _opened(tubes.nested, limits)


def shape_tree_of(tubes: ConcentricTubes) -> ShapeTree:
    """Return the tree of the shapes of a design."""
    return _tree(shapes_of(tubes))


def shapes_digest(tubes: ConcentricTubes) -> str:
    """Return a hash of the shapes of a design, "" for planar tubes, which have a closed form.

    Shapes near a limit may be in the set on one machine and not on another.
    """
    if tubes.planar:
        return ""
    shapes = shapes_of(tubes)
    parts = (shapes.insertions_mm, shapes.rotations_rad, shapes.arcs, shapes.first_arc)
    return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()


@lru_cache(maxsize=KEPT)
def _opened(tubes: tuple[Tube, ...], limits: ShapeLimits) -> TubeShapes:
    return open_shapes(tubes, limits)


@lru_cache(maxsize=KEPT)
def _tree(shapes: TubeShapes) -> ShapeTree:
    return tree_of_shapes(shapes)
