"""The safe start region of a plan: its proof under attack, its bodies, its command."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lungaccess as la
from anatomy.base.errors import PlanFileError, SettingsError
from anatomy.grid import Volume
from anatomy.lung import Lung
from anatomy.phantom import Phantom, write_phantom
from anatomy.poses import pose
from lungaccess.cli.app import main
from lungaccess.plans.plan import Plan
from lungaccess.plans.tissue import goal_radius
from lungaccess.uncertainty.risk import proved_body, tried_body
from stages.needle import Query, StartRegion, needle_environment, violation


@pytest.fixture(scope="module")
def plan(small_lung: Lung, small_atlas: la.Atlas) -> Plan:
    target = la.resolve_target(small_lung)
    *_, best = la.plan(
        small_lung, small_atlas.system, target, atlas=small_atlas, iterations=20, goal="default"
    )
    return best


@pytest.fixture(scope="module")
def region(plan: Plan, small_lung: Lung) -> StartRegion:
    return la.safe_start_region(plan, small_lung, poses=2000)


@pytest.mark.parametrize("exactly", [False, True])
def test_every_pose_of_the_proved_part_has_a_path_by_the_rules_of_plans(
    plan: Plan, small_lung: Lung, exactly: bool
) -> None:
    radius = 0.0 if exactly else goal_radius(small_lung, plan.target_lps)[0]
    region = la.safe_start_region(plan, small_lung, radius_mm=radius, poses=25)
    needle = plan.system.require_needle("this test")
    environment = needle_environment(
        small_lung, needle, plan.system.margins, with_fissures=plan.fissures_are_obstacles,
        goal_tolerance_mm=radius,
    )  # fmt: skip
    proved, frame, rng = region.proved, region.lps_from_start, np.random.default_rng(0)
    for n in rng.integers(0, len(proved.offsets_mm), 500):
        aside = rng.normal(size=3)
        aside *= proved.offsets_mm[n] * (1.0 - 1e-9) / np.linalg.norm(aside)
        tilt, around = max(proved.tilts_rad[n] - 1e-9, 0.0), rng.uniform(0.0, 2.0 * math.pi)
        across = math.cos(around) * frame[:3, 0] + math.sin(around) * frame[:3, 1]
        moved = pose(frame[:3, 3] + aside, math.cos(tilt) * frame[:3, 2] + math.sin(tilt) * across)
        path = region.path_from(moved)
        assert path is not None
        asked = Query(lps_from_start=moved, target=plan.target_lps, branch=plan.exemption.branch)
        assert violation(environment, asked, path) == ""


def test_the_planned_start_belongs_to_it_and_a_far_one_does_not(plan: Plan, region: StartRegion) -> None:
    assert region.path_from(plan.needle.lps_from_start) is not None
    assert region.path_from(pose(plan.needle.lps_from_start[:3, 3] + 9.0, [0.0, 0.0, 1.0])) is None


def test_words_and_record_agree(region: StartRegion) -> None:
    record = json.loads(json.dumps(region.record(), allow_nan=False))
    assert record["words"] == region.words
    assert record["proved"]["offset_mm"] == region.proved.offset_mm
    assert sum(record["tried"]["counts"].values()) == record["tried"]["poses"]
    share = f"{100.0 * region.tried.share():.0f} % of the poses up to 5 mm and 15°"
    assert share in region.words


def test_a_wider_radius_never_proves_less(plan: Plan, small_lung: Lung) -> None:
    volumes = [
        la.safe_start_region(plan, small_lung, radius_mm=radius, poses=25).proved.volume
        for radius in (0.0, 1.0, 3.0)
    ]
    assert volumes == sorted(volumes)
    assert volumes[-1] > 0.0


def test_bodies_are_closed_and_lie_around_the_tip(region: StartRegion) -> None:
    proved, tried = proved_body(region), tried_body(region)
    start = region.lps_from_start[:3, 3]
    assert proved is not None
    assert tried is not None
    for body in (proved, tried):
        assert body.to_trimesh().is_watertight
        assert body.to_trimesh().volume > 0.0
    ball = 4.0 / 3.0 * math.pi * region.proved.offset_mm**3
    assert proved.to_trimesh().volume > 0.5 * ball
    assert np.linalg.norm(tried.vertices_lps - start, axis=1).max() <= 5.0 + region.tried.spacing_mm


def test_what_it_cannot_answer_is_refused(plan: Plan, small_lung: Lung) -> None:
    with pytest.raises(PlanFileError):
        la.safe_start_region(replace(plan, lung_key="0" * 64), small_lung)
    with pytest.raises(SettingsError, match="no needle|needle"):
        la.safe_start_region(replace(plan, system=la.load_system("tubes-only"), needle=None), small_lung)
    costs = np.zeros(small_lung.grid.shape, dtype=np.float32)
    costs[0, 0, 0] = np.inf
    forbidding = replace(small_lung, cost=Volume(grid=small_lung.grid, array=costs))
    with pytest.raises(SettingsError, match="cost map"):
        la.safe_start_region(plan, forbidding)


@pytest.mark.slow
def test_the_command_says_it_first(
    plan: Plan, small_phantom: Phantom, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_phantom(small_phantom, tmp_path / "patient")
    lung = la.load_patient(tmp_path / "patient", cache=tmp_path / "cache")
    replace(plan, lung_key=lung.key).save(tmp_path / "plan.json")
    words = [str(tmp_path / "plan.json"), str(tmp_path / "patient"), "--cache", str(tmp_path / "cache")]
    few = ["--poses", "500", "--iterations", "0"]
    assert main(["start-region", *words, *few]) == 0
    assert capsys.readouterr().out.startswith("The needle may start up to ")
    assert main(["start-region", *words, *few, "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["tried"]["counts"]["a search"] == 0
    assert main(["start-region", *words, "--tilt", "80"]) == 2
    assert "at most 60 degrees" in capsys.readouterr().err
