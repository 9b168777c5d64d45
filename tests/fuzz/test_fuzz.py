"""No damaged file ends a reader otherwise than by a typed error, and none moves voxels in silence."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from anatomy.grid import Volume
from tests.fuzz import run
from tests.fuzz.targets import GRID, Target, targets

CHECKOUT = Path(__file__).resolve().parents[2]
TARGETS = targets()
IN_CI, IN_ALL = 2000, 100_000


def _run(name: str, seed: int, count: int, keep: Path) -> None:
    command = [sys.executable, "-m", "tests.fuzz.run", name, str(seed), str(count), str(keep)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=CHECKOUT, check=False)
    assert done.returncode == 0, f"{name}: crashed on {keep}\n{done.stderr[-2000:]}"
    found = json.loads(done.stdout.splitlines()[-1])
    assert not found["faults"], json.dumps(found["faults"][:3], indent=1)
    assert found["refused"] > 0.1 * count, f"the damage is not noticed: {found}"


@pytest.mark.parametrize("name", TARGETS)
def test_damaged_files_are_refused_in_words(tmp_path: Path, name: str):
    _run(name, 0, IN_CI // len(TARGETS), tmp_path / "input")


@pytest.mark.slow
@pytest.mark.parametrize("name", TARGETS)
def test_a_hundred_thousand_damaged_files_are_refused_in_words(tmp_path: Path, name: str):
    _run(name, 10**6, IN_ALL // len(TARGETS), tmp_path / "input")


def test_the_oracle_sees_a_traceback_and_moved_voxels(tmp_path: Path):
    """A reader that believes everything fails this test of the test."""
    intact = Volume(grid=GRID, array=np.random.default_rng(1).integers(0, 4, GRID.shape))
    moved = Volume(grid=GRID, array=np.roll(intact.array, 1, axis=0))
    ends: Counter[str] = Counter()
    believing = Target("a", lambda folder: None, lambda folder: moved)
    assert run._fault(believing, tmp_path, intact, True, ends) == "voxels changed in silence"
    failing = Target("a", lambda folder: None, lambda folder: {}["a"])
    assert "KeyError" in run._fault(failing, tmp_path, intact, True, ends)
