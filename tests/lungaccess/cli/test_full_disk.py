"""A disk that fills up while a command writes: a typed error, and no half file."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from lungaccess.cli.exit_code import ExitCode

START = """
import resource, sys
from lungaccess.cli.app import main
most = int(sys.argv[1])
resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
sys.exit(main(sys.argv[2:]))
"""
"""No file may grow beyond the limit: the system refuses to write on, as it does where the disk is full."""


def limited(most_bytes: int, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", START, str(most_bytes), *words]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def require_refused(done: subprocess.CompletedProcess[str]) -> None:
    assert done.returncode == ExitCode.BAD_INPUT, done.stderr + done.stdout
    assert "Traceback" not in done.stderr and "room on the disk" in done.stderr


@pytest.mark.slow
def test_a_patient_that_cannot_be_stored(patient: Path, tmp_path: Path) -> None:
    require_refused(limited(100_000, "info", str(patient), "--cache", str(tmp_path / "cache"), "-q"))
    assert not list((tmp_path / "cache").iterdir())


@pytest.mark.slow
def test_results_that_cannot_be_written(patient: Path, tmp_path: Path) -> None:
    def tour(most_bytes: int, out: Path) -> subprocess.CompletedProcess[str]:
        where = ("--cache", str(patient.parent / "cache"), "--out", str(out), "-q")
        return limited(most_bytes, "tour", str(patient), "--system", "ultrathin", *where)

    tour(1 << 40, tmp_path / "whole")  # Kernels that are compiled on the way would meet the limit, too.
    for most_bytes in (0, 1_000, 10_000, 100_000):
        require_refused(tour(most_bytes, tmp_path / "out"))
        for path in (tmp_path / "out").iterdir():
            assert path.suffix == ".json" and json.loads(path.read_text()), "nothing half made is left"
