"""The needle stage alone, from Python and from the command line."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from anatomy.base.errors import SettingsError, TargetError
from anatomy.lung import Lung
from anatomy.phantom import Phantom, write_phantom
from anatomy.poses import pose
from anatomy.structures import AIRWAY, FISSURE, LUMEN, OBSTACLES, OUTSIDE, VESSEL
from lungaccess.cli.app import main
from lungaccess.cli.commands import later_stages
from lungaccess.cli.exit_code import ExitCode
from lungaccess.judging.checking import check_needle_alone
from lungaccess.planning.one_stage import plan_needle, reason_in_words
from lungaccess.planning.one_stage.needle import pierced_branches
from lungaccess.problem.system import System, load_system
from lungaccess.problem.target import Target, nodule_target
from stages.needle import Passage
from stages.needle.path import blocker_on_path
from stages.needle.search.planners import searches


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


@pytest.mark.parametrize("planner", list(searches()))
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
    start[:3, 3] = target.lps_mm
    with pytest.raises(TargetError, match="nothing to insert"):
        plan_needle(small_lung, system, start, target, iterations=1)


def test_the_pierced_branch(small_lung: Lung) -> None:
    tree = small_lung.tree
    end = tree.points_lps[tree.branch_points(int(tree.leaf_branches[0]))[-1]]
    assert pierced_branches(small_lung, end, 1.0) == (int(tree.leaf_branches[0]),)
    assert pierced_branches(small_lung, np.array([1e4, 0.0, 0.0]), 1.0) == ()


def test_near_a_junction_the_branches_that_meet_there_are_pierced_together(small_lung: Lung) -> None:
    tree = small_lung.tree
    parent = int(tree.branch_parent[tree.leaf_branches[0]])
    junction = tree.points_lps[tree.branch_points(parent)[-1]]
    pierced = pierced_branches(small_lung, junction, 1.0)
    assert len(pierced) > 1
    first, *others = pierced
    family = {
        *tree.children(first),
        int(tree.branch_parent[first]),
        *tree.children(tree.branch_parent[first]),
    }
    assert set(others) <= {int(branch) for branch in family}


def wall_starts(lung: Lung, reach_mm: float) -> list[np.ndarray]:
    """Return poses at the walls of the last branches, straight away from the axis."""
    rng, found = np.random.default_rng(3), []
    for branch in lung.tree.leaf_branches:
        point = lung.tree.points_lps[lung.tree.branch_points(int(branch))[-2]]
        tangent = lung.tree.tangents[lung.tree.branch_points(int(branch))[-2]]
        aside = np.cross(tangent, rng.standard_normal(3))
        aside /= np.linalg.norm(aside)
        ray = point + np.arange(0.0, 6.0, 0.05)[:, None] * aside
        wall = next(p for p in ray if not lung.label_at(p) & LUMEN)
        if lung.fields["vessel"].lower_bound_mm(wall[None])[0] > 1.5 and lung.grid.contains(
            wall + reach_mm * aside
        ):
            found.append(np.array(pose(wall, aside + tangent)))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("planner", list(searches()))
def test_a_needle_that_begins_at_the_wall_leaves_the_lumen(
    small_lung: Lung, system: System, planner: str
) -> None:
    """The paths are measured again, voxel by voxel, against the rule as it is written down."""
    solved = 0
    for start in wall_starts(small_lung, 12.0):
        aim = start[:3, 3] + 12.0 * start[:3, 2]
        if small_lung.fields["obstacle"].lower_bound_mm(aim[None])[0] < 1.0:
            continue
        answer = plan_needle(
            small_lung, system, start, Target(lps_mm=aim, origin="point"), planner=planner, iterations=400
        )
        assert answer.at_wall
        if answer.path is None:
            assert answer.obstruction is not None
            continue
        solved += 1
        arcs, aside = answer.path.arcs, answer.path.arcs.copy()
        how = {"branches": answer.branches, "at_wall": True}
        report = check_needle_alone(small_lung, system, start, arcs, aim, **how)
        assert report.accepted, str(report)
        aside[0, 2] += 0.005
        for wrong in (
            check_needle_alone(small_lung, system, start, arcs, aim, branches=answer.branches),
            check_needle_alone(small_lung, system, start, arcs, aim + 0.1, **how),
            check_needle_alone(small_lung, system, start, arcs, aim, branches=(0,), at_wall=True),
            check_needle_alone(small_lung, system, start, aside, aim, **how),
        ):
            assert not wrong.accepted
        points, lengths = answer.path.sample(0.05)
        lumen = small_lung.exact_clearance_mm(points, LUMEN, cap_mm=2.0)
        kept = np.minimum(system.needle.radius_mm, np.sin(np.radians(10.0)) * (lengths - 1.0))
        exempt = lengths < system.needle.exit_exemption_mm
        assert (lumen >= kept)[exempt].all()
        assert (lumen > 0.0)[lengths >= 1.0].all()
        beyond = small_lung.exact_clearance_mm(points[~exempt], OBSTACLES | FISSURE, cap_mm=2.0)
        assert (beyond >= system.needle.radius_mm + system.margins.total_mm).all()
    assert solved > 2


def test_a_target_out_of_reach_names_the_radius_that_reaches_it(small_lung: Lung, system: System) -> None:
    start, target = start_beside(small_lung, 8.0), nodule_target(small_lung, 1)
    aside = start.copy()
    turn = np.radians(25.0)
    aside[:3, 0] = np.cos(turn) * start[:3, 0] - np.sin(turn) * start[:3, 2]
    aside[:3, 2] = np.sin(turn) * start[:3, 0] + np.cos(turn) * start[:3, 2]
    for planner in ("rrt", "decide"):
        answer = plan_needle(small_lung, system, aside, target, planner=planner, iterations=1000)
        found = answer.obstruction
        assert answer.outcome == "no path" and answer.proved and found is not None
        assert found.place == "reach" and found.radius_mm is not None
    assert f"needs R <= {np.floor(10.0 * found.radius_mm) / 10.0:.1f} mm" in reason_in_words(found)
    for radius, reached in ((0.999 * found.radius_mm, True), (1.001 * found.radius_mm, False)):
        needle = replace(system.needle, max_curvature_per_mm=1.0 / radius)
        other = plan_needle(
            small_lung, replace(system, needle=needle), aside, target, planner="rrt", iterations=20_000
        )
        assert (other.path is not None) == reached


def test_a_blocked_target_is_named(small_lung: Lung, system: System) -> None:
    """The target is moved to 0.5 mm from a vessel: closer than any needle may come."""
    lung = small_lung
    vessel = np.argwhere(lung.labels & VESSEL)
    for voxel in vessel[:: max(len(vessel) // 2000, 1)]:
        aim = lung.grid.lps(voxel + np.array([1.2, 0.0, 0.0]))
        if lung.label_at(aim) & (VESSEL | AIRWAY | OUTSIDE) == 0:
            break
    start = start_beside(lung, 20.0)
    answer = plan_needle(
        lung, replace(system, needle=replace(system.needle, max_curvature_per_mm=0.2)), start,
        Target(lps_mm=aim, origin="point"), planner="decide", iterations=1000,
    )  # fmt: skip
    found = answer.obstruction
    assert answer.path is None and found is not None
    if found.place == "target":
        assert "target blocked by a vessel" in reason_in_words(found)
        assert found.distance_mm is not None and found.needed_mm is not None
        assert found.distance_mm < found.needed_mm
    assert answer.record()["blocked"]["what"] == found.place


def test_an_open_question_tells_where_a_path_would_pass(small_lung: Lung, system: System) -> None:
    start, target = start_beside(small_lung, 8.0), nodule_target(small_lung, 1)
    answer = plan_needle(small_lung, system, start, target, iterations=2000)
    assert answer.path is not None and answer.open_passage is None
    passage = Passage(
        point_lps=(1.0, 2.0, 3.0), width_mm=0.4, from_start_mm=5.0, cell_mm=0.03, slope_cell=0.1
    )
    still_open = replace(answer, path=None, outcome="undecided", open_passage=passage)
    assert still_open.record()["open_passage"]["width_mm"] == 0.4
    console = Console(width=200)
    with console.capture() as shown:
        console.print(*later_stages._needle_tables(still_open, is_lung=True))
    assert "0.40 mm wide, 5.0 mm ahead" in shown.get() and "0.03 mm" in shown.get()


@pytest.mark.slow
def test_command(
    small_lung: Lung, small_phantom: Phantom, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "patient"
    write_phantom(small_phantom, folder)
    start = tmp_path / "pose.txt"
    np.savetxt(start, start_beside(small_lung, 8.0))
    command = ["needle", str(folder), "--nodule", "1", "--system", "ultrathin", "--iterations", "2000"]
    command += ["--cache", str(tmp_path / "cache")]
    assert main([*command, "--start", str(start)]) == ExitCode.BAD_INPUT
    assert "--frame ras or --frame lps" in " ".join(capsys.readouterr().err.split())
    command += ["--frame", "lps"]
    assert main([*command, "--start", str(start)]) == ExitCode.OK
    shown = capsys.readouterr().out
    assert "proved clear" in shown and "insert, mm" in shown
    picture = tmp_path / "needle.png"
    turned = np.loadtxt(start)
    turned[:3, 1:3] *= -1.0
    np.savetxt(tmp_path / "away.txt", turned)
    away = [*command, "--start", str(tmp_path / "away.txt"), "--out", str(picture)]
    assert main(away) == ExitCode.NEGATIVE
    assert picture.stat().st_size > 20_000
    assert "target out of reach" in " ".join(capsys.readouterr().out.split())
    assert main([*away, "--json"]) == ExitCode.NEGATIVE
    told = json.loads(capsys.readouterr().out)
    assert told["no_path_is_proved"] and told["blocked"]["what"] == "reach"
    assert told["open_passage"] is None
    assert main([*command, "--start", str(start), "--out", "needle.pdf"]) == ExitCode.BAD_INPUT
    assert main([*command, "--start", "99"]) == ExitCode.BAD_INPUT
    assert main([*command, "--start", str(tmp_path / "none.txt")]) == ExitCode.BAD_INPUT
