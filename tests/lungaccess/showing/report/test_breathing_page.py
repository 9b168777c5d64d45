"""What a page shows of breathing: places are those of the check, clearances those of the deformed lung."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from anatomy.lung import Lung
from anatomy.meshes import SurfaceMesh, point_distances_mm
from lungaccess.cli.app import main
from lungaccess.cli.exit_code import ExitCode
from lungaccess.judging.appraisal.headline import Grade
from lungaccess.judging.checking.window import Breath
from lungaccess.plans.plan import Plan
from lungaccess.plans.window import BreathingAim, BreathingWindow
from lungaccess.showing.report.clock import PROVED, sectors, window_png
from lungaccess.showing.report.html import breathing
from lungaccess.showing.report.html import breathing as controls
from lungaccess.showing.report.html.deployment import (
    CAP_MM,
    COLOURED_MM,
    packed_plan,
    profile,
    profile_points,
)
from lungaccess.showing.report.html.page_of_plan import summary
from lungaccess.showing.report.pack import unpack
from lungaccess.uncertainty.breathing.moving import Moving


@pytest.fixture(scope="module")
def plan(breathing_plans: tuple[Plan, ...]) -> Plan:
    return breathing_plans[0]


@pytest.fixture(scope="module")
def moving(plan: Plan, breathing_lung: Lung) -> Moving:
    return Moving.of(plan, breathing_lung)


@pytest.fixture(scope="module")
def samples(plan: Plan, breathing_lung: Lung) -> dict[str, Any]:
    return breathing.samples(plan, breathing_lung)


@pytest.fixture(scope="module")
def packed(plan: Plan, breathing_lung: Lung, samples: dict[str, Any]) -> dict[str, Any]:
    return dict(breathing.packed_breath((plan,), breathing_lung, [samples])["breath"])


@pytest.fixture(scope="module")
def window(plan: Plan) -> BreathingWindow:
    assert plan.window is not None
    return plan.window


@pytest.mark.parametrize("phase", [0.0, 0.4, 1.0])
def test_tissue_and_devices_are_where_the_check_has_them(
    phase: float, plan: Plan, moving: Moving, breathing_lung: Lung
) -> None:
    assert breathing_lung.motion is not None
    tip = np.asarray(plan.scope.lps_from_scope_tip[:3, 3])
    own = Breath(breathing_lung.motion, np.asarray(plan.target_lps), tip)
    points = profile_points(plan)[0]
    assert np.abs(moving.carried(points, phase) - own.carried(points, phase)).max() < 1e-6
    lung_of_target = breathing_lung.motion.side_of(plan.target_lps)
    near = points[[breathing_lung.motion.side_of(each) == lung_of_target for each in points]]
    assert np.abs(moving.moved(near, phase) - own.moved(near, phase)).max() < 1e-6
    assert np.abs(moving.moved(moving.pulled_back(points, phase), phase) - points).max() < 1e-6


def test_the_page_stores_the_displacement_finely(packed: dict[str, Any], moving: Moving) -> None:
    counts = [np.cumsum(unpack(each["voxels"]), axis=-1).transpose(2, 1, 0) for each in packed["fields"]]
    error = np.abs(packed["step_mm"] * np.stack(counts, axis=-1) - moving.field).max()
    assert error <= 0.5 * breathing.FIELD_STEP_MM + 1e-9
    assert np.ptp(moving.field) > 3.0


def test_clearances_in_the_phase_of_the_masks_are_those_of_the_plan(
    packed: dict[str, Any], samples: dict[str, Any], plan: Plan, breathing_lung: Lung
) -> None:
    known = profile(plan, breathing_lung)
    assert samples["phases"][-1] == packed["masks_phase"] == 1.0
    for name, values in known["clearance_mm"].items():
        assert np.abs(samples["clearance_mm"][name][-1] - values).max() < 0.01
    margin = unpack(packed["plans"][0]["samples"]["margins_mm"][-1])
    stated = unpack(packed_plan(plan, breathing_lung, "", sections=False)["needle"]["margin_mm"])
    assert np.abs(np.minimum(margin, COLOURED_MM) - np.minimum(stated, COLOURED_MM)).max() < 0.01
    assert samples["target_mm"][-1] < 0.01
    assert samples["target_mm"][0] > 0.1


def test_distances_to_triangles_are_exact() -> None:
    corners = np.array(
        [[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [10, 10, 0], [40.0, 0, 0], [41, 0, 0], [40, 1, 0]]
    )
    mesh = SurfaceMesh(vertices_lps=corners, faces=np.array([[0, 1, 2], [1, 3, 2], [4, 5, 6]]), bound_mm=0.0)
    points = np.array([[5.0, 5, 3], [-3, -4, 0], [39, 0, 0], [25, 0, 40], [9, 9, -1]])
    assert point_distances_mm(mesh, points, 30.0) == pytest.approx([3.0, 5.0, 1.0, 30.0, 1.0])


@pytest.mark.parametrize(
    ("change", "accepted", "grade", "said"),
    [
        ({}, True, Grade.GOOD, "Insert between 60 % and 100 %"),
        ({}, False, Grade.POOR, "The check refuses this plan"),
        ({"warning_only": True}, True, Grade.UNKNOWN, "a warning, not a promise"),
        ({"phases": np.zeros((0, 2))}, True, Grade.POOR, "No phase of the breath is proved"),
    ],
)
def test_the_headline_says_good_and_bad_news(
    change: dict[str, Any],
    accepted: bool,
    grade: Grade,
    said: str,
    plan: Plan,
    window: BreathingWindow,
    breathing_lung: Lung,
) -> None:
    changed = replace(plan, window=replace(window, **change))
    html = controls.window_headline(changed, breathing_lung, accepted)
    assert f"grade-{grade.key}" in html
    assert said in html.replace("&#x27;", "'")


def test_a_plan_without_a_window_says_so_and_does_not_move(plan: Plan, breathing_lung: Lung) -> None:
    still = replace(plan, window=None)
    assert "was not computed" in controls.window_headline(still, breathing_lung, True)
    assert breathing.packed_breath((still,), breathing_lung, [{}]) == {}
    assert controls.player(None, True) == controls.slices_note(None) == ""


def test_an_aim_is_drawn_and_told(plan: Plan, breathing_lung: Lung) -> None:
    assert "aim_lps" not in packed_plan(plan, breathing_lung, "")
    place = np.asarray(plan.target_lps) + [0.0, 0.0, 1.5]
    aimed = replace(plan, aim=BreathingAim(point_lps=place, phases=np.array([[0.7, 1.0]])))
    assert packed_plan(aimed, breathing_lung, "")["aim_lps"] == place.tolist()
    assert "the devices end 1.5 mm beside it, at their aim" in summary(aimed, breathing_lung)


def test_what_strays_takes_from_what_is_to_spare(
    samples: dict[str, Any], plan: Plan, breathing_lung: Lung
) -> None:
    """A share of the distance from the tip of the scope, at which the end of the needle is the farthest."""
    assert plan.window is not None
    share = 0.02
    straying = replace(plan, window=replace(plan.window, hysteresis=share))
    lung = replace(breathing_lung, motion=replace(breathing_lung.motion, hysteresis=share))
    one, other = samples, breathing.samples(straying, lung)
    tip = plan.scope.lps_from_scope_tip[:3, 3]
    farthest_mm = float(np.linalg.norm(profile_points(plan)[0] - tip, axis=1).max())
    for name, values in one["spare_mm"].items():
        lost = np.array(values) - np.array(other["spare_mm"][name])
        assert lost.min() > 0.0
        assert lost.max() < share * (farthest_mm + CAP_MM) / (1.0 - share)
    assert other["allowed_mm"] == pytest.approx((2.0 - share * farthest_mm) / (1.0 + share), abs=1e-3)


def test_a_page_without_breathing_has_nothing_of_it(page: Path, data: dict[str, Any]) -> None:
    assert "breath" not in data
    body = page.read_text().split("<body", 1)[1].split('id="report-data"', 1)[0]
    assert not re.search('breath-row|chart-breath|class="clock"|Breathing.</strong>', body)


def test_the_clock_covers_the_breath(window: BreathingWindow, tmp_path: Path) -> None:
    two = replace(window, phases=np.array([[0.1, 0.3], [0.6, 1.0]]), limits=())
    found = [(each.begin, each.end, each.proved) for each in sectors(two)]
    assert found == [(0.0, 0.1, False), (0.1, 0.3, True), (0.3, 0.6, False), (0.6, 1.0, True)]
    assert controls.clock_svg(two, True).count("<path d=") == 2 * len(found)
    assert PROVED in controls.clock_svg(two, True) + controls.player(two, True)
    for change, accepted in (({}, False), ({"warning_only": True}, True)):
        other = replace(two, **change)
        assert PROVED not in controls.clock_svg(other, accepted) + controls.player(other, accepted)
    assert window_png(window, tmp_path / "clock.png").stat().st_size > 5000


def test_a_picture_of_the_window_is_a_png(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["window", "plan.json", "PATIENT", "--picture", "clock.jpg"]) == ExitCode.BAD_INPUT
    assert "clock.jpg does not end in .png" in capsys.readouterr().err
