"""How the best cost fell while a search ran, as a table."""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence
from pathlib import Path

from anatomy.base.files import atomic_write
from anatomy.base.records import frozen_value


@frozen_value
class CostPoint:
    """The state of a search at one moment.

    Parameters
    ----------
    elapsed_s : float
        Planning time since the search began.
    best_cost : float or None
        Cost of the best plan yet, in the unit of the objective; None before the first plan.
    """

    elapsed_s: float
    iteration: int
    best_cost: float | None


def cost_over_time_csv(history: Sequence[CostPoint], path: str | os.PathLike[str]) -> Path:
    """Write one line a point: elapsed_s, iteration, best_cost (empty before the first plan).

    Raises
    ------
    anatomy.base.errors.FileError
        If the file cannot be written.
    """
    with atomic_write(Path(path)) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["elapsed_s", "iteration", "best_cost"])
        for point in history:
            cost = "" if point.best_cost is None else repr(float(point.best_cost))
            writer.writerow([f"{point.elapsed_s:.6f}", point.iteration, cost])
    return Path(path)
