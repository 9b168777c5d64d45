"""The tables of a results file as a user wants them, as CSV or Parquet, and how two files differ."""

import csv
import json
from collections.abc import Callable, Iterator
from itertools import islice, zip_longest
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any, NamedTuple

from anatomy.base.files import DAMAGE, atomic_write, require_writable_folder
from anatomy.base.records import frozen_value
from lungaccess.running.study.results import COST_COLUMNS, ResultsFile
from lungaccess.running.study.settings import StudyError
from stages.needle import TERMS

if TYPE_CHECKING:
    import pyarrow

MOST = 20
"""At most this many differences are listed: enough to see what kind they are."""

TIMES = frozenset({"time", "cpu_time", "first_solution_time", "memory"})
"""Columns that two equal runs may differ in."""


def _column(cost: str) -> str:
    """Return what reads a cost: its column, or where it has none, from the plan or the needle path stored."""
    if cost in COST_COLUMNS:
        return f"r.{COST_COLUMNS[cost]}"
    stated = (f"json_extract(l.plan, '$.{place}.{cost}')" for place in ("costs", "path.costs"))
    return f"coalesce({', '.join(stated)}) AS {cost}"


_RUNS = f"""
SELECT r.key, p.case_name AS "case", p.patient, p.lung, p.system, p.fissures_allowed, p.objective, p.target,
       p.origin, p.x_lps_mm, p.y_lps_mm, p.z_lps_mm, p.start, p.iterations AS iterations_allowed,
       p.time_s AS time_allowed_s, e.version, c.name AS planner, c.settings AS planner_settings, r.seed,
       o.outcome, o.failed, o.message, o.advice, r.solved, r.correct_solution, r.status, r.iterations,
       r.solutions, r.cost, {", ".join(_column(term.key) for term in TERMS)},
       json_extract(l.plan, '$.chance.errors') AS errors,
       json_extract(l.plan, '$.chance.procedure') AS procedure,
       json_extract(l.plan, '$.chance.samples') AS success_samples,
       json_extract(l.plan, '$.chance.successes') AS successes,
       r.time, r.cpu_time, r.first_solution_time, r.memory
FROM runs r JOIN outcomes o ON o.runid = r.id JOIN plannerConfigs c ON c.id = r.plannerid
     JOIN experiments e ON e.id = r.experimentid JOIN problems p ON p.experimentid = e.id
     LEFT JOIN plans l ON l.runid = r.id
ORDER BY p.case_name, p.target, p.start, c.name, r.seed, r.key"""

QUERIES = {
    "runs": _RUNS,
    "progress": """
SELECT r.key, row_number() OVER (PARTITION BY t.runid ORDER BY t.time) AS number, t.iterations, t.best_cost,
       t.time FROM progress t JOIN runs r ON r.id = t.runid ORDER BY r.key, t.time""",
    "findings": """
SELECT r.key, t.number, t.name, t.ok, t.value, t.bound, t.side, t.tolerance, t.unit, t.detail
FROM findings t JOIN runs r ON r.id = t.runid ORDER BY r.key, t.number""",
    "rejections": """
SELECT r.key, t.reason, t.count FROM rejections t JOIN runs r ON r.id = t.runid ORDER BY r.key, t.reason""",
    "plans": """
SELECT r.key, t.digest, t.plan FROM plans t JOIN runs r ON r.id = t.runid ORDER BY r.key""",
}
"""The queries whose rows are exported and compared, by the name of the table."""

INTEGERS = frozenset(
    {
        "target", "start", "iterations_allowed", "seed", "status", "iterations", "solutions", "number",
        "count", "success_samples", "successes",
    }
)  # fmt: skip
TRUTHS = frozenset({"fissures_allowed", "failed", "solved", "correct_solution", "ok"})
TEXTS = frozenset(
    {
        "key", "case", "patient", "lung", "system", "objective", "origin", "version", "planner",
        "planner_settings", "outcome", "message", "advice", "name", "side", "unit", "detail", "reason",
        "digest", "plan", "errors", "procedure",
    }
)  # fmt: skip
"""Kinds of columns; every other one holds real numbers."""


class Table(NamedTuple):
    """A table's column names, and its rows as they are read."""

    columns: tuple[str, ...]
    rows: Iterator[tuple[Any, ...]]


def table(results: ResultsFile, name: str) -> Table:
    """Return one of the tables of `QUERIES`; FileError if the file cannot be read."""
    return Table(results.columns(QUERIES[name]), results.rows(QUERIES[name]))


def differences(first: Path, second: Path) -> list[str]:
    """Compare every row of two results files, but for times and memory; return at most `MOST` differences.

    Runs, costs over iterations, findings, rejections and plans are compared value by value; a number must be
    the same to the last bit.  FileError is raised if a file cannot be read.
    """
    found: list[str] = []
    with ResultsFile(first) as one, ResultsFile(second) as two:
        for name in QUERIES:
            columns, rows = table(one, name)
            kept = [n for n, column in enumerate(columns) if column not in TIMES]
            for a, b in zip_longest(rows, table(two, name).rows):
                if len(found) == MOST:
                    return found
                if a is None or b is None:
                    found.append(f"{name}: {'second' if a is None else 'first'} file alone: {_short(a or b)}")
                    break
                wrong = [columns[n] for n in kept if _plain(columns[n], a[n]) != _plain(columns[n], b[n])]
                if wrong:
                    found.append(f"{name}: {', '.join(wrong)} of {_short(a)}")
    return found


