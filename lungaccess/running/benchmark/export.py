"""Rows of a benchmark as CSV or JSON, one a run; JSON has the paths, too."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable
from dataclasses import asdict, fields
from pathlib import Path

from anatomy.base.errors import FileError
from anatomy.base.files import atomic_write
from lungaccess.running.benchmark.runs import BenchmarkRow

SUFFIXES = (".csv", ".json")


def require_table_file(path: Path) -> None:
    """Raise FileError unless a path ends in .csv or .json."""
    if path.suffix not in SUFFIXES:
        raise FileError(
            f"The results cannot be written to {path}",
            expected="a file that ends in .csv or .json",
            remedy="Choose a name such as runs.csv",
        )


def write_rows(rows: Iterable[BenchmarkRow], path: Path) -> None:
    """Write the rows by the suffix of the file; what is not known stays empty, or null; a table has no arcs.

    Raises
    ------
    FileError
        If the file cannot be written, or ends in something else.
    """
    require_table_file(path)
    records = [asdict(row) for row in rows]
    with atomic_write(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as stream:
        if path.suffix == ".json":
            stream.write(json.dumps({"runs": records}, indent=2, allow_nan=False) + "\n")
            return
        columns = [field.name for field in fields(BenchmarkRow) if field.name != "arcs"]
        writer = csv.DictWriter(stream, columns, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(records)
