"""The window of breathing: against brute force on deformed voxels, and what the check makes of false ones."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import polar

from anatomy.build import clearance_fields
from anatomy.errors import AnatomyError, SettingsError
from anatomy.fields import corner_geometry, distance_field
from anatomy.grid import Grid
from anatomy.motion.motion import Motion
from anatomy.structures import LUMEN
from experiments.support.warped_voxels import BruteForce
from lungaccess.breathing.kernels.rigid import Rigid, carried, rate_bounds, turned
from lungaccess.breathing.window import breathing_window, with_window
from lungaccess.checking import check
from lungaccess.checking.environment import Environment
from lungaccess.checking.findings import Findings
from lungaccess.checking.window import check_window
from lungaccess.plans.plan import Plan
from lungaccess.plans.window import BreathingWindow

NODE_MM = 5.0


def motion_of(lung: Any, down_mm: float = 9.0, masks_phase: float = 0.0, **changes: Any) -> Motion:
    """The farther beyond the end of the bronchus the farther to the feet, and a little to the front."""
    corners = lung.grid.lps(np.array([(0, 0, 0), np.array(lung.labels.shape) - 1]))
    low, high = corners.min(axis=0) - 10.0, corners.max(axis=0) + 10.0
    grid = Grid.from_spacing(np.ceil((high - low) / NODE_MM).astype(int) + 1, (NODE_MM,) * 3, low)
    x = grid.lps(np.moveaxis(np.indices(grid.shape), 0, -1))[..., 0]
    square = np.clip((x - 36.0) / 48.0, 0.0, None) ** 2
    d = np.stack([0.1 * down_mm * square, -0.2 * down_mm * square, -down_mm * square], axis=-1)
    values = {
        "grid": grid, "nodes": np.stack([d, d]), "middle_x_mm": 0.0, "masks_phase": masks_phase,
        "amplitude": 1.0, "source": "made for a test", "warning_only": False, "figures": {},
    }  # fmt: skip
    return Motion(**values | changes)


def breathing(lung: Any, **changes: Any) -> Any:
    """The toy lung with what the proof reads of it, and a motion."""
    fields = clearance_fields(lung.labels, lung.grid, fissures=True)
    return SimpleNamespace(
        **{**vars(lung), "motion": motion_of(lung, **changes)},
        geometry=corner_geometry(lung.grid),
        obstacle_field=lambda *, with_fissures: fields["obstacle_fissure" if with_fissures else "obstacle"],
        lumen_depth=distance_field("lumen", (lung.labels & LUMEN) == 0, lung.grid),
    )


@pytest.fixture(scope="module")
def moving(lung: Any) -> Any:
    return breathing(lung)


@pytest.fixture(scope="module")
def planned(plan: Plan, moving: Any) -> Plan:
    return with_window(plan, moving)


def window_refusals(plan: Plan, lung: Any) -> list[str]:
    """What the check refuses of the window alone."""
    found = Findings()
    check_window(plan, Environment(lung), found)
    return [each.name for each in found.report().refusals]


def window_of(plan: Plan) -> BreathingWindow:
    assert plan.window is not None
    return plan.window


def test_a_window_agrees_with_brute_force(planned: Plan, moving: Any) -> None:
    window, brute = window_of(planned), BruteForce(planned, moving, moving.motion)
    assert 0.05 < window.share < 0.95
    assert window.undecided_share < 0.01
    assert "lumen" not in {each.reason for each in window.limits}  # Which brute force does not look at.
    for phase in np.linspace(0.0, 1.0, 60):
        spare, miss = brute.clearance(phase).min(), brute.miss_mm(phase)
        if window.holds(phase):
            assert spare > -1e-3
            assert miss <= window.tolerance_mm + 1e-9
        elif not window.holds(phase - 0.02) and not window.holds(phase + 0.02):
            assert spare < 0.005 or miss > window.tolerance_mm


def test_a_true_window_is_accepted_and_stored_without_loss(planned: Plan, moving: Any) -> None:
    again = Plan.from_json(planned.to_json())
    assert again.digest == planned.digest
    report = check(again, moving)
    assert report.accepted, report.refusals
    names = {finding.name for finding in report.findings}
    assert {"window.motion", "window.target", "window.clearance", "window.in_airway"} <= names


def wider(window: BreathingWindow, by: float) -> BreathingWindow:
    phases = np.clip(window.phases + [-by, by], 0.0, 1.0)
    ends = [each for each in phases.ravel() if 0.0 < each < 1.0]
    limits = tuple(replace(window.limits[0], phase=each) for each in ends)
    return replace(window, phases=phases, limits=limits, undecided_share=0.0)


@pytest.mark.parametrize(
    ("false", "finding"),
    [
        (lambda w: wider(w, 0.05), "window."),
        (lambda w: wider(w, 0.9), "window."),
        (lambda w: replace(w, motion_key="0" * 64), "window.motion"),
        (lambda w: replace(w, masks_phase=1.0), "window.source"),
        (lambda w: replace(w, amplitude=0.1), "window.source"),
        (lambda w: replace(w, motion_source="another"), "window.source"),
        (lambda w: replace(w, warning_only=True), "window.source"),
        (lambda w: replace(wider(w, 0.9), tolerance_mm=30.0), "window.tolerance"),
        (lambda w: replace(w, limits=()), "window.limits"),
        (lambda w: replace(w, undecided_share=1.0), "window.undecided"),
    ],
)
def test_a_false_window_is_refused(planned: Plan, moving: Any, false: Any, finding: str) -> None:
    found = window_refusals(replace(planned, window=false(window_of(planned))), moving)
    assert any(name.startswith(finding) for name in found), found


def test_another_motion_of_the_patient_refuses_the_window(planned: Plan, lung: Any) -> None:
    other = breathing(lung, down_mm=10.0)
    assert "window.motion" in window_refusals(planned, other)


def test_a_window_needs_a_motion(planned: Plan, plan: Plan, lung: Any, moving: Any) -> None:
    assert "window.motion" in window_refusals(planned, lung)
    with pytest.raises(AnatomyError, match="masks_phase"):
        breathing_window(plan, lung)
    with pytest.raises(SettingsError, match="0 to 2 mm"):
        breathing_window(plan, moving, tolerance_mm=3.0)


def test_without_motion_nothing_changes(plan: Plan, lung: Any) -> None:
    assert with_window(plan, lung) is plan
    assert "window" not in plan.to_json()
    assert not [each for each in check(plan, lung).findings if each.name.startswith("window")]


def test_a_plan_without_window_is_not_checked_for_one(plan: Plan, moving: Any) -> None:
    report = check(plan, moving)
    assert report.accepted
    assert "window" in [each.name for each in report.unchecked]


def test_who_does_not_breathe_has_the_whole_breath(plan: Plan, lung: Any) -> None:
    still = breathing_window(plan, breathing(lung, amplitude=0.0))
    assert still.phases.tolist() == [[0.0, 1.0]]
    assert not still.limits
    assert "between 0 % and 100 %" in still.words


def test_half_the_amplitude_is_half_the_phase(plan: Plan, lung: Any, planned: Plan) -> None:
    half = breathing_window(plan, breathing(lung, amplitude=0.5))
    whole = window_of(planned).phases[0, 1]
    assert half.phases[0, 1] == pytest.approx(min(2.0 * whole, 1.0), abs=0.005)


@pytest.mark.parametrize("share", [0.0, 0.3, -0.8, 1.0])
def test_the_devices_turn_by_the_rotation_of_the_polar_decomposition(share: float) -> None:
    gradient = np.random.default_rng(2).normal(0.0, 0.12, (3, 3))
    rotation, rate = np.zeros((2, 3, 3))
    turned(gradient, share, rotation, rate)
    assert np.allclose(rotation, polar(np.eye(3) + share * gradient)[0], atol=1e-12)
    step, ends = 1e-5, []
    rates = []
    for s in (share - step, share + step):
        at, speed = np.zeros((2, 3, 3))
        turned(gradient, s, at, speed)
        ends.append(at)
        rates.append(speed)
    assert np.allclose(rate, (ends[1] - ends[0]) / (2 * step), atol=1e-8)
    most_rate, most_change = rate_bounds(gradient, abs(share))
    assert np.linalg.norm(rate, 2) <= most_rate
    assert np.linalg.norm((rates[1] - rates[0]) / (2 * step), 2) <= most_change


def test_the_tip_goes_with_its_tissue_and_nothing_moves_in_the_masks_phase() -> None:
    gradient = np.array([[0.0, -0.1, 0.0], [0.1, 0.0, 0.0], [0.0, 0.0, 0.05]])
    rigid = Rigid(np.array([1.0, 2.0, 3.0]), np.array([0.0, 1.0, -5.0]), gradient)
    rotation, rate = np.zeros((2, 3, 3))
    turned(gradient, 0.5, rotation, rate)
    assert np.allclose(carried(rigid, 0.5, rotation, rate, 1.0, 2.0, 3.0)[:3], (1.0, 2.5, 0.5))
    turned(gradient, 0.0, rotation, rate)
    assert np.allclose(carried(rigid, 0.0, rotation, rate, 40.0, -7.0, 9.0)[:3], (40.0, -7.0, 9.0))