def _plain(column: str, value: Any) -> Any:
    """Return a value without the times in it; a plan that is damaged, as its text."""
    if column != "plan":
        return value
    try:
        return {key: part for key, part in json.loads(value).items() if key != "timing"}
    except DAMAGE:
        return value


def _short(row: tuple[Any, ...]) -> str:
    return ", ".join(str(value)[:40] for value in row[:4])


def export_csv(path: Path, folder: Path) -> list[Path]:
    """Write the tables as CSV with headings, numbers without loss; return the files; FileError if not."""
    return _export(path, folder, ".csv", _write_csv)


def _export(path: Path, folder: Path, suffix: str, write: Callable[[Table, Path], None]) -> list[Path]:
    require_writable_folder(folder)
    written = []
    with ResultsFile(path) as results:
        for name in QUERIES:
            target = folder / f"{name}{suffix}"
            with atomic_write(target) as temporary:
                write(table(results, name), temporary)
            written.append(target)
    return written


def _write_csv(content: Table, path: Path) -> None:
    with open(path, "w", newline="", encoding="utf-8") as stream:
        csv.writer(stream).writerow(content.columns)
        csv.writer(stream).writerows(content.rows)


def export_parquet(path: Path, folder: Path) -> list[Path]:
    """Write the tables of a results file as Parquet, as `export_csv` does; StudyError without pyarrow."""
    try:
        import pyarrow.parquet  # noqa: F401
    except ImportError as error:
        raise StudyError(
            f"Parquet needs a library that is not installed ({error})",
            expected="pyarrow",
            remedy="pip install 'lungaccess[study]', or export CSV",
        ) from error
    return _export(path, folder, ".parquet", _write_parquet)


def _write_parquet(content: Table, path: Path) -> None:
    import pyarrow
    from pyarrow import parquet

    schema = pyarrow.schema([(name, _kind(name)) for name in content.columns])
    with parquet.ParquetWriter(path, schema) as writer:
        # Rows of a group in a Parquet file: large enough to compress well, small enough to hold in memory.
        while batch := list(islice(content.rows, 5000)):
            arrays = [
                pyarrow.array(
                    [bool(v) if name in TRUTHS else v for v in values], type=schema.field(name).type
                )
                for name, values in zip(content.columns, zip(*batch, strict=True), strict=True)
            ]
            writer.write_batch(pyarrow.record_batch(arrays, schema=schema))


def _kind(column: str) -> "pyarrow.DataType":
    import pyarrow

    if column in TEXTS:
        return pyarrow.string()
    if column in TRUTHS:
        return pyarrow.bool_()
    return pyarrow.int64() if column in INTEGERS else pyarrow.float64()


_QUERY = """
SELECT p.case_name, p.objective, c.name,
       o.failed, r.solved, r.correct_solution, r.first_solution_time, r.time, r.cost,
       1.0 * json_extract(l.plan, '$.chance.successes') / json_extract(l.plan, '$.chance.samples')
FROM runs r JOIN outcomes o ON o.runid = r.id JOIN plannerConfigs c ON c.id = r.plannerid
     JOIN problems p ON p.experimentid = r.experimentid LEFT JOIN plans l ON l.runid = r.id
ORDER BY p.case_name, p.objective, c.name, r.key"""


@frozen_value
class Group:
    """The runs of one case with one planner; those that `failed` will be made again and count nowhere else.

    Args:
        accepted_share: Share of the plans that the check accepts; 0 if there is none.
        first_plan_s: Median and largest planning time of the first plan.
        cost, success: Medians of the best plans; the chance is None where the study counts none.
    """

    case: str
    objective: str
    planner: str
    runs: int
    failed: int
    solved_share: float
    accepted_share: float
    first_plan_s: tuple[float, float] | None
    run_s: float
    cost: float | None
    success: float | None = None


def summarise(path: Path) -> list[Group]:
    """Summarise a results file by case, objective and planner; FileError if the file cannot be read."""
    groups: dict[tuple[str, str, str], list[tuple[Any, ...]]] = {}
    with ResultsFile(path) as results:
        for case, objective, planner, *values in results.rows(_QUERY):
            groups.setdefault((case, objective, planner), []).append(tuple(values))
    return [_group(*names, rows) for names, rows in groups.items()]


def _group(case: str, objective: str, planner: str, rows: list[tuple[Any, ...]]) -> Group:
    made = [row[1:] for row in rows if not row[0]]
    solved = [row for row in made if row[0]]
    first = [row[2] for row in solved]
    chances = [row[5] for row in solved if row[5] is not None]
    return Group(
        case=case,
        objective=objective,
        planner=planner,
        runs=len(rows),
        failed=len(rows) - len(made),
        solved_share=len(solved) / len(made) if made else 0.0,
        accepted_share=sum(row[1] for row in solved) / len(solved) if solved else 0.0,
        first_plan_s=(median(first), max(first)) if first else None,
        run_s=median(row[3] for row in made) if made else 0.0,
        cost=median(row[4] for row in solved) if solved else None,
        success=median(chances) if chances else None,
    )
