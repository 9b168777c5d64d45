"""Whether two results files hold the same runs with the same answers."""

import json
from itertools import zip_longest
from pathlib import Path
from typing import Any

from anatomy.base.files import DAMAGE
from lungaccess.running.study.results import ResultsFile
from lungaccess.running.study.tables import QUERIES, TIMES, table

MOST = 20
"""At most this many differences are listed: enough to see what kind they are."""


def differences(first: Path, second: Path) -> list[str]:
    """Compare every row of two results files, but for times and memory.

    Runs, costs over iterations, findings, rejections and plans are compared value by value; a number must be
    the same to the last bit.

    Returns
    -------
    list of str
        What differs, in words, at most `MOST`; empty if nothing does.

    Raises
    ------
    FileError
        If a file cannot be read.
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
