"""Shapes of designs on disk: one file a design, limits and grid, whatever the patient."""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.cache import cache_limit_bytes, default_cache
from anatomy.cache_entries import make_room, note_use
from anatomy.errors import FileError
from anatomy.grid import read_only
from anatomy.io.files import atomic_write
from anatomy.settings import to_mapping
from stages.tube.device import Tube
from stages.tube.shapes import ShapeGrid, ShapeLimits, TubeShapes, tube_shapes

SHAPES_FORMAT = 2
"""Raise it when shapes change: stored ones of another format are made anew."""
DAMAGE = (OSError, EOFError, ValueError, KeyError, TypeError, zipfile.BadZipFile)
"""What reading a damaged or foreign file raises; the shapes are then made anew."""


def open_shapes(
    tubes: Sequence[Tube],
    limits: ShapeLimits | None = None,
    grid: ShapeGrid | None = None,
    *,
    cache: Path | None = None,
) -> TubeShapes:
    """Return the shapes of a design from the cache, or make and keep them.

    Parameters and errors are those of `stages.tube.shapes.tube_shapes`.

    Parameters
    ----------
    cache : Path, optional
        Folder of the cache; `anatomy.cache.default_cache()` if None.

    Raises
    ------
    FileError
        If the file cannot be written.
    """
    limits, grid = limits or ShapeLimits(), grid or ShapeGrid.default(tubes)
    design = {
        "format": SHAPES_FORMAT,
        "tubes": [to_mapping(tube) for tube in tubes],
        "limits": to_mapping(limits),
        "grid": to_mapping(grid),
    }
    key = hashlib.sha256(json.dumps(design, sort_keys=True, default=list).encode()).hexdigest()
    path = (cache or default_cache()) / f"shapes-{key}.npz"
    stored = _load(path, tubes, limits, grid)
    if stored is not None:
        note_use(path)
        return stored
    most_bytes = cache_limit_bytes()
    made = tube_shapes(tubes, limits, grid)
    _save(made, path)
    make_room(path.parent, most_bytes, {"shapes": SHAPES_FORMAT}, keep=(path,))
    return made


def _arrays(shapes: TubeShapes) -> dict[str, Any]:
    values = {field.name: getattr(shapes, field.name) for field in fields(shapes)}
    return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}


def _save(shapes: TubeShapes, path: Path) -> None:
    rest = {"format": SHAPES_FORMAT, "name": "", "candidates": shapes.candidates, "refused": shapes.refused}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as temporary, open(temporary, "wb") as stream:
            np.savez(stream, rest=np.array(json.dumps(rest)), **_arrays(shapes))
    except OSError as error:
        raise FileError(
            f"The shapes of the tubes cannot be stored in {path.parent}: {error}",
            remedy="Choose another folder with --cache or LUNGACCESS_CACHE",
            expected="a folder that may be written to, with room on the disk",
        ) from error


def _load(path: Path, tubes: Sequence[Tube], limits: ShapeLimits, grid: ShapeGrid) -> TubeShapes | None:
    """Read shapes; None if there are none or the file is damaged."""
    try:
        with np.load(path) as stored:
            arrays: Any = {name: read_only(stored[name]) for name in stored.files if name != "rest"}
            rest = json.loads(str(stored["rest"]))
        return TubeShapes(
            tubes=tuple(tubes),
            limits=limits,
            grid=grid,
            candidates=rest["candidates"],
            refused=rest["refused"],
            **arrays,
        )
    except DAMAGE:
        return None
