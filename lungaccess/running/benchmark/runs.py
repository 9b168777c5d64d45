"""Runs of needle planners on published queries: what each came to, and as rows of CSV, JSON or a table."""

import csv
import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.base.errors import FileError
from anatomy.base.files import atomic_write
from anatomy.base.kernel_clock import working_cpu_s
from anatomy.base.records import frozen_value
from anatomy.liver import LiverImages
from anatomy.organ import Organ
from anatomy.patient import PatientImages
from lungaccess.planning.one_stage import PathSearch, needle_question, reason_in_words, search_path
from lungaccess.problem.system import System
from lungaccess.running.benchmark.published import (
    Key,
    PeerResult,
    PublishedQuery,
    known_median,
    patient_number,
    unc_needle,
    unc_obstacles,
)
from stages.needle import OMPL_PLANNERS, ArcPath, NeedleEnvironment, Query, obstacle_clearance_mm

SUFFIXES = (".csv", ".json")


@frozen_value
class BenchmarkRow:
    """One run of one planner on one query, or what keeps all of them from running.

    Args:
        start, target: Numbers of the published start and target, from 1; None for a patient without queries.
        planner: "" if the query is ruled out, by proof, before any planner begins.
        first_cpu_ms: Processor time to the first path, without compilation.
        first_length_mm, length_mm: Of the first and the last path, with the distance left to the target.
        clearance_mm, needed_clearance_mm: Least distance from the path's axis to obstacles, where the exit is
            not exempt, and what it must be.
        reason: Why there is no path; "" if there is one.
        arcs: The last path from the published start, as `ArcPath.arc_records` has it.
    """

    patient: str
    start: int | None = None
    target: int | None = None
    radius_mm: float | None = None
    # The planner of rows that hold for all planners: what is ruled out before any of them begins.
    planner: str = ""
    seed: int | None = None
    solved: bool = False
    first_cpu_ms: float | None = None
    first_length_mm: float | None = None
    length_mm: float | None = None
    clearance_mm: float | None = None
    needed_clearance_mm: float | None = None
    proved: bool = False
    reason: str = ""
    arcs: tuple[Mapping[str, float], ...] = ()


def run_query(
    environment: NeedleEnvironment,
    query: Query,
    published: PublishedQuery,
    radius_mm: float,
    planners: Iterable[str],
    seeds: Iterable[int],
    time_s: float,
) -> Iterator[BenchmarkRow]:
    """Run all planners on one query; a query ruled out by proof beforehand is answered once.

    `environment` and `query` are the published query with a radius, by the rules in force.

    Args:
        seeds: One run each; the resolution search draws nothing at random, so it runs once.
    """
    about = BenchmarkRow(
        patient=published.patient,
        start=published.start,
        target=published.target,
        radius_mm=radius_mm,
        needed_clearance_mm=environment.required_clearance_mm,
    )
    seeds, rows = tuple(seeds), list[BenchmarkRow]()
    for planner, seed in [(p, s) for p in planners for s in (seeds[:1] if p == "resolution" else seeds)]:
        drawn = None if planner in OMPL_PLANNERS else seed
        # A portion of iterations between two looks at the clock takes a fraction of a millisecond.
        found = search_path(
            environment, query, planner, seed=drawn, time_s=time_s, clock=working_cpu_s, portion=200
        )
        ruled_out = found.obstruction is not None and found.obstruction.proved
        own = about if ruled_out else replace(about, planner=planner, seed=drawn)
        rows.append(_row(own, environment, query, found))
        if ruled_out:
            break
    known = any(row.solved for row in rows)
    reason = "nothing found in the time given, though another planner found a path"
    for row in rows:
        yield replace(row, reason=reason) if known and not row.solved else row


