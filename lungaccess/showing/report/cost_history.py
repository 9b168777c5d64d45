"""The best cost of a search over time, and its table, without a library of pictures."""

import csv
import os
from collections.abc import Sequence
from pathlib import Path

from anatomy.base.files import atomic_write
from anatomy.base.records import frozen_value


@frozen_value
class CostPoint:
    """The state of a search at one moment.

    Args:
        elapsed_s: Planning time since the search began.
        best: Value of the goal for the best plan yet, in its unit; None before the first plan.
    """

    elapsed_s: float
    iteration: int
    best: float | None


def cost_over_time_csv(history: Sequence[CostPoint], path: str | os.PathLike[str]) -> Path:
    """Write one line a point: elapsed_s, iteration, best (empty before the first plan).

    Raises FileError if the file cannot be written.
    """
    with atomic_write(Path(path)) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["elapsed_s", "iteration", "best"])
        for point in history:
            best = "" if point.best is None else repr(float(point.best))
            writer.writerow([f"{point.elapsed_s:.6f}", point.iteration, best])
    return Path(path)
