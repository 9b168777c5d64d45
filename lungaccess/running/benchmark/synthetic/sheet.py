"""The score sheet: one line a planner, and one a planner, family and device."""

import csv
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from statistics import median
from typing import Any

from anatomy.base.errors import FileError
from anatomy.base.files import atomic_write, read_json
from anatomy.base.records import frozen_value
from anatomy.base.words import of_hundred
from lungaccess.running.benchmark.runs import decimals, require_table_file
from lungaccess.running.benchmark.synthetic.manifest import manifest_sha256
from lungaccess.running.benchmark.synthetic.phantoms import VERSION
from lungaccess.running.benchmark.synthetic.scoring import (
    CERTIFIED,
    CLAIMED,
    MISSING,
    REFUSED,
    SOLVED,
    Score,
    refuted,
)

HEADINGS = (
    "planner", "family", "device", "queries", "solved", "solved, %", "refused", "proved none",
    "claims refuted", "first, s", "time, s", "cost", "cost, shared", "success, %", "breath, %", "not checked",
)  # fmt: skip
ALL = "all"


@frozen_value
class SheetLine:
    """One line of the score sheet.

    Args:
        planner, family, system: "all" for every family or device.
        queries, solved, refused, certified, refuted: Queries that count; answers that the check accepts; that
            it refuses; queries proved to have no plan; claims of that kind that another planner's accepted
            answer refutes.
        first_cpu_s, cpu_s: Medians of the stated processor times: to the first plan where solved, and of all
            answers.
        cost, shared_cost: Median cost of what is solved, and of those queries that all planners of the sheet
            solved.
        success, breath_share: Mean chance of success, and mean proved share of the breath, of what is solved.
        not_checked: Accepted answers of which the check could not look at everything.
    """

    planner: str
    family: str
    system: str
    queries: int
    solved: int
    refused: int
    certified: int
    refuted: int
    first_cpu_s: float | None
    cpu_s: float | None
    cost: float | None
    shared_cost: float | None
    success: float | None
    breath_share: float | None
    not_checked: int

    def cells(self) -> tuple[str, ...]:
        """Return the line as text; what is not known is empty."""
        solved, *others = (
            "" if each is None else of_hundred(each)
            for each in (self.solved / max(self.queries, 1), self.success, self.breath_share)
        )
        return (
            self.planner, self.family, self.system, f"{self.queries}", f"{self.solved}", solved,
            f"{self.refused}", f"{self.certified}", f"{self.refuted}", decimals(self.first_cpu_s, 3),
            decimals(self.cpu_s, 3), decimals(self.cost, 2), decimals(self.shared_cost, 2),
            *others, f"{self.not_checked}",
        )  # fmt: skip


def score_sheet(scores: Iterable[Score], *, by_family: bool = True) -> list[SheetLine]:
    """Return the lines of a sheet, a planner's whole result first.

    A planner counts for the queries that it has scores of.  With several planners compare the lines only
    where the numbers of queries agree; `shared_cost` is of the queries that all of them solved.
    """
    scores = list(scores)
    planners = list(dict.fromkeys(each.planner for each in scores))
    solved_by = [{s.query for s in scores if s.planner == p and s.status == SOLVED} for p in planners]
    shared = set.intersection(*solved_by) if len(planners) > 1 else set()
    wrong = refuted(scores)
    lines = []
    for planner in planners:
        own = [each for each in scores if each.planner == planner]
        lines.append(_line(planner, ALL, ALL, own, shared, wrong))
        if not by_family:
            continue
        for key in ("family", "system"):
            for value in dict.fromkeys(str(getattr(each, key)) for each in own):
                part = [each for each in own if getattr(each, key) == value]
                names = (value, ALL) if key == "family" else (ALL, value)
                lines.append(_line(planner, *names, part, shared, wrong))
    return lines


def _line(
    planner: str, family: str, system: str, scores: Sequence[Score], shared: set[str], wrong: dict[str, str]
) -> SheetLine:
    solved = [each for each in scores if each.status == SOLVED]
    return SheetLine(
        planner=planner,
        family=family,
        system=system,
        queries=len(scores),
        solved=len(solved),
        refused=sum(each.status == REFUSED for each in scores),
        certified=sum(each.status == CERTIFIED for each in scores),
        refuted=sum(each.status == CLAIMED and each.query in wrong for each in scores),
        first_cpu_s=_median([each.first_cpu_s for each in solved]),
        cpu_s=_median([each.cpu_s for each in scores if each.status != MISSING]),
        cost=_median([each.cost for each in solved]),
        shared_cost=_median([each.cost for each in solved if each.query in shared]),
        success=_mean([each.success for each in solved]),
        breath_share=_mean([each.breath_share for each in solved]),
        not_checked=sum(bool(each.not_checked) for each in solved),
    )


def _known(values: Iterable[float | None]) -> list[float]:
    return [each for each in values if each is not None]


def _median(values: Iterable[float | None]) -> float | None:
    known = _known(values)
    return median(known) if known else None


def _mean(values: Iterable[float | None]) -> float | None:
    known = _known(values)
    return sum(known) / len(known) if known else None


def write_sheet(lines: Iterable[SheetLine], path: Path) -> None:
    """Write the lines of a sheet by the suffix of the file, .csv or .json; errors as of `write_scores`."""
    _write_rows("sheet", SheetLine, [asdict(each) for each in lines], path)


def write_scores(scores: Iterable[Score], path: Path) -> None:
    """Write scores by the suffix of the file, .csv or .json; what is not known stays empty, or null.

    Raises:
        FileError: If the file cannot be written, or ends in something else.
    """
    _write_rows("scores", Score, [asdict(each) for each in scores], path)


def _write_rows(name: str, cls: type, rows: list[dict[str, Any]], path: Path) -> None:
    require_table_file(path)
    with atomic_write(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as stream:
        if path.suffix == ".json":
            about: dict[str, Any] = {"benchmark": VERSION, "manifest_sha256": manifest_sha256()}
            stream.write(json.dumps({**about, name: rows}, allow_nan=False) + "\n")
            return
        writer = csv.DictWriter(stream, [item.name for item in fields(cls)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def read_scores(path: Path) -> list[Score]:
    """Read scores that `write_scores` wrote as JSON.

    Raises:
        FileError: If the file cannot be read, holds something else, or is of another benchmark.
    """
    expected, remedy = (
        "scores in JSON",
        f"Write them with: lungaccess benchmark {VERSION} score ... --out scores.json",
    )
    content = read_json(path, expected=expected, remedy=remedy)
    if not isinstance(content, dict) or content.get("manifest_sha256") != manifest_sha256():
        raise FileError(f"{path} holds no scores of {VERSION}", expected=expected, remedy=remedy)
    try:
        return [Score(**row) for row in content["scores"]]
    except (KeyError, TypeError) as error:
        raise FileError(f"{path} holds damaged scores ({error})", expected=expected, remedy=remedy) from error
