"""What surrounds a command, streams, settings of others, folders beside a script, changes no answer."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import matplotlib
import pytest

from lungaccess.cli import app as cli
from lungaccess.cli.exit_code import ExitCode
from lungaccess.problem.goals import SUCCESS
from lungaccess.showing.report import CostPoint, cost_over_time_png

ROOT = Path(__file__).parents[3]


def run(words: str, cwd: Path = ROOT, **environment: str) -> subprocess.CompletedProcess[str]:
    known = {"PYTHONPATH": str(ROOT), **environment}
    return subprocess.run(words, shell=True, cwd=cwd, env=os.environ | known, capture_output=True, text=True)


def test_a_crash_is_no_answer_and_leaves_a_report(monkeypatch, capsys, tmp_path):
    def crash(words):
        raise ZeroDivisionError("of the program")

    monkeypatch.setattr(cli.result_folder, "protect_files", crash)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert cli.main(["presets", "--json"]) == ExitCode.CRASHED == 70
    told = capsys.readouterr()
    assert '"kind": "CrashError"' in told.out
    (report,) = tmp_path.glob("lungaccess-crash-*.txt")
    assert report.name in re.sub(r"[\s│]+", "", told.err)
    assert "ZeroDivisionError: of the program" in report.read_text(encoding="utf-8")


@pytest.mark.skipif(sys.platform == "win32", reason="the shell is another one")
@pytest.mark.parametrize("closed", [">&-", ">&- 2>&- <&-", ">/dev/full"])
def test_closed_streams_are_no_crash(closed):
    done = run(f"{sys.executable} -m lungaccess presets {closed}", MPLBACKEND="none of these")
    assert done.returncode == (ExitCode.BAD_INPUT if "full" in closed else ExitCode.OK)
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    "environment",
    [
        {"NUMBA_NUM_THREADS": "0"}, {"NUMBA_OPT": "abc"}, {"XDG_CACHE_HOME": "folder"}, {"COLUMNS": "-5"},
        {"LUNGACCESS_CACHE": "~/cache"}, {"MATPLOTLIBRC": "nowhere"}, {"TMPDIR": "/nowhere"},
        {"HOME": "/nowhere"}, {"PYTHONWARNINGS": "error"},
    ],
    ids=str,
)  # fmt: skip
def test_odd_variables_of_the_environment_change_no_answer(environment, tmp_path):
    home = {"HOME": str(tmp_path / "home"), "NUMBA_CACHE_DIR": os.environ.get("NUMBA_CACHE_DIR", "")}
    done = run(f"{sys.executable} -m lungaccess cache", tmp_path, **(home | environment))
    assert done.returncode == ExitCode.OK, done.stderr
    assert "Traceback" not in done.stderr
    assert not [each for each in os.listdir(tmp_path) if each != "home"]


def test_a_folder_of_the_user_is_put_in_where_the_shell_does_not(tmp_path):
    done = run(
        f"{sys.executable} -m lungaccess template patient '--out=~/x.toml'", tmp_path, HOME=str(tmp_path)
    )
    assert done.returncode == ExitCode.OK, done.stderr
    assert [*map(str, tmp_path.iterdir())] == [str(tmp_path / "x.toml")]


@pytest.mark.parametrize("encoding", ["ascii", "cp1252", "utf-16"])
def test_any_encoding_of_the_output_will_do(encoding, tmp_path):
    done = run(
        f"{sys.executable} -m lungaccess tubes --outer 1 --inner 2",
        tmp_path,
        PYTHONIOENCODING=f"{encoding}:strict",
    )
    assert "Error" not in done.stderr and done.returncode in (ExitCode.OK, ExitCode.NEGATIVE), done.stderr


def test_settings_of_matplotlib_change_no_picture(tmp_path):
    history = [CostPoint(elapsed_s=float(n), iteration=n, best=3.0 - n) for n in range(3)]
    cost_over_time_png(history, tmp_path / "plain.png", SUCCESS)
    with matplotlib.rc_context({"text.usetex": True, "savefig.dpi": 10, "lines.linewidth": 9.0}):
        cost_over_time_png(history, tmp_path / "other.png", SUCCESS)
        assert matplotlib.rcParams["text.usetex"]
    assert (tmp_path / "plain.png").read_bytes() == (tmp_path / "other.png").read_bytes()


@pytest.mark.parametrize("name", ["stages", "anatomy"])
def test_a_folder_that_hides_a_package_is_named(tmp_path, name):
    (tmp_path / name).mkdir()
    done = run(f'{sys.executable} -c "import lungaccess"', tmp_path)
    assert done.returncode == 0, done.stderr
    (tmp_path / name / "__init__.py").touch()
    done = run(f'{sys.executable} -c "import lungaccess"', tmp_path)
    assert str(tmp_path / name) in done.stderr.splitlines()[-1]
    done = run(f"{sys.executable} -m lungaccess presets", tmp_path)
    assert done.returncode == ExitCode.BAD_INPUT and str(tmp_path / name) in done.stderr, done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("words", [["--rotate", "1e9"], ["--relative", "-1e300"], ["--rotate", "1e-320"]])
def test_angles_are_bounded(words, capsys):
    assert cli.main(["tubes", "--outer", "10", "--inner", "20", *words]) == ExitCode.BAD_INPUT
    assert "at most 360" in " ".join(capsys.readouterr().err.split())
