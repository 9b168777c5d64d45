"""The window of breathing: against brute force on deformed voxels, and what the check makes of false ones."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import polar

from anatomy.base.errors import AnatomyError, PlanFileError, SettingsError
from anatomy.build import clearance_fields
from anatomy.fields import corner_geometry, distance_field
from anatomy.motion.motion import Motion
from anatomy.structures import LUMEN
from experiments.support.warped_voxels import BruteForce
from lungaccess.judging.appraisal import Headline
from lungaccess.judging.checking import check
from lungaccess.judging.checking.boxes import Environment
from lungaccess.judging.checking.findings import Findings
from lungaccess.judging.checking.window import Breath, check_window
from lungaccess.plans.plan import Plan
from lungaccess.plans.window import BreathingAim, BreathingWindow
from lungaccess.uncertainty.breathing.kernels.rigid import Rigid, carried, rate_bounds, turned
from lungaccess.uncertainty.breathing.moving import MovingTarget, carried_needle
from lungaccess.uncertainty.breathing.window import breathing_window, device_points, with_window
from tests.lungaccess.motions import motion_by

PHASES = 100


def motion_of(lung: Any, down_mm: float = 9.0, **changes: Any) -> Motion:
    """The farther beyond the end of the bronchus the farther to the feet, and a little to the front."""

    def displacement(at: Any) -> Any:
        square = np.clip((at[..., 0] - 36.0) / 48.0, 0.0, None) ** 2
        return np.stack([0.1 * down_mm * square, -0.2 * down_mm * square, -down_mm * square], axis=-1)

    return motion_by(lung, displacement, **changes)


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
    for phase in np.linspace(0.0, 1.0, 24):
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


def affine(lung: Any, gradient: np.ndarray, shift: np.ndarray) -> Any:
    """The toy lung with a motion that is affine, so that samples of it are exact."""
    motion = motion_of(lung)
    x = motion.grid.lps(np.moveaxis(np.indices(motion.grid.shape), 0, -1))
    d = x @ gradient.T + shift
    return breathing(lung, nodes=np.stack([d, d]))


def test_a_needle_in_tissue_that_moves_rigidly_stays_as_it_was_inserted(plan: Plan, lung: Any) -> None:
    still = affine(lung, np.zeros((3, 3)), np.array([1.0, 2.0, -12.0]))
    window = breathing_window(plan, still)
    assert window.share == 1.0
    found = carried_needle(plan, still, window)
    assert found.shift_at_tubes_mm < 1e-6
    assert found.bend_at_tubes_deg < 5.0  # The chord of the first 5 mm of an arc.
    assert found.length_factor == pytest.approx(1.0)
    assert plan.needle is not None
    curvatures = [arc.curvature_per_mm for arc in plan.needle.arcs]
    assert found.least_radius_mm > 0.99 / max(*curvatures, 1e-9)


def test_a_needle_in_tissue_ends_where_its_tissue_goes(plan: Plan, lung: Any) -> None:
    gradient = np.diag([0.08, 0.0, -0.05])
    stretched = affine(lung, gradient, np.zeros(3))
    window = replace(breathing_window(plan, stretched), phases=np.array([[0.0, 0.0]]))
    found = carried_needle(plan, stretched, window)
    points = device_points(plan)
    needle = points.points[points.arc_mm >= points.tube_mm][1:]
    whole = needle + needle @ gradient.T
    lengths = [np.linalg.norm(np.diff(each, axis=0), axis=1).sum() for each in (needle, whole)]
    assert found.length_factor == pytest.approx(lengths[1] / lengths[0], abs=1e-6)
    tip = plan.scope.lps_from_scope_tip[:3, 3]
    assert found.shift_at_tubes_mm == pytest.approx(np.linalg.norm(gradient @ (needle[0] - tip)), abs=1e-6)
    away = needle[-1] - plan.target_lps
    misses = [np.linalg.norm(away + share * gradient @ away) for share in (0.0, 1.0)]
    assert found.end_miss_mm == pytest.approx(max(misses), abs=1e-6)
    with pytest.raises(SettingsError, match="no phase to insert in"):
        carried_needle(plan, stretched, replace(window, phases=np.zeros((0, 2))))


STRAYS = 0.003


@pytest.fixture(scope="module")
def straying(plan: Plan, lung: Any) -> tuple[Plan, Any]:
    other = breathing(lung, hysteresis=STRAYS)
    return with_window(plan, other), other


def test_a_window_with_hysteresis_holds_wherever_tissue_strays(straying: Any, planned: Plan) -> None:
    """Tissue that strays against the devices is devices that stray against tissue."""
    plan, lung = straying
    window = window_of(plan)
    assert 0.02 < window.share < window_of(planned).share
    assert "strays by 0.3 % of its distance" in window.words
    brute = BruteForce(plan, lung, lung.motion)
    kept, tip = brute.carried, plan.scope.lps_from_scope_tip[:3, 3]
    for way in np.vstack([np.eye(3), -np.eye(3), np.full((1, 3), 3**-0.5)]):

        def strayed(points: Any, share: float, way: Any = way) -> Any:
            lever = np.linalg.norm(points - tip, axis=1, keepdims=True)
            return kept(points, share) + STRAYS * lever * way

        brute.carried = strayed  # type: ignore[method-assign]
        for phase in window.phases.mean(axis=1).tolist() + window.phases.ravel().tolist():
            assert brute.clearance(phase).min() > -1e-3
            assert brute.miss_mm(phase) <= window.tolerance_mm + 1e-9


def test_the_check_derives_the_hysteresis_again(straying: Any, planned: Plan, moving: Any) -> None:
    plan, lung = straying
    assert Plan.from_json(plan.to_json()).digest == plan.digest
    assert not window_refusals(plan, lung)
    assert "hysteresis" not in planned.to_json()
    without = replace(window_of(plan), hysteresis=0.0)
    assert "window.source" in window_refusals(replace(plan, window=without), lung)
    too_long = replace(window_of(planned), motion_key=lung.motion.key, hysteresis=STRAYS)
    found = window_refusals(replace(plan, window=too_long), lung)
    assert {"window.target", "window.clearance", "window.in_airway", "window.hole"} & set(found), found
    assert moving.motion.key != lung.motion.key


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


ASIDE = np.array([0.3, -0.4, 0.2])


@pytest.fixture(scope="module")
def aimed(plan: Plan, moving: Any) -> Plan:
    """The needle ends as before, which is beside another target; the window holds the phases asked for."""
    aim = BreathingAim(point_lps=plan.target_lps, phases=np.array([[0.0, 0.1]]))
    return with_window(replace(plan, aim=aim, target_lps=plan.target_lps + ASIDE), moving)


def test_a_plan_with_an_aim_says_how_far_beside_the_target_it_ends(aimed: Plan, moving: Any) -> None:
    assert window_of(aimed).beside_target_mm == pytest.approx(np.linalg.norm(ASIDE))
    assert "0.5 mm beside the target" in window_of(aimed).words
    assert Plan.from_json(aimed.to_json()).digest == aimed.digest
    report = check(aimed, moving)
    assert report.accepted, report.refusals
    names = {finding.name for finding in report.findings}
    assert {"target.aim", "window.asked", "window.of_aim"} <= names and "target.reached" not in names
    assert Headline.of(report, None).has_aim


def aim_of(plan: Plan) -> BreathingAim:
    assert plan.aim is not None
    return plan.aim


@pytest.mark.parametrize(
    ("false", "finding"),
    [
        (lambda p: replace(p, aim=None), "target.reached"),
        (lambda p: replace(p, aim=replace(aim_of(p), point_lps=p.target_lps)), "target.aim"),
        (lambda p: replace(p, aim=replace(aim_of(p), phases=np.array([[0.0, 0.99]]))), "window.asked"),
        (lambda p: replace(p, window=None), "window.of_aim"),
        (lambda p: replace(p, window=replace(window_of(p), beside_target_mm=0.0)), "window.beside_target"),
        (lambda p: replace(p, window=replace(window_of(p), tolerance_mm=3.0)), "window.tolerance"),
        (lambda p: replace(p, target_lps=p.target_lps + [0.0, 0.0, 9.0]), "window.target"),
    ],
)
def test_a_false_aim_is_refused(aimed: Plan, moving: Any, false: Any, finding: str) -> None:
    assert finding in [each.name for each in check(false(aimed), moving).refusals]


def test_phases_of_an_aim_are_one_stretch_of_the_breath() -> None:
    for phases in ([[0.3, 0.2]], [[0.0, 1.1]], [[0.0, 0.2], [0.4, 0.5]]):
        with pytest.raises(PlanFileError, match="phases"):
            BreathingAim(point_lps=np.zeros(3), phases=np.array(phases))


class TestAim:
    """One aim for each place of the scope's tip, against the moving target itself."""

    def test_it_misses_the_target_least(self, plan: Plan, moving: Any) -> None:
        tip, target = plan.scope.lps_from_scope_tip[:3, 3], plan.target_lps
        found = MovingTarget(moving.motion, target, (0.0, 1.0), widened=False).aim(tip)
        least = misses_of(plan, moving, np.array([found.point_lps])).max()
        assert 1.0 < found.least_miss_mm <= least + 1e-9 <= 1.02 * found.least_miss_mm
        assert found.least_miss_mm <= misses_of(plan, moving, ends_near(found.point_lps)).max(axis=1).min()

    @pytest.mark.parametrize("masks_phase", [0.0, 0.5, 1.0])
    def test_no_end_is_on_target_in_more_of_the_breath_than_the_bound(
        self, plan: Plan, lung: Any, masks_phase: float
    ) -> None:
        moving = breathing(lung, down_mm=14.0, masks_phase=masks_phase)
        tip = plan.scope.lps_from_scope_tip[:3, 3]
        found = MovingTarget(moving.motion, plan.target_lps, widened=True).aim(tip)
        begin, end = found.phases
        assert begin - 1e-9 <= masks_phase <= end + 1e-9
        shares = (misses_of(plan, moving, ends_near(found.point_lps)) <= 2.0).mean(axis=1)
        assert shares.max() <= found.most_share + 1.0 / PHASES < 1.0
        on_target = misses_of(plan, moving, np.array([found.point_lps])) <= 2.0
        assert on_target.mean() >= 0.97 * found.most_share

    def test_given_phases_are_held_by_wider_ones(self, plan: Plan, moving: Any) -> None:
        tip = plan.scope.lps_from_scope_tip[:3, 3]
        for asked in ((0.4, 0.6), (0.7, 0.9)):
            found = MovingTarget(moving.motion, plan.target_lps, asked, widened=True).aim(tip)
            assert found.phases[0] <= asked[0] and asked[1] <= found.phases[1]
            plain = MovingTarget(moving.motion, plan.target_lps, asked, widened=False).aim(tip)
            assert plain.phases == asked and plain.least_miss_mm <= found.least_miss_mm


def ends_near(point: Any) -> Any:
    return np.array(point) + 0.5 * np.random.default_rng(0).standard_normal((50, 3))


def misses_of(plan: Plan, lung: Any, ends: Any) -> Any:
    """How far ends of the devices (N, 3) miss the target in each of 100 phases, as the check has it."""
    breath = Breath(lung.motion, plan.target_lps, plan.scope.lps_from_scope_tip[:3, 3])
    gaps = [
        breath.carried(ends, phase) - breath.moved(plan.target_lps[None], phase)
        for phase in np.linspace(0.0, 1.0, PHASES)
    ]
    return np.linalg.norm(np.stack(gaps, axis=1), axis=2)
