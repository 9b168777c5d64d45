"""Ctrl-C, or SIGTERM, while a command plans."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from lungaccess.cli.exit_code import ExitCode
from lungaccess.plans.plan import Plan

HANGS_AFTER_S = 120.0
START = (
    "import signal, sys; from lungaccess.cli.app import main;"
    # A job in the background of a shell begins with this signal ignored.
    "signal.signal(signal.SIGINT, signal.default_int_handler); sys.exit(main())"
)


def planning(patient: Path, out: Path, *more: str, cache: Path | None = None) -> subprocess.Popen[str]:
    words = ["plan", str(patient), "--nodule", "--system", "ultrathin", "--budget", "100000"]
    words += ["--out", str(out), "--cache", str(cache or patient.parent / "cache"), *more]
    return subprocess.Popen(
        [sys.executable, "-c", START, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


@pytest.mark.slow
@pytest.mark.parametrize("more", [("--json",), (), ("--processes", "2")])
def test_ctrl_c_keeps_the_best_plan(more: tuple[str, ...], patient: Path, tmp_path: Path) -> None:
    """A real SIGINT, as from a terminal to the whole group, as soon as the first plan is announced."""
    process = planning(patient, tmp_path / "out", *more)
    assert process.stderr is not None
    said = ""
    while "cost" not in said:
        line = process.stderr.readline()
        assert line, "it ended before a plan"
        said += line
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=HANGS_AFTER_S)
    said += err
    assert process.returncode == ExitCode.OK, said + out
    assert "Traceback" not in said and "the best plan so far is kept" in said
    assert Plan.load(tmp_path / "out" / "plan.json").costs["inverse_clearance"] > 0.0
    if "--json" in more:
        assert json.loads(out)["accepted"]
    else:
        assert "Estimated to succeed" in out and "Geometry proved and checked" in out


@pytest.mark.slow
@pytest.mark.parametrize("end", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_an_end_before_the_first_plan_exits_130(patient: Path, tmp_path: Path, end: signal.Signals) -> None:
    process = planning(patient, tmp_path / "out", cache=tmp_path / "cache")
    while not list((tmp_path / "cache").glob(".building-*")):
        assert process.poll() is None
    os.killpg(process.pid, end)
    _, err = process.communicate(timeout=HANGS_AFTER_S)
    assert process.returncode == ExitCode.INTERRUPTED
    assert "interrupted" in err and "Traceback" not in err
    assert not (tmp_path / "out" / "plan.json").exists()
    assert not list((tmp_path / "cache").glob("*")), "nothing half made is left"
