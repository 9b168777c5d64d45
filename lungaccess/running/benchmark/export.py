"""Rows of a benchmark as CSV or JSON, one a run, and gathered over seeds, as people read them."""

import csv
import json
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import asdict, fields
from pathlib import Path
from statistics import median

from anatomy.base.errors import FileError
from anatomy.base.files import atomic_write
from lungaccess.running.benchmark.published import Key, PeerResult, patient_number
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


HEADINGS = (
    "patient", "start", "target", "R, mm", "planner", "solved", "first, ms", "first, mm", "final, mm",
    "clearance, mm",
)  # fmt: skip
PEER_HEADINGS = ("peer solved", "peer first, ms", "peer, mm")


def summary_rows(
    rows: Iterable[BenchmarkRow], peer: Mapping[Key, PeerResult] | None
) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return headings and rows: medians over the seeds of each planner on each query, the peer's beside.

    Where a planner solved a query with some seeds only, its reason is that of an unsolved run.
    """
    groups: dict[tuple[object, ...], list[BenchmarkRow]] = defaultdict(list)
    for row in rows:
        groups[row.patient, row.start, row.target, row.radius_mm, row.planner].append(row)
    headings = (*HEADINGS, *(PEER_HEADINGS if peer is not None else ()), "reason")
    return headings, [_summary(group, peer) for group in groups.values()]


def _summary(group: list[BenchmarkRow], peer: Mapping[Key, PeerResult] | None) -> tuple[str, ...]:
    row = group[0]
    solved = [each for each in group if each.solved]
    cells = [
        row.patient,
        decimals(row.start, 0),
        decimals(row.target, 0),
        decimals(row.radius_mm, 0),
        row.planner or ("all" if row.start else ""),
        f"{len(solved)}/{len(group)}" if row.planner else ("no" if row.start else ""),
        _median([each.first_cpu_ms for each in solved], 2),
        _median([each.first_length_mm for each in solved], 2),
        _median([each.length_mm for each in solved], 2),
        decimals(min((c for c in (each.clearance_mm for each in solved) if c is not None), default=None), 2),
    ]
    if peer is not None:
        cells += _peer_cells(row, peer)
    reasons = [each.reason for each in group if not each.solved]
    return (*cells, reasons[0] if reasons else "")


def _peer_cells(row: BenchmarkRow, peer: Mapping[Key, PeerResult]) -> list[str]:
    found = None
    if row.start is not None and row.radius_mm is not None and row.target == 1:
        found = peer.get((patient_number(row.patient), row.start, row.radius_mm))
    if found is None:
        return ["", "", ""]
    if found.refused:
        return ["refused", "", ""]
    return [
        f"{found.solved}/{found.runs} {found.planner}",
        decimals(found.first_cpu_ms, 2),
        decimals(found.length_mm, 2),
    ]


def _median(values: Iterable[float | None], digits: int) -> str:
    known = [value for value in values if value is not None]
    return decimals(median(known), digits) if known else ""


def decimals(value: float | None, digits: int) -> str:
    """Return a number with some decimals, nothing where there is none."""
    return "" if value is None else f"{value:.{digits}f}"
