"""All that a design of tubes can do, whatever the patient: the answer, and how it is written down."""

import os
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.base.files import atomic_write
from lungaccess.planning.one_stage.tubes import BareTubes, tubes_of
from lungaccess.problem.system import System
from stages.tube import ShapeLimits, TubeShapes, open_shapes


def design_shapes(device: System | BareTubes, *, cache: str | os.PathLike[str] | None = None) -> TubeShapes:
    """Return the shapes of a design, from the cache if they are there.

    Args:
        device: The limits are those of the system; bare tubes have those of `ShapeLimits()`.

    Raises:
        SettingsError, FileError: As `stages.tube.open_shapes`.
    """
    limits, needle = ShapeLimits(), None
    if isinstance(device, System):
        stated = device.tubes
        needle = stated.needle_shaft
        limits = ShapeLimits(
            max_extension_mm=stated.max_extension_mm,
            max_lateral_sweep_mm=stated.max_lateral_sweep_mm,
            max_strain=stated.max_strain,
        )
    return open_shapes(tubes_of(device), limits, needle=needle, cache=cache)


def shapes_record(name: str, shapes: TubeShapes) -> dict[str, Any]:
    """Return what a design can do as plain JSON types: mm, rad."""
    tips = shapes.scope_from_tip
    aside = np.hypot(tips[:, 0, 3], tips[:, 1, 3])
    turned = np.arccos(np.clip(tips[:, 2, 2], -1.0, 1.0))
    largest = {
        "tip_aside_mm": aside,
        "tip_ahead_mm": tips[:, 2, 3],
        "tip_turned_rad": turned,
        "lateral_sweep_mm": shapes.lateral_sweep_mm,
        "follow_the_leader_error_mm": shapes.follow_the_leader_error_mm,
        "strain": shapes.strain,
        "arc_error_mm": shapes.arc_error_mm,
    }
    return {
        "name": name,
        "n_tubes": len(shapes.tubes),
        "stop_mm": shapes.grid.stop_mm,
        "relative_rotations": len(np.unique(shapes.rotations_rad, axis=0)),
        "candidates": shapes.candidates,
        "shapes": shapes.count,
        "refused": shapes.refused,
        "largest": {key: float(values.max()) if shapes.count else None for key, values in largest.items()},
        "least_determinant": float(shapes.least_determinant.min()) if shapes.count else None,
    }


def save_shapes(shapes: TubeShapes, path: Path) -> None:
    """Write a table of all shapes as CSV: insertions and rotations from the innermost tube, tip, and costs.

    Raises:
        FileError: If the file cannot be written.
    """
    n = len(shapes.tubes)
    columns = {
        **{f"insertion_{i + 1}_mm": shapes.insertions_mm[:, i] for i in range(n)},
        **{f"rotation_{i + 1}_rad": shapes.rotations_rad[:, i] for i in range(n)},
        **{f"tip_{axis}_mm": shapes.scope_from_tip[:, i, 3] for i, axis in enumerate("xyz")},
        **{f"tangent_{axis}": shapes.scope_from_tip[:, i, 2] for i, axis in enumerate("xyz")},
        "least_determinant": shapes.least_determinant,
        "lateral_sweep_mm": shapes.lateral_sweep_mm,
        "follow_the_leader_error_mm": shapes.follow_the_leader_error_mm,
        "strain": shapes.strain,
        "arc_error_mm": shapes.arc_error_mm,
    }
    table = np.stack(list(columns.values()), axis=1)
    with atomic_write(path) as temporary:
        np.savetxt(temporary, table, fmt="%.9g", delimiter=",", header=",".join(columns), comments="")
