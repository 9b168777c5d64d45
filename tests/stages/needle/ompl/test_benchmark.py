"""OMPL's benchmark of our searches."""

from __future__ import annotations

from pathlib import Path

from ompl.tools import readBenchmarkLog

from stages.needle.ompl import NeedleProblem
from tests.stages.needle.ompl.problems import ompls_benchmark


def test_the_benchmark_of_ompl_takes_our_planner_and_reads_its_log(
    problem: NeedleProblem, tmp_path: Path
) -> None:
    import sqlite3

    log = tmp_path / "needle.log"
    solved = ompls_benchmark(problem, log)
    readBenchmarkLog(str(tmp_path / "needle.db"), [str(log)], None)
    with sqlite3.connect(tmp_path / "needle.db") as database:
        rows = database.execute("SELECT solved FROM runs").fetchall()
    database.close()
    assert [row[0] for row in rows] == [1, 1, 1] == solved
