"""The commands of studies: what they print, write and refuse."""

from __future__ import annotations

import contextlib
import csv
import json
import os
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import pytest

from lungaccess.cli import app as cli
from lungaccess.cli.exit_code import ExitCode
from lungaccess.running.study.results import ResultsFile
from lungaccess.running.study.runs import NO_PLAN, TIMEOUT, Run
from lungaccess.running.study.tables import QUERIES, TEXTS, TRUTHS, export_csv, export_parquet, summarise
from tests.lungaccess.running.study.toys import toy_answer

TOML = """
name = "small"
seeds = [0, 1]
budget = {iterations = 2}
atlas = {rotations = 8, stop_spacing_mm = 8, site_spacing_mm = 4}
[[case]]
name = "coarse"
anatomy = "phantom"
phantom = {seed = 2, spacing_mm = 2.5}
system = "ultrathin"
fissures_allowed = true
targets = ["lps:-81.25,51,-33.5", "lps:300,0,0"]
[[planner]]
name = "atlas"
"""

pytestmark = pytest.mark.usefixtures("wide_terminal")


@pytest.fixture
def path(tmp_path: Path, runs: list[Run]) -> Path:
    """Results of four runs: two plans, a failure, and no plan."""
    made = tmp_path / "results.db"
    with ResultsFile(made, create=True) as results:
        for run in runs[:2]:
            results.add(run, toy_answer(run))
        nothing = {"costs": {}, "improvements": (), "findings": (), "plan": "", "accepted": False}
        failed = toy_answer(runs[2], failed=True, outcome="FileError", status=0, message="gone", **nothing)
        results.add(runs[2], failed)
        reasons = {"needle: arcs stopped by a vessel": 3}
        results.add(
            runs[3], toy_answer(runs[3], outcome=NO_PLAN, status=TIMEOUT, rejections=reasons, **nothing)
        )
    return made


def test_the_summary_counts_what_could_be_made(path: Path) -> None:
    (group,) = summarise(path)
    assert (group.case, group.planner, group.runs, group.failed) == ("coarse", "atlas", 4, 1)
    assert group.solved_share == pytest.approx(2 / 3)
    assert group.accepted_share == 1.0
    assert group.first_plan_s == (0.01, 0.01)
    assert group.cost == 0.1 + 0.2


def test_show(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["study", "show", str(path)]) == 0
    assert " 66 " in capsys.readouterr().out
    assert cli.main(["study", "show", str(path), "--json"]) == 0
    (group,) = json.loads(capsys.readouterr().out)
    assert group["failed"] == 1


def test_csv_is_read_back_without_loss(path: Path, tmp_path: Path) -> None:
    written = export_csv(path, tmp_path / "csv")
    assert {each.stem for each in written} == set(QUERIES)
    with (tmp_path / "csv" / "runs.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 4
    assert [float(row["cost"]) for row in rows if row["cost"]] == [0.1 + 0.2] * 2
    assert [row["outcome"] for row in rows] == ["plan", "plan", "FileError", "no plan"]
    with (tmp_path / "csv" / "plans.csv").open(newline="") as stream:
        assert [json.loads(row["plan"])["schema"] for row in csv.DictReader(stream)] == ["toy"] * 2


def test_parquet_is_read_back_with_types(path: Path, tmp_path: Path) -> None:
    import pyarrow
    from pyarrow import parquet

    for file in export_parquet(path, tmp_path / "parquet"):
        content = parquet.read_table(file)
        with ResultsFile(path) as results:
            expected = list(results.rows(QUERIES[file.stem]))
        assert [tuple(row.values()) for row in content.to_pylist()] == expected
        for field in content.schema:
            assert (field.type == pyarrow.string()) == (field.name in TEXTS)
            assert (field.type == pyarrow.bool_()) == (field.name in TRUTHS)


def test_export_without_pyarrow(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert cli.main(["study", "export", str(path), "--parquet", str(tmp_path / "p")]) == ExitCode.BAD_INPUT
    assert "pip install 'lungaccess[study]'" in capsys.readouterr().err
    assert cli.main(["study", "export", str(path), "--csv", str(tmp_path / "c")]) == 0


def test_compare(path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = tmp_path / "other.db"
    with sqlite3.connect(path) as one, sqlite3.connect(other) as two:
        one.backup(two)
    assert cli.main(["study", "compare", str(path), str(other)]) == 0
    with sqlite3.connect(other) as two:
        two.execute("UPDATE runs SET cost = 5 WHERE id = 1")
    assert cli.main(["study", "compare", str(path), str(other)]) == 1
    assert "runs: cost" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["run", "none.toml"], "no file"),
        (["run", "study.toml", "--workers", "0"], "at least 1"),
        (["run", "study.toml", "--workers", "2", "--scheduler", "tcp://x:1"], "workers of its own"),
        (["run", "wrong.toml"], "did you mean"),
        (["show", "none.db"], "no file"),
        (["show", "study.toml"], "not a database"),
        (["export", "study.toml"], "--csv FOLDER"),
        (["compare", "none.db", "none.db"], "no file"),
    ],
)
def test_bad_input_is_explained(
    words: list[str],
    expected: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("study.toml").write_text(TOML)
    Path("wrong.toml").write_text(TOML.replace("seeds", "sedes"))
    assert cli.main(["study", *words]) == ExitCode.BAD_INPUT
    found = capsys.readouterr()
    assert expected in found.err
    assert "Traceback" not in found.err


def command(study: Path, out: Path, cache: Path) -> list[str]:
    words = ["study", "run", str(study), "--out", str(out), "--cache", str(cache), "--workers", "1", "--json"]
    return [sys.executable, "-c", "import sys; from lungaccess.cli.app import main; sys.exit(main())", *words]


@pytest.mark.slow
def test_a_study_is_run_once(tmp_path: Path, cache: Path) -> None:
    (tmp_path / "study.toml").write_text(TOML)
    for added in (4, 0):
        words = command(tmp_path / "study.toml", tmp_path / "r.db", cache)
        done = subprocess.run(words, capture_output=True, text=True, check=True)
        assert json.loads(done.stdout)["added"] == added
        assert done.stderr.strip() == ""
    (group,) = json.loads(done.stdout)["groups"]
    assert (group["solved_share"], group["accepted_share"]) == (0.5, 1.0)


@pytest.mark.slow
def test_ctrl_c_leaves_a_complete_file(tmp_path: Path, cache: Path) -> None:
    """An interruption reaches the whole group, as from a terminal."""
    (tmp_path / "study.toml").write_text(TOML.replace("[0, 1]", str(list(range(40)))))
    path = tmp_path / "r.db"
    words = command(tmp_path / "study.toml", path, cache)
    with subprocess.Popen(words, start_new_session=True, stderr=subprocess.PIPE, text=True) as process:
        while process.poll() is None and stored(path) < 5:
            time.sleep(0.05)
        os.killpg(process.pid, signal.SIGINT)
        said = process.communicate()[1]
    assert process.returncode == ExitCode.INTERRUPTED
    assert "Traceback" not in said
    assert not path.with_name("r.db-wal").exists()
    assert 5 <= stored(path) < 80


def stored(path: Path) -> int:
    """Return how many runs a file has; 0 as long as it is not one."""
    try:
        with contextlib.closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as connection:
            return int(connection.execute("SELECT count(*) FROM runs").fetchone()[0])
    except sqlite3.OperationalError:
        return 0
