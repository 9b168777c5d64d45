"""Shapes of designs on disk: one file a design, limits and grid, whatever the patient."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from anatomy.base.settings import to_mapping
from anatomy.kept_records import kept_record
from anatomy.machine_code.sources import kernel_digest
from stages.tube.device import Tube
from stages.tube.shapes import ShapeGrid, ShapeLimits, TubeShapes, tube_shapes

SHAPES_FORMAT = 2
"""Raise it when shapes change: stored ones of another format are made anew."""


def shapes_format() -> str:
    """Return what tells shapes of this version and these kernels from all others."""
    return f"{SHAPES_FORMAT}-{kernel_digest('stages.tube')}"


def open_shapes(
    tubes: Sequence[Tube],
    limits: ShapeLimits | None = None,
    grid: ShapeGrid | None = None,
    *,
    cache: str | os.PathLike[str] | None = None,
) -> TubeShapes:
    """Return the shapes of a design from the cache, or make and keep them.

    Parameters and errors are those of `stages.tube.shapes.tube_shapes` and, for the cache, of
    `anatomy.kept_records.kept_record`.
    """
    limits, grid = limits or ShapeLimits(), grid or ShapeGrid.default(tubes)

    def rebuilt(values: dict[str, Any]) -> TubeShapes:
        stored = {name: value for name, value in values.items() if name not in ("format", "name")}
        return TubeShapes(tubes=tuple(tubes), limits=limits, grid=grid, **stored)

    design = {
        "tubes": [to_mapping(tube) for tube in tubes],
        "limits": to_mapping(limits),
        "grid": to_mapping(grid),
    }
    return kept_record(
        "shapes",
        shapes_format(),
        design,
        make=lambda: tube_shapes(tubes, limits, grid),
        parts=_parts,
        rebuilt=rebuilt,
        cache=cache,
    )


def _parts(shapes: TubeShapes) -> dict[str, Any]:
    values = {field.name: getattr(shapes, field.name) for field in fields(shapes)}
    arrays = {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
    return {"candidates": shapes.candidates, "refused": shapes.refused, **arrays}