def _row(
    about: BenchmarkRow, environment: NeedleEnvironment, query: Query, found: PathSearch
) -> BenchmarkRow:
    if found.path is None:
        proved = "proved" if found.proved else "not proved"
        reason = f"{found.outcome} in the time given (not proved)"
        if found.obstruction is not None:
            reason = f"{reason_in_words(found.obstruction)} ({proved})"
        return replace(about, proved=found.proved, reason=reason)
    first = found.first_path or found.path
    # Clearance is measured at points so far apart: a tenth of a voxel.
    points, lengths = found.path.sample(0.05)
    exempt_mm = environment.limits.exempt_mm if query.branch >= 0 else 0.0
    clear = obstacle_clearance_mm(environment.obstacles, points[lengths >= exempt_mm])
    return replace(
        about,
        proved=found.proved,
        solved=True,
        first_cpu_ms=None if found.first_path_s is None else 1e3 * found.first_path_s,
        first_length_mm=_length(first, query),
        length_mm=_length(found.path, query),
        clearance_mm=float(clear.min()) if len(clear) else None,
        arcs=tuple(found.path.arc_records()),
    )


def _length(path: ArcPath, query: Query) -> float:
    """Return the length of a path with the distance that it leaves to the target."""
    return path.length_mm + float(np.linalg.norm(path.frames()[-1][:3, 3] - query.target))


Pose = Callable[[PublishedQuery, float], tuple[NeedleEnvironment, Query]]
"""Makes the environment and the question of a published query with a needle of some radius in mm."""


def posed_in_lung(lung: Organ, system: System) -> Pose:
    """Return what poses queries by our rules: those of `lungaccess needle` with a system."""

    def pose(published: PublishedQuery, radius_mm: float) -> tuple[NeedleEnvironment, Query]:
        needle = replace(system.require_needle("A query of the needle"), max_curvature_per_mm=1.0 / radius_mm)
        asked = needle_question(
            lung, replace(system, needle=needle), published.lps_from_start, published.target_lps
        )
        return asked.environment, asked.query

    return pose


def posed_by_unc(images: PatientImages | LiverImages) -> Pose:
    """Return what poses queries by the rules of the peer; see `lungaccess.running.benchmark.published`."""
    obstacles = unc_obstacles(images)

    def pose(published: PublishedQuery, radius_mm: float) -> tuple[NeedleEnvironment, Query]:
        environment = obstacles.environment(
            unc_needle(radius_mm), published.lps_from_start, published.target_lps
        )
        return environment, Query(lps_from_start=published.lps_from_start, target=published.target_lps)

    return pose


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

    FileError is raised if the file cannot be written, or ends in something else.
    """
    columns = [field.name for field in fields(BenchmarkRow) if field.name != "arcs"]
    write_table(path, columns, {"runs": [asdict(row) for row in rows]}, indent=2, end="\r\n")


def write_table(
    path: Path, columns: Sequence[str], content: Mapping[str, Any], *, indent: int | None, end: str
) -> None:
    """Write a content as JSON, or of the records in its last entry some columns as CSV; see `write_rows`."""
    require_table_file(path)
    with atomic_write(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as stream:
        if path.suffix == ".json":
            stream.write(json.dumps(content, indent=indent, allow_nan=False) + "\n")
            return
        writer = csv.DictWriter(stream, columns, extrasaction="ignore", lineterminator=end)
        writer.writeheader()
        writer.writerows([*content.values()][-1])


HEADINGS = (
    "patient", "start", "target", "R, mm", "planner", "solved", "first, ms", "first, mm", "final, mm",
    "clearance, mm",
)  # fmt: skip


def summary_rows(
    rows: Iterable[BenchmarkRow], peer: Mapping[Key, PeerResult] | None
) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return headings and rows: medians over the seeds of each planner on each query, the peer's beside.

    Where a planner solved a query with some seeds only, its reason is that of an unsolved run.
    """
    groups: dict[tuple[object, ...], list[BenchmarkRow]] = defaultdict(list)
    for row in rows:
        groups[row.patient, row.start, row.target, row.radius_mm, row.planner].append(row)
    of_peer = () if peer is None else ("peer solved", "peer first, ms", "peer, mm")
    return (*HEADINGS, *of_peer, "reason"), [_summary(group, peer) for group in groups.values()]


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
        *(
            decimals(known_median(getattr(each, name) for each in solved), 2)
            for name in ("first_cpu_ms", "first_length_mm", "length_mm")
        ),
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


def decimals(value: float | None, digits: int) -> str:
    """Return a number with some decimals, nothing where there is none."""
    return "" if value is None else f"{value:.{digits}f}"
