"""The results file: each run once, all of it or nothing, and a word for everything that can go wrong."""

from __future__ import annotations

import pickle
import sqlite3
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from anatomy.base.errors import FileError
from lungaccess.running.study import results as results_module
from lungaccess.running.study.results import APPLICATION_ID, ResultsFile
from lungaccess.running.study.runs import CRASH, Run
from lungaccess.running.study.tables import differences
from tests.lungaccess.running.study.toys import toy_answer

CHILDREN = ("outcomes", "plans", "progress", "findings")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "results.db"


def counts(path: Path) -> dict[str, int]:
    tables = ("experiments", "problems", "plannerConfigs", "runs", *CHILDREN, "rejections")
    with ResultsFile(path) as results:
        return {name: next(results.rows(f"SELECT count(*) FROM {name}"))[0] for name in tables}


def fill(path: Path, runs: list[Run], **changes: Any) -> list[bool]:
    with ResultsFile(path, create=True) as results:
        return [results.add(run, toy_answer(run, **changes)) for run in runs]


def test_a_run_is_stored_once_and_whole(path: Path, runs: list[Run]) -> None:
    assert fill(path, runs) == [True] * 4
    first = counts(path)
    assert fill(path, runs) == [False] * 4
    assert counts(path) == first
    assert (first["experiments"], first["problems"], first["plannerConfigs"], first["runs"]) == (2, 2, 1, 4)
    assert [first[name] for name in CHILDREN] == [4, 4, 8, 4]
    with ResultsFile(path) as results:
        assert results.finished_keys() == {run.key for run in runs}
        assert list(results.rows("SELECT runcount, totaltime FROM experiments")) == [(2, 0.5), (2, 0.5)]
        assert next(results.rows("SELECT cost FROM runs"))[0] == 0.1 + 0.2


def test_what_failed_is_made_again_and_replaced_by_nothing_worse(path: Path, runs: list[Run]) -> None:
    failed = {"failed": True, "outcome": "FileError", "status": CRASH, "plan": "", "improvements": ()}
    assert fill(path, runs, **failed) == [True] * 4
    with ResultsFile(path) as results:
        assert results.finished_keys() == set()
    assert fill(path, runs) == [True] * 4
    assert fill(path, runs, **failed) == [False] * 4
    assert [counts(path)[name] for name in ("runs", *CHILDREN)] == [4, 4, 4, 8, 4]
    with ResultsFile(path) as results:
        assert results.finished_keys() == {run.key for run in runs}


def test_a_run_that_cannot_be_stored_leaves_nothing(path: Path, runs: list[Run]) -> None:
    fill(path, runs[:1])
    before = counts(path)
    broken = toy_answer(runs[3], rejections={"a reason": object()})  # type: ignore[dict-item]
    with ResultsFile(path) as results:
        with pytest.raises(FileError):
            results.add(runs[3], broken)
        assert results.add(runs[2], toy_answer(runs[2]))
    assert counts(path)["runs"] == before["runs"] + 1
    assert counts(path)["experiments"] == 2


@pytest.mark.ompl
def test_the_tables_are_those_of_ompl(path: Path, runs: list[Run], tmp_path: Path) -> None:
    """Every column that OMPL's own reader makes is there, and its views can be made."""
    from ompl import tools

    fill(path, runs)
    theirs = tmp_path / "ompl.db"
    tools.readBenchmarkLog(str(theirs), [], False)
    tools.computeViews(str(path), False)
    with sqlite3.connect(theirs) as one, sqlite3.connect(path) as two:
        for (name,) in one.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall():
            wanted = [row[1] for row in one.execute(f"PRAGMA table_info({name})")]
            found = [row[1] for row in two.execute(f"PRAGMA table_info({name})")]
            assert found[: len(wanted)] == wanted, name
        best = two.execute("SELECT * FROM bestPlannerConfigsPerExperiment").fetchall()
        assert best == [(1, 1, 1.0, 0.25), (1, 2, 1.0, 0.25)]


def test_results_are_equal_but_for_times(path: Path, runs: list[Run], tmp_path: Path) -> None:
    other = tmp_path / "other.db"
    fill(path, runs)
    fill(other, runs[::-1], time_s=9.0, cpu_s=8.0, memory_mb=1.0)
    assert differences(path, other) == []
    with sqlite3.connect(other) as connection:
        connection.execute("UPDATE runs SET cost = cost * (1 + 1e-15) WHERE id = 1")
        connection.execute("UPDATE findings SET ok = 0 WHERE runid = 2")
        connection.execute("""UPDATE plans SET plan = '{"schema": "other"}' WHERE runid = 3""")
        connection.execute("UPDATE progress SET best_cost = 2 WHERE runid = 4 AND iterations = 0")
    found = differences(path, other)
    assert [each.split(":")[0] for each in found] == ["runs", "progress", "findings", "plans"]
    third = tmp_path / "third.db"
    fill(third, runs[:3])
    assert any("first file alone" in each for each in differences(path, third))
    assert any("second file alone" in each for each in differences(third, path))


def test_no_file_and_no_folder(path: Path) -> None:
    with pytest.raises(FileError, match="no file"):
        ResultsFile(path)
    with pytest.raises(FileError, match="cannot be used"):
        ResultsFile(path / "below" / "results.db", create=True)


