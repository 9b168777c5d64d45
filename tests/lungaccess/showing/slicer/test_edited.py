"""What was edited in 3D Slicer comes back: a target, an exit, a tip, a needle, and what broke of it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lungaccess as la
from anatomy import poses
from anatomy.base.errors import FrameError, SettingsError
from anatomy.io.markups import Reference, read_named_curve, read_named_pose
from anatomy.lung import Lung
from lungaccess.cli import app as cli
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import system_fingerprint
from lungaccess.problem.target import stated_target
from lungaccess.showing.slicer import check_curve
from stages.tube import DeploymentValidator, exit_points
from tests.lungaccess.showing.slicer.slicer_scene import RAS, SlicerScene, control_points_lps

Edit = Callable[[list[dict[str, Any]]], list[dict[str, Any]]]
Edited = Callable[[str, Edit], Any]


@pytest.fixture
def edited(exported: Path, small_plan: Plan, breathing_lung: Lung, tmp_path: Path) -> Edited:
    """Edit the control points of an exported curve and check it."""

    def check(name: str, edit: Edit) -> Any:
        content = json.loads((exported / f"{name}.mrk.json").read_text())
        markup = content["markups"][0]
        markup["controlPoints"] = edit(markup["controlPoints"])
        path = tmp_path / f"{name}.mrk.json"
        path.write_text(json.dumps(content))
        return check_curve(small_plan, breathing_lung, read_named_curve(Reference(path, name)))

    return check


def broken(found: Any) -> dict[str, Any]:
    return {each.name: each for each in found.report.refusals}


def moved(points: list[dict[str, Any]], number: int, by: list[float]) -> list[dict[str, Any]]:
    place = np.add(points[number]["position"], by).tolist()
    return [*points[:number], points[number] | {"position": place}, *points[number + 1 :]][: len(points)]


@pytest.mark.parametrize("name", ["scope", "tubes", "needle"])
def test_a_curve_that_was_not_edited_breaks_nothing(name: str, edited: Edited, small_plan: Plan) -> None:
    found = edited(name, lambda points: points)
    assert found.report.accepted and found.plan is small_plan and found.device == name
    assert "No point" in found.words


def test_a_dragged_point_bends_the_needle_too_much_and_there(edited: Edited, small_plan: Plan) -> None:
    found = edited("needle", lambda points: moved(points, 5, [0.0, 1.5, 0.0]))
    assert set(broken(found)) >= {"needle.curve.arc", "needle.curve.radius"}
    radius, needle = broken(found)["needle.curve.radius"], small_plan.system.require_needle("this test")
    assert radius.value < 5.0 and radius.limit == pytest.approx(1.0 / needle.max_curvature_per_mm)
    assert "3 of" in radius.detail
    assert "1 of" in found.words
    assert [each.name for each in found.report.unchecked] == ["needle"]


def test_a_needle_that_ends_elsewhere_misses_the_target(edited: Edited) -> None:
    found = edited("needle", lambda points: points[:-4])
    assert "misses the target" in broken(found)["needle.proof"].detail
    assert broken(found)["needle.curve.end"].value > 1.0


def test_a_needle_that_starts_elsewhere_does_not_join_the_tubes(edited: Edited) -> None:
    found = edited("needle", lambda points: points[3:])
    assert any(".start" in name for name in broken(found))


def test_a_needle_through_a_vessel_comes_too_near(edited: Edited, breathing_lung: Lung) -> None:
    """One far via point leads the polyline out of the lung."""
    found = edited("needle", lambda points: [points[0], moved(points, 8, [0.0, 0.0, 60.0])[8], points[-1]])
    assert any(name.startswith("needle.curve.clearance") for name in broken(found))


def test_a_needle_drawn_by_few_points_becomes_a_plan(
    exported: Path, small_plan: Plan, breathing_lung: Lung, tmp_path: Path
) -> None:
    """The middle is moved, and the needle is one that bends more than the plan needs."""
    needle = small_plan.system.require_needle("this test")
    bends = replace(needle, max_curvature_per_mm=2.0 * needle.max_curvature_per_mm)
    system = replace(small_plan.system, name="bends more", needle=bends)
    plan = replace(small_plan, system=system, system_fingerprint=system_fingerprint(system))
    points = small_plan.curves(1.0).needle.points_lps
    few = np.stack([points[0], points[len(points) // 2] + [0.02, 0.0, 0.02], points[-1]])
    control = [{"label": f"{n}", "position": place} for n, place in enumerate(few.tolist())]
    markup = {"name": "C", "type": "Curve", "coordinateSystem": "LPS", "controlPoints": control}
    path = tmp_path / "drawn.mrk.json"
    path.write_text(json.dumps({"markups": [markup]}))
    found = check_curve(plan, breathing_lung, read_named_curve(Reference(path, "C")))
    assert found.report.accepted, found.report.refusals
    assert found.plan is not plan
    assert np.linalg.norm(found.plan.needle.end_lps - small_plan.target_lps) < 1e-6
    assert found.plan.method == "edited in 3D Slicer" and found.plan.digest != plan.digest
    assert Plan.from_json(found.plan.to_json()).digest == found.plan.digest


@pytest.mark.parametrize(("name", "says"), [("scope", "replan --scope"), ("tubes", "plan --exit")])
def test_scope_and_tubes_cannot_be_drawn(name: str, says: str, edited: Edited) -> None:
    found = edited(name, lambda points: moved(points, 10, [8.0, 0.0, 0.0]))
    assert says in broken(found)[f"{name}.curve"].detail
    assert ("scope.curve.lumen" in broken(found)) == (name == "scope")


def test_points_in_one_place_are_no_curve(edited: Edited) -> None:
    with pytest.raises(SettingsError, match="in one place"):
        edited("needle", lambda points: [points[3], points[3]])


# With 3D Slicer's own classes ---------------------------------------------------------------------


@pytest.fixture
def command(
    small_atlas: la.Atlas, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Any:
    """Run a command on the small phantom and return exit code and JSON."""
    monkeypatch.setattr("lungaccess.cli.options.load_lung", lambda *_: small_atlas.lung)
    monkeypatch.setattr("lungaccess.planning.coupled.open_atlas", lambda *_, **__: small_atlas)

    def run(*words: str) -> tuple[int, dict[str, Any]]:
        code = cli.main([*words, "--json"])
        return code, json.loads(capsys.readouterr().out)

    return run


PLAN = ("plan", "toy", "--system", "ultrathin", "--iterations", "5", "--no-pictures")


def test_from_an_edited_scene_to_a_new_plan_and_back(
    exported: Path, small_plan: Plan, command: Any, tmp_path: Path
) -> None:
    """The three commands of docs/how_to/slicer.md, with a scene that 3D Slicer's own classes have saved."""
    pytest.importorskip("slicer", reason="slicer-core, 3D Slicer's own classes, is not installed")
    scene = SlicerScene(exported / "scene.mrml", tmp_path / "scratch")
    points, needle = scene.node("points", "MarkupsFiducial"), scene.node("needle", "MarkupsCurve")
    aim = small_plan.target_lps + [1.0, 0.5, -0.5]
    points.SetNthControlPointPosition(3, *(aim * RAS))
    mine = scene.scene.AddNewNodeByClass("vtkMRMLMarkupsFiducialNode", "my target #1")
    mine.AddControlPoint(*(aim * RAS), "F-1")
    needle.SetNthControlPointPosition(5, *((control_points_lps(needle)[5] + [0, 2.0, 0]) * RAS))
    saved = scene.save(tmp_path / "saved", points, needle, mine)
    for name in ("target", "F-1", "my target #1"):
        stated = stated_target(f"{saved}#{name}", None)
        assert np.abs(stated.lps_mm - aim).max() < 1e-9
        assert stated.origin == f"point {name} of scene.mrml"
    tip = read_named_pose(Reference(saved, "scope tip"))
    assert np.abs(tip - small_plan.scope.lps_from_scope_tip).max() < 1e-6, "3D Slicer keeps the pose"
    with pytest.raises(FrameError, match="no direction"):
        read_named_pose(Reference(saved, "F-1"))

    code, answer = command("check", str(exported / "plan.json"), "toy", "--curve", f"{saved}#needle")
    assert code == 1 and "1 of" in answer["edited"] and not answer["accepted"]
    code, answer = command(*PLAN, "--target", f"{saved}#target", "--out", str(tmp_path / "new"))
    assert code == 0 and answer["accepted"]
    new = tmp_path / "new" / "plan.json"
    assert np.abs(Plan.load(new).target_lps - aim).max() < 1e-9
    code, answer = command("export", str(new), "toy", "--slicer", str(tmp_path / "back"))
    assert code == 0 and answer["accepted"]
    back = SlicerScene(tmp_path / "back" / "scene.mrml", tmp_path / "scratch")
    assert np.abs(control_points_lps(back.node("points", "MarkupsFiducial"))[3] - aim).max() < 1e-3


