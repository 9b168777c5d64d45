"""No damaged file ends a reader otherwise than by a typed error, and none moves voxels in silence."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from anatomy.grid import Volume
from tests.fuzz import run
from tests.fuzz.targets import GRID, Target, targets

CHECKOUT = Path(__file__).resolve().parents[2]
TARGETS = targets()
IN_CI, IN_ALL, NUMBERS_IN_CI = 2000, 100_000, 30


def _run(names: Iterable[str], seed: int, count: int, keep: Path, kind: str = "bytes") -> dict[str, Any]:
    """Return what a process of its own says of each target, and under "stderr" why it ended too early."""
    command = [sys.executable, "-m", "tests.fuzz.run", kind, str(seed), str(count), str(keep), *names]
    done = subprocess.run(command, capture_output=True, text=True, cwd=CHECKOUT, check=False)
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    return {line.pop("target"): line for line in lines} | {"stderr": f"{keep}\n{done.stderr[-2000:]}"}


def _require_refusals(said: dict[str, Any], name: str, count: int) -> None:
    assert name in said, f"{name}: crashed, here or before, on {said['stderr']}"
    found = said[name]
    assert not found["faults"], json.dumps(found["faults"][:3], indent=1)
    assert found["refused"] > 0.1 * count, f"the damage is not noticed: {found}"


@pytest.fixture(scope="module")
def said(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What one process says of all targets: to start one takes longer than to read the files of a target."""
    return _run(TARGETS, 0, IN_CI // len(TARGETS), tmp_path_factory.mktemp("fuzz") / "input")


@pytest.mark.parametrize("name", TARGETS)
def test_damaged_files_are_refused_in_words(said: dict[str, Any], name: str):
    _require_refusals(said, name, IN_CI // len(TARGETS))


@pytest.fixture(scope="module")
def said_of_numbers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return _run(TARGETS, 0, NUMBERS_IN_CI, tmp_path_factory.mktemp("fuzz") / "input", "numbers")


@pytest.mark.parametrize("name", TARGETS)
def test_no_number_of_a_file_is_read_as_none_or_takes_for_ever(said_of_numbers: dict[str, Any], name: str):
    assert name in said_of_numbers, f"{name}: crashed, here or before, on {said_of_numbers['stderr']}"
    assert not said_of_numbers[name]["faults"], json.dumps(said_of_numbers[name]["faults"][:3], indent=1)


@pytest.mark.slow
@pytest.mark.parametrize("name", TARGETS)
def test_a_hundred_thousand_damaged_files_are_refused_in_words(tmp_path: Path, name: str):
    count = IN_ALL // len(TARGETS)
    _require_refusals(_run([name], 10**6, count, tmp_path / "input"), name, count)


def test_the_oracle_sees_a_traceback_and_moved_voxels(tmp_path: Path):
    """A reader that believes everything fails this test of the test."""
    intact = Volume(grid=GRID, array=np.random.default_rng(1).integers(0, 4, GRID.shape))
    moved = Volume(grid=GRID, array=np.roll(intact.array, 1, axis=0))
    ends: Counter[str] = Counter()
    believing = Target("a", lambda folder: None, lambda folder: moved)
    assert run._fault(believing, tmp_path, intact, True, ends) == "voxels changed in silence"
    failing = Target("a", lambda folder: None, lambda folder: {}["a"])
    assert "KeyError" in run._fault(failing, tmp_path, intact, True, ends)