def test_a_foreign_file_is_left_as_it_is(path: Path) -> None:
    path.write_bytes(b"nothing like a database" * 500)
    before = path.read_bytes()
    with pytest.raises(FileError, match="not a database"):
        ResultsFile(path, create=True)
    assert path.read_bytes() == before


def test_another_database_is_left_as_it_is(path: Path) -> None:
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE TABLE experiments (id INTEGER)")
    connection.close()
    before = path.read_bytes()
    with pytest.raises(FileError, match="another kind or format"):
        ResultsFile(path, create=True)
    assert path.read_bytes() == before


def test_another_format_is_refused(path: Path, runs: list[Run]) -> None:
    fill(path, runs[:1])
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA user_version = 99")
    connection.close()
    with pytest.raises(FileError, match=f"{APPLICATION_ID}, 99"):
        ResultsFile(path)


@pytest.mark.parametrize("kept", [0.3, 0.6, 0.9])
def test_a_truncated_file_is_refused(path: Path, runs: list[Run], kept: float) -> None:
    fill(path, runs)
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * kept)])
    with pytest.raises(FileError, match="damaged"):
        ResultsFile(path)


def test_damaged_pages_are_found_at_opening(path: Path, runs: list[Run]) -> None:
    fill(path, runs)
    content = bytearray(path.read_bytes())
    for begin in range(4096, len(content), 4096):
        content[begin : begin + 16] = b"\xff" * 16
    path.write_bytes(bytes(content))
    with pytest.raises(FileError, match="damaged"):
        ResultsFile(path)


def test_a_locked_file_is_named(path: Path, runs: list[Run], monkeypatch: pytest.MonkeyPatch) -> None:
    fill(path, runs[:1])
    monkeypatch.setattr(results_module, "BUSY_S", 0.05)
    holder = sqlite3.connect(path, isolation_level=None)
    holder.execute("BEGIN IMMEDIATE")
    with ResultsFile(path) as results, pytest.raises(FileError, match="locked by another program"):
        results.add(runs[1], toy_answer(runs[1]))
    holder.execute("ROLLBACK")
    holder.close()
    assert fill(path, runs) == [False, True, True, True]


FULL_DISK = """
import pickle, resource, sys
from dataclasses import replace
from pathlib import Path
from anatomy.base.errors import FileError
from lungaccess.running.study.results import ResultsFile
from tests.lungaccess.running.study.toys import toy_answer
path, how, run = Path(sys.argv[1]), sys.argv[2], pickle.load(sys.stdin.buffer)
stored = 0
with ResultsFile(path, create=True) as results:
    if how == "pages":
        results._connection.execute("PRAGMA max_page_count = 60")
    else:
        resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))
    try:
        for seed in range(100):
            made = replace(run, seed=seed)
            results.add(made, toy_answer(made, plan='{"text": "%s"}' % (20000 * "x")))
            stored += 1
    except FileError as error:
        print(stored, error)
"""


@pytest.mark.slow
@pytest.mark.parametrize("how", ["pages", "limit"])
def test_a_full_disk_is_an_error_and_loses_nothing(path: Path, runs: list[Run], how: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", FULL_DISK, str(path), how],
        input=pickle.dumps(runs[0]),
        capture_output=True,
        check=True,
    )
    stored, words = done.stdout.decode().split(" ", 1)
    assert 0 < int(stored) < 100
    assert "cannot be written" in words
    assert "goes on from there" in words
    with ResultsFile(path) as results:
        keys = results.finished_keys()
    assert keys == {replace(runs[0], seed=seed).key for seed in range(int(stored))}
    assert [counts(path)[name] for name in ("runs", *CHILDREN)] == [n * int(stored) for n in (1, 1, 1, 2, 1)]
    more = [replace(runs[0], seed=seed) for seed in range(100)]
    assert sum(fill(path, more)) == 100 - int(stored)


TWO_PROCESSES = """
import pickle, sys
from dataclasses import replace
from pathlib import Path
from lungaccess.running.study.results import ResultsFile
from tests.lungaccess.running.study.toys import toy_answer
run = pickle.load(sys.stdin.buffer)
sys.stdin.close()
with ResultsFile(Path(sys.argv[1]), create=True) as results:
    print(sum(results.add(made, toy_answer(made)) for made in (replace(run, seed=n) for n in range(60))))
"""


@pytest.mark.slow
def test_two_processes_share_a_new_file(path: Path, runs: list[Run]) -> None:
    added: list[int] = []

    def work() -> None:
        done = subprocess.run(
            [sys.executable, "-c", TWO_PROCESSES, str(path)],
            input=pickle.dumps(runs[0]),
            capture_output=True,
            check=False,
        )
        added.append(int(done.stdout) if done.returncode == 0 else -1000)

    both = [threading.Thread(target=work) for _ in range(2)]
    for each in both:
        each.start()
    for each in both:
        each.join()
    assert sum(added) == 60
    assert [counts(path)[name] for name in ("runs", *CHILDREN)] == [60, 60, 60, 120, 60]
    assert counts(path)["experiments"] == 1