def test_a_measured_tip_is_read_from_a_scene(exported: Path, command: Any) -> None:
    scene = f"{exported / 'scene.mrml'}#"
    asked = ("--scope", scene + "scope tip", "--target", scene + "target")
    code, answer = command("replan", "toy", "--system", "ultrathin", *asked)
    assert code == 0 and answer["found"]


def test_exits_of_the_atlas_are_those_of_its_deployments(small_atlas: la.Atlas) -> None:
    lung, system, every = small_atlas.lung, small_atlas.system, small_atlas.deployments
    validator = DeploymentValidator(
        lung, system.tubes, system.margins, with_fissures=small_atlas.with_fissures
    )
    chosen = np.linspace(0, every.count - 1, 5).astype(np.int64)
    for entry, found in zip(
        chosen.tolist(), exit_points(system.tubes, small_atlas.motions.tips, every, chosen), strict=True
    ):
        tip = small_atlas.motions.tips[every.site[entry]]
        frame = poses.pose(tip[:3], tip[3:6], tip[6:9])
        deployment = validator.choose(frame, *every.choice(entry))
        assert not isinstance(deployment, str)
        expected = deployment.points(frame, [deployment.exit_mm])[0]
        assert np.abs(found - expected).max() < 1e-4


def test_a_moved_exit_starts_a_new_plan_from_there(
    exported: Path, small_plan: Plan, small_atlas: la.Atlas, command: Any, tmp_path: Path
) -> None:
    lung, system = small_atlas.lung, small_atlas.system
    *_, feasible = la.feasible_exits(lung, system, la.resolve_target(lung), atlas=small_atlas)
    tips, every = small_atlas.motions.tips, small_atlas.deployments
    places = exit_points(system.tubes, tips, every, feasible.entries)
    away = np.linalg.norm(places - small_plan.tube.exit.point_lps, axis=1)
    wanted = places[np.argmax(away)]
    assert away.max() > 0.3
    content = json.loads((exported / "points.mrk.json").read_text())
    (exit_point,) = (p for p in content["markups"][0]["controlPoints"] if p["label"].startswith("exit"))
    exit_point["position"] = wanted.tolist()
    path = tmp_path / "points.mrk.json"
    path.write_text(json.dumps(content))
    asked = ("--nodule", "--exit", f"{path}#exit through the wall", "--exit-within", "0.3")
    code, answer = command(*PLAN, *asked, "--out", str(tmp_path / "new"))
    assert code == 0 and answer["accepted"]
    made = Plan.load(tmp_path / "new" / "plan.json")
    assert np.linalg.norm(made.tube.exit.point_lps - wanted) <= 0.3
    code, answer = command(*PLAN, "--nodule", "--exit", "lps:0,0,500", "--out", str(tmp_path / "none"))
    assert code == 2 and "none comes near" in answer["error"]["found"]
