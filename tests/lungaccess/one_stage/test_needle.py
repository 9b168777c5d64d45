"""The needle stage alone, from Python and from the command line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from anatomy.errors import SettingsError, TargetError
from anatomy.lung import Lung
from anatomy.phantom import Phantom, write_phantom
from anatomy.poses import pose
from lungaccess.cli.app import main
from lungaccess.cli.exit_code import ExitCode
from lungaccess.one_stage.needle import pierced_branch, plan_needle
from lungaccess.problem.system import System, load_system
from lungaccess.problem.target import nodule_target
from stages.needle.path import blocker_on_path
from stages.needle.search.planners import PLANNERS


@pytest.fixture(scope="module")
def system() -> System:
    return load_system("ultrathin")


def start_beside(lung: Lung, away_mm: float) -> np.ndarray:
    """Return a pose straight towards the first nodule, from so far away."""
    target = nodule_target(lung, 1).lps_mm
    rng = np.random.default_rng(0)
    for _ in range(2000):
        direction = rng.standard_normal(3)
        direction /= np.linalg.norm(direction)
        point = target - away_mm * direction
        if lung.fields["obstacle"].lower_bound_mm(point[None])[0] > 3.0:
            return np.array(pose(point, direction + 0.05 * rng.standard_normal(3)))
    raise AssertionError("no free start")


@pytest.mark.parametrize("planner", list(PLANNERS))
def test_every_planner_finds_a_short_way(small_lung: Lung, system: System, planner: str) -> None:
    start = start_beside(small_lung, 8.0)
    target = nodule_target(small_lung, 1)
    answer = plan_needle(small_lung, system, start, target, planner=planner, iterations=3000)
    assert answer.path is not None
    assert answer.outcome in ("path", "best at resolution")
    assert blocker_on_path(answer.environment, answer.path, answer.branch) == 0
    assert np.linalg.norm(answer.path.frames()[-1][:3, 3] - target.lps_mm) < 1e-6


def test_a_target_behind_the_start_has_no_path(small_lung: Lung, system: System) -> None:
    start = start_beside(small_lung, 8.0)
    start[:3, 1:3] *= -1.0
    answer = plan_needle(small_lung, system, start, nodule_target(small_lung, 1), iterations=100_000)
    assert answer.path is None
    assert answer.outcome in ("no path", "undecided", "nothing found")


def test_bad_questions_are_refused(small_lung: Lung, system: System) -> None:
    start, target = start_beside(small_lung, 8.0), nodule_target(small_lung, 1)
    with pytest.raises(SettingsError, match="no needle planner"):
        plan_needle(small_lung, system, start, target, planner="best", iterations=1)
    with pytest.raises(SettingsError, match="no limit"):
        plan_needle(small_lung, system, start, target)
    with pytest.raises(SettingsError, match="cost map"):
        plan_needle(replace(small_lung, cost=None), system, start, target, objective="cost-map", iterations=1)
    outside = start.copy()
    outside[:3, 3] += 1e4
    with pytest.raises(TargetError, match="outside the images"):
        plan_needle(small_lung, system, outside, target, iterations=1)


def test_the_pierced_branch(small_lung: Lung) -> None:
    tree = small_lung.tree
    point = tree.points_lps[-1]
    assert pierced_branch(small_lung, point) == tree.branch_of_point[-1]
    assert pierced_branch(small_lung, np.array([1e4, 0.0, 0.0])) == -1


def test_command(
    small_lung: Lung, small_phantom: Phantom, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "patient"
    write_phantom(small_phantom, folder)
    start = tmp_path / "pose.txt"
    np.savetxt(start, start_beside(small_lung, 8.0))
    command = ["needle", str(folder), "--nodule", "1", "--system", "ultrathin", "--iterations", "2000"]
    command += ["--cache", str(tmp_path / "cache")]
    assert main([*command, "--start", str(start)]) == ExitCode.OK
    shown = capsys.readouterr().out
    assert "proved clear" in shown and "insert, mm" in shown
    assert main([*command, "--start", "99"]) == ExitCode.BAD_INPUT
    assert main([*command, "--start", str(tmp_path / "none.txt")]) == ExitCode.BAD_INPUT
