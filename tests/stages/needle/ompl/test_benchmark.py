"""OMPL's benchmark of our searches."""

from __future__ import annotations

from pathlib import Path

import pytest
from ompl.tools import readBenchmarkLog

from anatomy.base.errors import FileError, SettingsError
from stages.needle.environment import NeedleEnvironment
from stages.needle.ompl import NeedleProblem, benchmark
from stages.needle.search.planners import searches
from tests.stages.needle.ompl.problems import LONG_S, NEAR, OMPL_PLANNERS, arcs_of, ask, given, query, require


@pytest.mark.slow
def test_the_benchmark_of_ompl_takes_all_planners(problem: NeedleProblem, tmp_path: Path) -> None:
    log = tmp_path / "needle.log"
    results = benchmark(
        problem, query(NEAR), time_s=LONG_S, runs=2, goal_tolerance_mm=4.0, file=log, seed=3
    )  # fmt: skip
    assert list(results) == [*searches(), *OMPL_PLANNERS]
    for name, result in results.items():
        assert result.runs == 2 and result.name == name
        assert result.solved_share + len(result.refusals) / 2 == 1.0
        assert all(0.0 < time < LONG_S for time in result.times_s)
        assert all(20.0 < length < 100.0 for length in result.lengths_mm)
    assert all(results[name].solved_share == 1.0 for name in searches())
    assert list(tmp_path.iterdir()) == [log]
    text = log.read_text(encoding="utf-8")
    assert text.startswith("OMPL version") and "control_KPIECE1" in text


def test_the_log_of_a_benchmark_can_be_read_by_ompl(problem: NeedleProblem, tmp_path: Path) -> None:
    import sqlite3

    log = tmp_path / "needle.log"
    results = benchmark(problem, query(), time_s=LONG_S, runs=3, planners=["rrt"], file=log)
    readBenchmarkLog(str(tmp_path / "needle.db"), [str(log)], None)
    with sqlite3.connect(tmp_path / "needle.db") as database:
        rows = database.execute("SELECT solved, proved, path_length_mm, time FROM runs").fetchall()
    database.close()
    assert [row[:2] for row in rows] == [(1, 1)] * 3
    assert [row[2] for row in rows] == pytest.approx(results["rrt"].lengths_mm, abs=1e-6)
    assert [row[3] for row in rows] == pytest.approx(results["rrt"].times_s, rel=1e-3)
    # Runs differ by their seeds, and each is what `plan` finds with that seed.
    expected = [require(ask(problem, seed)).length_mm for seed in (1, 2, 3)]
    assert results["rrt"].lengths_mm == pytest.approx(expected)


def test_a_benchmark_counts_what_it_refuses_apart(environment: NeedleEnvironment) -> None:
    through = arcs_of((40.0, 0.0, 0.0))
    problem = NeedleProblem(environment, {"given": given(through)})
    result = benchmark(
        problem, query(through.frames()[-1][:3, 3]), time_s=1.0, runs=2, planners=["given"]
    )["given"]  # fmt: skip
    assert result.solved_share == 0.0 and result.times_s == result.lengths_mm == ()
    assert result.refusals == ("too near: vessel",) * 2


def test_a_benchmark_refuses_what_it_cannot_run(
    problem: NeedleProblem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(SettingsError, match="control.SST"):
        benchmark(problem, query(), time_s=1.0, runs=1, planners=["control.SST"])
    with pytest.raises(SettingsError, match="0 times"):
        benchmark(problem, query(), time_s=1.0, runs=0)
    # OMPL would write a log of a name of its own to the working directory.
    monkeypatch.chdir(tmp_path)
    (tmp_path / "no folder").touch()
    with pytest.raises(FileError):
        benchmark(
            problem, query(), time_s=1.0, runs=1, planners=["rrt"], file=tmp_path / "no folder" / "x.log"
        )
    assert [file.name for file in tmp_path.iterdir()] == ["no folder"]
