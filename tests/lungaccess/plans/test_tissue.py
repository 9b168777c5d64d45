"""Tissue in the tool: counts by other means, the point tool of before, and what the check refuses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lungaccess as la
from anatomy.base.errors import SettingsError
from anatomy.lung import Lung
from lungaccess.cli.app import main
from lungaccess.cli.exit_code import ExitCode
from lungaccess.judging.checking import check
from lungaccess.planning.procedure import simulate_procedure
from lungaccess.plans.plan import Plan
from lungaccess.plans.tissue import wanted_of
from lungaccess.problem import tools
from lungaccess.problem.error_files import load_errors
from lungaccess.problem.procedures import load_procedure
from lungaccess.problem.system import System, system_fingerprint, systems_with_tool, with_tool
from lungaccess.problem.tools import Tool, load_tool
from lungaccess.uncertainty.risk.assessor import RiskAssessor
from lungaccess.uncertainty.risk.deviations import Deviations, deviated_pieces, deviated_starts
from lungaccess.uncertainty.risk.statistics import share_of
from stages.needle.path import arc_transform

SYSTEM = la.load_system("ultrathin")
MODEL = load_errors("breath-hold")
DRAWS = 150
"""So many ends are found by 4 x 4 matrices, one after the other."""


@pytest.fixture(scope="module")
def plans(small_lung: Lung, small_atlas: la.Atlas) -> dict[str, Plan]:
    """Return the first plan without a tool, and with some."""
    target = la.resolve_target(small_lung)
    found = {}
    for name in ("", "core", "cryoprobe", "ablation"):
        system = with_tool(SYSTEM, load_tool(name) if name else None)
        found[name] = next(la.plan(small_lung, system, target, atlas=small_atlas, goal="default"))
    return found


def ends(plan: Plan, lung: Lung, deviations: Deviations) -> np.ndarray:
    """Return the frames (N, 4, 4) in which deviated plans end, by 4 x 4 matrices."""
    found = []
    starts, every = deviated_starts(plan, lung, deviations), deviated_pieces(plan, deviations)
    for start, pieces in zip(starts, every, strict=True):
        frame = np.eye(4)
        frame[:3] = np.column_stack([start[6:9], np.cross(start[3:6], start[6:9]), start[3:6], start[:3]])
        for length, roll, curvature, _radius in pieces:
            frame = frame @ arc_transform(length, roll, curvature)
        found.append(frame)
    return np.array(found)


def brute(tool: Tool, lung: Lung, frame: np.ndarray, shift: np.ndarray) -> float:
    """Return how much of the nodules is in a tool: its body is looked at in fine steps, voxel by voxel."""
    fine = 0.05 if tool.unit == "mm" else 0.05 * tool.diameter_mm
    half = 0.5 * tool.diameter_mm
    sides = np.arange(-half + 0.5 * fine, half, fine) if tool.unit == "mm3" else np.zeros(1)
    z = np.arange(tool.from_tip_mm + 0.5 * fine, tool.to_tip_mm, fine)
    x, y, z = (each.ravel() for each in np.meshgrid(sides, sides, z, indexing="ij"))
    middle, long = 0.5 * (tool.from_tip_mm + tool.to_tip_mm), 0.5 * (tool.to_tip_mm - tool.from_tip_mm)
    across, along = np.hypot(x, y) / half, (z - middle) / long
    inside = (np.hypot(across, along) if tool.shape == "ellipsoid" else across) <= 1.0
    points = (np.column_stack([x, y, z])[inside] @ frame[:3, :3].T) + frame[:3, 3] - shift
    found = lung.nodules.at(points, False).sum()
    return float(found * (fine if tool.unit == "mm" else fine**3))


@pytest.mark.parametrize("name", ["core", "cryoprobe"])
def test_what_is_in_the_tool_is_what_its_voxels_say(
    plans: dict[str, Plan], small_lung: Lung, name: str
) -> None:
    plan = plans[name]
    tool = plan.system.tool
    there = RiskAssessor(replace(plan, system=replace(plan.system, tool=tool)), small_lung)
    deviations = there.draws(DRAWS, 3).deviations(MODEL)
    taken = there.outcomes(deviations).taken
    frames = ends(plan, small_lung, deviations)
    every = zip(frames, deviations.target_mm, strict=True)
    truth = np.array([brute(tool, small_lung, *each) for each in every])
    off = {"mm": 0.3, "mm3": 0.12 * tool.volume_mm3}[tool.unit]
    assert np.abs(taken - truth).max() <= off
    assert np.mean(truth > 0.0) > 0.0 and np.ptp(truth) > off, "the draws tell them apart"
    many = share_of(there.outcomes(there.draws(20_000, 4).deviations(MODEL)).taken >= there.wanted.least)
    low, high = share_of(truth >= tool.least).interval
    assert many.interval[0] <= high and low <= many.interval[1]


def test_a_ball_and_a_point_are_the_success_of_a_tip(plans: dict[str, Plan], small_lung: Lung) -> None:
    plan = plans[""]
    point = Tool(name="point", from_tip_mm=-1e-9, to_tip_mm=0.0, diameter_mm=0.1, least=1e-9)
    tip = RiskAssessor(plan, small_lung, radius_mm=3.0)
    with_point = replace(plan, system=with_tool(plan.system, point))
    tooled = RiskAssessor(with_point, small_lung, radius_mm=3.0)
    deviations = tip.draws(20_000, 1).deviations(MODEL)
    within = tip.outcomes(deviations).miss_mm <= 3.0
    assert 0 < within.sum() < len(within)
    assert (tip.outcomes(deviations).taken >= tip.wanted.least).tolist() == within.tolist()
    assert (tip.successes(deviations) == tooled.successes(deviations)).all()
    assert (tip.successes(deviations) == tip.succeeded(tip.outcomes(deviations))).all()


def test_the_tip_goes_on_until_the_tool_is_at_the_target(plans: dict[str, Plan], small_lung: Lung) -> None:
    for name in ("core", "cryoprobe", "ablation"):
        plan, tool = plans[name], load_tool(name)
        assert plan.aim is not None and not len(plan.aim.phases)
        assert plan.goal_lps.tolist() == plan.aim.point_lps.tolist() == plan.needle.end_lps.tolist()
        beyond = float(np.linalg.norm(plan.needle.end_lps - plan.target_lps))
        assert beyond == pytest.approx(tool.beyond_mm, abs=0.02 * tool.beyond_mm)
        report = check(plan, small_lung)
        assert report.accepted, report.refusals
        assert "tool.tissue" in {each.name for each in report.findings}
        assert Plan.from_json(plan.to_json()).system.tool == tool
    assert plans[""].aim is None and plans[""].goal_lps is plans[""].target_lps


def refusals(plan: Plan, lung: Lung) -> set[str]:
    """Return what the check refuses of a plan whose devices are what they say."""
    stated = replace(plan, system_fingerprint=system_fingerprint(plan.system))
    return {each.name for each in check(stated, lung).refusals}


def test_the_check_refuses_another_aim_or_tool(plans: dict[str, Plan], small_lung: Lung) -> None:
    core = plans["core"]
    assert not refusals(core, small_lung)
    beside = replace(core.aim, point_lps=core.aim.point_lps + [0.0, 0.0, 0.1])
    assert "target.aim" in refusals(replace(core, aim=beside), small_lung)
    assert "target.in_nodule" in refusals(replace(core, aim=None), small_lung)
    long = Tool(name="long", from_tip_mm=-60.0, to_tip_mm=-45.0, diameter_mm=0.6, least=5.0)
    assert "tool.tissue" in refusals(replace(core, system=with_tool(core.system, long)), small_lung)
    whole = replace(load_tool("ablation"), name="small", diameter_mm=5.0)
    assert "tool.tissue" in refusals(replace(core, system=with_tool(core.system, whole)), small_lung)
    ends_at_target = replace(plans[""], system=with_tool(SYSTEM, replace(long, to_tip_mm=-30.0)))
    assert "tool.tissue" in refusals(ends_at_target, small_lung)


def test_a_plan_for_success_counts_tissue(
    small_lung: Lung, small_atlas: la.Atlas, plans: dict[str, Plan], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    target = la.resolve_target(small_lung)
    system = with_tool(SYSTEM, load_tool("core"))
    asked = {"atlas": small_atlas, "errors": MODEL, "iterations": 1}
    *_, best = la.plan(small_lung, system, target, procedure=load_procedure("open-loop"), **asked)
    assert best.chance.tissue == "at least 5 mm of the nodule in the core needle"
    assert best.chance.success_words == f"{best.chance.tissue} (the nodule as it is in the mask)"
    assert check(best, small_lung).accepted
    chances = []
    for each in (best, plans["core"]):
        there = RiskAssessor(each, small_lung)
        chances.append(there.success(there.draws(20_000, 77), MODEL).value)
    assert chances[0] >= chances[1] - 0.01
    procedure = load_procedure("measured-tip")
    measured = simulate_procedure(best, small_lung, errors=MODEL, procedure=procedure, samples=60)
    assert measured.tissue == best.chance.tissue and measured.succeeds.count > 0
    # A chance without measuring is not mistaken for the one that the plan states.
    monkeypatch.setattr("lungaccess.problem.patients.load_patient", lambda *_, **__: small_lung)
    replace(best, chance=replace(best.chance, procedure="measured-tip")).save(tmp_path / "plan.json")
    assert main(["risk", str(tmp_path / "plan.json"), "patient", "--samples", "200"]) == ExitCode.OK
    said = " ".join(capsys.readouterr().out.split())
    assert "It was planned for 'measured-tip'" in said
    assert "state it as --procedure to simulate it anew" in said


def test_risk_with_another_tool_says_what_counts(
    plans: dict[str, Plan], small_lung: Lung, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setattr("lungaccess.problem.patients.load_patient", lambda *_, **__: small_lung)
    plans["core"].save(tmp_path / "plan.json")
    call = ["risk", str(tmp_path / "plan.json"), "patient", "--samples", "200", "--json"]
    assert main([*call, "--tool", "forceps"]) == ExitCode.OK
    said = json.loads(capsys.readouterr().out)
    words = "at least 1.5 mm of the nodule in the forceps (the nodule as it is in the mask)"
    assert said["counts_as_success"] == words


def test_presets_are_tools_whose_points_fill_them() -> None:
    names = sorted(file.stem for file in (Path(tools.__file__).parent / "presets" / "tools").glob("*.toml"))
    assert names == ["ablation", "aspiration", "brush", "core", "cryoprobe", "forceps"]
    for name in names:
        tool, system = load_tool(name), with_tool(SYSTEM, load_tool(name))
        points = tool.points()
        assert points[:, 2].min() >= tool.from_tip_mm and points[:, 2].max() <= tool.to_tip_mm
        assert points.mean(axis=0)[2] == pytest.approx(-tool.beyond_mm)
        assert with_tool(system, load_tool("core")).name == "ultrathin (core needle)"
        assert with_tool(system, None) is system
    assert systems_with_tool((SYSTEM,), None) == (SYSTEM,)
    able = systems_with_tool((SYSTEM, la.load_system("tubes-only")), "core")
    assert [each.name for each in able] == ["ultrathin (core needle)"]


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"to_tip_mm": 1.0}, "what goes on mechanically"),
        ({"to_tip_mm": -19.0}, "more than from_tip_mm"),
        ({"least": 16.0}, "fits into the tool"),
        ({"shape": "ellipsoid", "to_tip_mm": 19.0}, "mostly ahead"),
    ],
)
def test_impossible_tools_are_refused(changed: dict[str, object], why: str) -> None:
    with pytest.raises(SettingsError, match=why):
        replace(load_tool("core"), **changed)


def test_tools_need_a_needle_and_no_window(breathing_lung: Lung) -> None:
    with pytest.raises(SettingsError, match="needle"):
        with_tool(la.load_system("tubes-only"), load_tool("core"))
    system: System = with_tool(SYSTEM, load_tool("core"))
    with pytest.raises(SettingsError, match="what it takes"):
        la.Request.of(breathing_lung, system, la.resolve_target(breathing_lung), phases=(0.0, 0.1))


def test_only_the_rim_counts_where_the_core_is_dead(small_lung: Lung) -> None:
    target = la.resolve_target(small_lung).lps_mm
    tool = replace(load_tool("core"), rim_mm=2.0)
    rim, whole = (wanted_of(small_lung, target, each) for each in (tool, load_tool("core")))
    assert 0 < rim.tissue.sum() < whole.tissue.sum()
    ball = wanted_of(small_lung, target, tool, radius_mm=4.0)
    assert (ball.inner_mm, ball.outer_mm) == (2.0, 4.0)
