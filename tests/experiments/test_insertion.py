"""Insertions with errors: what happens to the needle, and what replanning is worth."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from anatomy.base.errors import SettingsError
from anatomy.margins import Margins
from anatomy.poses import pose
from anatomy.structures import OBSTACLES, VESSEL
from lungaccess.planning.procedure.insertion import (
    Errors,
    Insertion,
    Outcome,
    Study,
    Truth,
    simulate,
    study,
    summary,
)
from stages.needle.device import Needle
from stages.needle.environment import NeedleEnvironment, needle_environment
from stages.needle.path import ArcPath, arc_transform, direct_path
from stages.needle.query import Query
from stages.needle.replanning.replanner import Failure, ReplanSettings, with_reserve
from stages.needle.search.base import RestartingRRT
from tests.stages.scenes import Canvas, brute_clearance

KAPPA = 1 / 40
MANY = range(24)


def environment_with(*balls: tuple[Any, float], **changes: float) -> NeedleEnvironment:
    """Free lung of 56 x 56 x 96 mm with balls of vessel."""
    canvas = Canvas.empty([-28, -28, -48], [28, 28, 48], 1.0)
    for centre, radius in balls:
        canvas.add(canvas.ball(centre, radius), VESSEL)
    values: dict[str, float] = {"diameter_mm": 1.0, "max_curvature_per_mm": KAPPA, **changes}
    return needle_environment(canvas.lung(), Needle(**values), Margins(), with_fissures=False)


START = np.array(pose([0.0, 0.0, -40.0], [0.0, 0.0, 1.0]))
TARGET = np.array([10.0, 4.0, 38.0])
BEHIND = np.array([0.0, 0.0, 38.0])
FREE = environment_with()
BALL = environment_with(([0, 0, 0], 5.0))
ASIDE = Query(lps_from_start=START, target=TARGET)
AROUND = Query(lps_from_start=START, target=BEHIND)
DIRECT = direct_path(START, TARGET)
NONE = Errors()


def planned(environment: NeedleEnvironment, query: Query) -> ArcPath:
    search = RestartingRRT(environment, query, seed=3)
    search.advance(20_000)
    assert search.path is not None
    return search.path


def run(errors: Errors = NONE, **more: Any) -> Insertion:
    """Insert through free lung."""
    values: dict[str, Any] = {"closed_loop": False, "seed": 1, **more}
    return simulate(FREE, ASIDE, DIRECT, errors, **values)


def median_errors(errors: Errors, **more: Any) -> Study:
    return study(FREE, ASIDE, DIRECT, errors, seeds=MANY, iterations=200, step_mm=1.0, **more)


class TestTheNeedle:
    """The true path."""

    @pytest.mark.parametrize("closed_loop", [False, True])
    def test_without_errors_it_ends_exactly_at_the_target(self, closed_loop: bool) -> None:
        for environment, query, plan in ((FREE, ASIDE, DIRECT), (BALL, AROUND, planned(BALL, AROUND))):
            made = simulate(environment, query, plan, Errors(), closed_loop=closed_loop, seed=1)
            assert made.outcome is Outcome.REACHED
            assert made.tip_error_mm < 1e-9
            assert made.clearance_mm > environment.required_clearance_mm - environment.needle.radius_mm
            assert len(made.replans) == (math.ceil(made.inserted_mm[-1] / 5.0) - 1 if closed_loop else 0)

    def test_in_open_loop_without_errors_it_is_the_plan(self) -> None:
        plan = planned(BALL, AROUND)
        made = simulate(BALL, AROUND, plan, Errors(), closed_loop=False, seed=1, step_mm=0.4)
        points, lengths = plan.sample(0.05)
        for frame, inserted in zip(made.lps_from_tip, made.inserted_mm, strict=True):
            near = [np.interp(inserted, lengths, axis) for axis in points.T]
            assert np.linalg.norm(frame[:3, 3] - near) < 1e-4
        assert np.diff(made.inserted_mm).max() <= 0.4 + 1e-12
        assert made.inserted_mm[-1] == pytest.approx(plan.length_mm)

    @given(bias=st.floats(-0.5, 0.5), step=st.floats(0.1, 3.0))
    @hypothesis_settings(max_examples=25)
    def test_a_wrong_curvature_makes_another_arc_whatever_the_step(self, bias: float, step: float) -> None:
        made = run(Errors(curvature_bias=bias), step_mm=step)
        length, roll, curvature = DIRECT.arcs[0]
        end = (START @ arc_transform(length, roll, (1.0 + bias) * curvature))[:3, 3]
        assert np.linalg.norm(made.lps_from_tip[-1][:3, 3] - end) < 1e-9
        assert made.tip_error_mm == pytest.approx(float(np.linalg.norm(end - TARGET)), abs=1e-9)

    def test_a_bevel_that_points_elsewhere_turns_the_arc_about_the_start(self) -> None:
        """It ends on a circle about the axis of the start."""
        ends = [run(Errors(roll_sd_deg=60.0), seed=n).lps_from_tip[-1][:3, 3] for n in range(8)]
        for end in ends:
            assert math.hypot(end[0], end[1]) == pytest.approx(math.hypot(*TARGET[:2]))
            assert end[2] == pytest.approx(TARGET[2])
        assert np.ptp([math.atan2(end[1], end[0]) for end in ends]) > 0.5

    def test_tissue_pulls_a_straight_needle_into_an_arc(self) -> None:
        ahead = Query(lps_from_start=START, target=BEHIND)
        plan = direct_path(START, BEHIND)
        made = simulate(FREE, ahead, plan, Errors(pull_per_mm=0.002), closed_loop=False, seed=1)
        turned = math.acos(float(made.lps_from_tip[-1][:3, 2] @ START[:3, 2]))
        assert 0.0 < turned <= 0.002 * plan.length_mm
        assert made.tip_error_mm == pytest.approx(0.5 * turned * plan.length_mm, rel=0.05)

    def test_its_poses_stay_rigid(self) -> None:
        errors = Errors(
            curvature_wander_sd=0.2, roll_sd_deg=20.0, roll_wander_deg=40.0, pull_per_mm=0.003,
            position_noise_mm=0.5, direction_noise_deg=2.0,
        )  # fmt: skip
        made = run(errors, closed_loop=True)
        rotations = made.lps_from_tip[:, :3, :3]
        assert np.abs(rotations.transpose(0, 2, 1) @ rotations - np.eye(3)).max() < 1e-9

    def test_what_it_hits_ends_the_insertion(self) -> None:
        blocked = direct_path(START, BEHIND)
        made = simulate(BALL, AROUND, blocked, Errors(), closed_loop=False, seed=1)
        assert made.outcome is Outcome.HIT and made.structure == "vessel"
        tip = made.lps_from_tip[-1][:3, 3]
        assert tip[2] == pytest.approx(-5.5, abs=0.8)
        assert made.tip_error_mm == pytest.approx(BEHIND[2] - tip[2])

    def test_the_smallest_clearance_is_that_of_the_needle_surface(self) -> None:
        plan = planned(BALL, AROUND)
        made = simulate(BALL, AROUND, plan, Errors(curvature_bias=0.02), closed_loop=False, seed=1)
        points = np.ascontiguousarray(made.lps_from_tip[:, :3, 3])
        gap = brute_clearance(BALL.obstacles.labels, BALL.grid, points, OBSTACLES, 30.0).min()
        assert made.clearance_mm == pytest.approx(gap - BALL.needle.radius_mm, abs=1e-9)

    def test_a_plan_longer_than_the_needle_is_out_of_length(self) -> None:
        short = environment_with(max_length_mm=40.1)
        made = simulate(short, ASIDE, DIRECT, Errors(), closed_loop=False, seed=1)
        assert made.outcome is Outcome.OUT_OF_LENGTH
        assert made.inserted_mm[-1] == pytest.approx(40.1)

    def test_the_same_seed_is_the_same_insertion(self) -> None:
        errors = Errors(curvature_sd=0.1, roll_sd_deg=10.0, position_noise_mm=0.3, target_walk_mm=2.0)
        for closed_loop in (False, True):
            first, again, other = (run(errors, closed_loop=closed_loop, seed=n) for n in (4, 4, 5))
            assert np.array_equal(first.lps_from_tip, again.lps_from_tip)
            assert first.tip_error_mm != other.tip_error_mm

    def test_wrong_settings(self) -> None:
        for wrong in ({"step_mm": 0.0}, {"tolerance_mm": -1.0}, {"gain": 0.0}, {"gain": 1.5}):
            with pytest.raises(SettingsError):
                run(**wrong)
        for field, value in (("curvature_sd", -0.1), ("measure_every_mm", 0.0), ("target_walk_mm", math.inf)):
            with pytest.raises(SettingsError, match=field):
                Errors(**{field: value})


class TestTruth:
    """The drawn errors have the sizes that the settings state."""

    def drawn(self, errors: Errors, count: int = 400) -> list[Truth]:
        return [Truth(errors, ASIDE, 120.0, seed) for seed in range(count)]

    def test_curvature(self) -> None:
        frame = np.eye(4)
        constant = [t.bend(frame, 0.01, 50.0)[1] / 0.01 for t in self.drawn(Errors(curvature_sd=0.1))]
        assert np.mean(constant) == pytest.approx(1.0, abs=0.02)
        assert np.std(constant) == pytest.approx(0.1, rel=0.12)
        errors = Errors(curvature_wander_sd=0.1, curvature_wander_mm=10.0)
        pairs = np.array(
            [[t.bend(frame, 0.01, s)[1] / 0.01 - 1.0 for s in (50.0, 60.0)] for t in self.drawn(errors)]
        )
        assert pairs.std(axis=0) == pytest.approx([0.1, 0.1], rel=0.12)
        assert np.corrcoef(pairs.T)[0, 1] == pytest.approx(math.exp(-1.0), abs=0.12)

    def test_roll(self) -> None:
        frame = np.eye(4)
        twist = [t.bend(frame, 0.01, 100.0)[0] for t in self.drawn(Errors(roll_wander_deg=10.0))]
        assert np.degrees(np.std(twist)) == pytest.approx(10.0, rel=0.12)
        lags = []
        for truth in self.drawn(Errors(roll_sd_deg=5.0)):
            assert truth.bend(frame, 0.01, 0.0)[0] == 0.0, "not rolled yet"
            truth.roll()
            lags.append(truth.bend(frame, 0.01, 0.0)[0])
        assert np.degrees(np.std(lags)) == pytest.approx(5.0, rel=0.12)

    def test_target(self) -> None:
        walk = np.array([t.target(100.0) - TARGET for t in self.drawn(Errors(target_walk_mm=2.0))])
        assert walk.std(axis=0) == pytest.approx([2.0] * 3, rel=0.15)
        for truth in self.drawn(Errors(target_drift_mm=3.0), 20):
            assert np.linalg.norm(truth.target(100.0) - TARGET) == pytest.approx(3.0)
            assert truth.target(50.0) - TARGET == pytest.approx(0.5 * (truth.target(100.0) - TARGET))
            assert np.array_equal(truth.target(0.0), TARGET)

    def test_tracker(self) -> None:
        errors = Errors(position_noise_mm=0.4, direction_noise_deg=2.0, target_noise_mm=0.7)
        seen = [t.measure(START, 10.0) for t in self.drawn(errors)]
        tips = np.array([frame[:3, 3] - START[:3, 3] for frame, _target in seen])
        assert tips.std(axis=0) == pytest.approx([0.4] * 3, rel=0.15)
        ways = np.array([START[:3, :3].T @ frame[:3, 2] for frame, _target in seen])
        assert np.degrees(ways[:, :2].std(axis=0)) == pytest.approx([2.0] * 2, rel=0.15)
        targets = np.array([target - TARGET for _frame, target in seen])
        assert targets.std(axis=0) == pytest.approx([0.7] * 3, rel=0.15)

    def test_an_error_of_one_kind_leaves_the_others_alone(self) -> None:
        both = Errors(curvature_sd=0.1, target_walk_mm=2.0)
        one, more = Truth(both, ASIDE, 100.0, 7), Truth(replace(both, roll_sd_deg=5.0), ASIDE, 100.0, 7)
        assert np.array_equal(one.target(80.0), more.target(80.0))
        assert one.bend(np.eye(4), 0.01, 3.0) == more.bend(np.eye(4), 0.01, 3.0)


class TestClosedLoop:
    """What measuring and replanning is worth."""

    @pytest.mark.parametrize(
        "errors",
        [
            Errors(curvature_sd=0.15),
            Errors(roll_sd_deg=15.0, roll_wander_deg=20.0),
            Errors(target_drift_mm=5.0),
            pytest.param(Errors(curvature_bias=-0.15, curvature_wander_sd=0.15), marks=pytest.mark.slow),
            pytest.param(Errors(pull_per_mm=0.002), marks=pytest.mark.slow),
            pytest.param(Errors(target_walk_mm=2.0), marks=pytest.mark.slow),
        ],
        ids=["curvature", "roll", "drift", "wander", "pull", "walk"],
    )
    def test_each_error_is_made_much_smaller(self, errors: Errors) -> None:
        made = median_errors(errors)
        assert made.open_loop.median_error_mm > 1.0
        assert made.closed_loop.median_error_mm < 0.4 * made.open_loop.median_error_mm
        assert made.closed_loop.error_95_mm < 0.6 * made.open_loop.error_95_mm

    @pytest.mark.slow
    def test_more_targets_are_reached_around_an_obstacle(self) -> None:
        errors = Errors(curvature_sd=0.1, roll_sd_deg=10.0, position_noise_mm=0.2, direction_noise_deg=0.5)
        reserve = ReplanSettings(curvature_reserve=0.2)
        plan = planned(with_reserve(BALL, 0.2), AROUND)
        made = study(BALL, AROUND, plan, errors, seeds=MANY, replanning=reserve)
        assert made.closed_loop.reached_share > made.open_loop.reached_share + 0.3
        assert made.closed_loop.outcomes[Outcome.HIT] == 0
        assert made.closed_loop.clearance_mm > 0.0

    def test_a_reserve_lets_a_needle_follow_that_bends_too_little(self) -> None:
        """The plan of the tightest arc is lost from the first millimetre; one with a reserve is not."""
        weak = Errors(curvature_bias=-0.15)
        arrived = []
        for reserve in (0.0, 0.25):
            arc = ArcPath(lps_from_start=START, arcs=np.array([[50.0, 0.0, (1.0 - reserve) * KAPPA]]))
            query = Query(lps_from_start=START, target=arc.frames()[-1][:3, 3])
            kept = ReplanSettings(curvature_reserve=reserve)
            made = simulate(FREE, query, arc, weak, closed_loop=True, seed=1, replanning=kept)
            arrived.append(made)
        assert arrived[0].outcome is not Outcome.REACHED
        assert arrived[1].outcome is Outcome.REACHED
        assert arrived[1].tip_error_mm < 0.2 * arrived[0].tip_error_mm
        assert any(replan.reserve_spent for replan in arrived[1].replans)

    @pytest.mark.slow
    def test_dead_reckoning_tames_a_noisy_tracker(self) -> None:
        noisy = Errors(position_noise_mm=0.6, direction_noise_deg=1.0, target_noise_mm=0.6)
        trusting, careful = (median_errors(noisy, gain=gain).closed_loop for gain in (1.0, 0.3))
        assert careful.median_error_mm < 0.7 * trusting.median_error_mm

    @pytest.mark.parametrize("gain", [1.0, 0.25])
    def test_replans_start_between_dead_reckoning_and_the_measured_tip(self, gain: float) -> None:
        made = run(Errors(curvature_bias=-0.5), closed_loop=True, gain=gain)
        first = made.replans[0].path
        assert first is not None
        _length, roll, curvature = DIRECT.arcs[0]
        reckoned = START @ arc_transform(5.0, roll, curvature)
        true = made.lps_from_tip[int(np.searchsorted(made.inserted_mm, 5.0 - 1e-6))]
        expected = (1.0 - gain) * reckoned[:3, 3] + gain * true[:3, 3]
        assert np.linalg.norm(first.lps_from_start[:3, 3] - expected) < 1e-9
        turned = math.acos(float(first.lps_from_start[:3, 2] @ START[:3, 2]))
        assert turned == pytest.approx((1.0 - 0.5 * gain) * 5.0 * curvature, abs=1e-7)

    def test_where_no_path_is_left_it_stops_before_the_obstacle(self) -> None:
        """The target drifts behind a wall with no way around."""
        canvas = Canvas.empty([-28, -28, -48], [28, 28, 48], 1.0)
        canvas.add(np.abs(canvas.points[..., 2] - 20.0) < 2.0, VESSEL)
        wall = needle_environment(
            canvas.lung(), Needle(diameter_mm=1.0, max_curvature_per_mm=KAPPA), Margins(), with_fissures=False
        )
        query = Query(lps_from_start=START, target=BEHIND)
        made = simulate(wall, query, direct_path(START, BEHIND), Errors(), closed_loop=True, seed=1)
        assert made.outcome is Outcome.NO_PATH
        assert made.clearance_mm > 0.0
        assert made.replans[-1].failure is Failure.NOT_FOUND and made.label == 0

    def test_length_that_runs_out_is_told(self) -> None:
        """The target moves away from a needle that has nothing to spare."""
        short = environment_with(max_length_mm=DIRECT.length_mm + 0.01)
        exact, drifting = ReplanSettings(largest_miss_mm=0.0), Errors(target_drift_mm=4.0)
        made = [
            simulate(
                short, ASIDE, DIRECT, drifting, closed_loop=True, seed=seed, tolerance_mm=0.5,
                replanning=exact,
            )
            for seed in range(6)
        ]  # fmt: skip
        failed = [replan.failure for insertion in made for replan in insertion.replans if replan.path is None]
        assert Failure.OUT_OF_LENGTH in failed
        assert all(insertion.inserted_mm[-1] <= short.needle.max_length_mm + 1e-9 for insertion in made)


class TestStudy:
    """Counting."""

    def test_open_and_closed_loop_are_the_same_needles(self) -> None:
        made = study(FREE, ASIDE, DIRECT, Errors(target_walk_mm=1.0), seeds=[3, 4], iterations=50)
        pairs = zip(made.open_loop.insertions, made.closed_loop.insertions, strict=True)
        for blind, seeing in pairs:
            assert np.linalg.norm(blind.target_lps - seeing.target_lps) < 0.3

    def test_a_summary_counts(self) -> None:
        made = median_errors(Errors(curvature_sd=0.1)).open_loop
        errors = [insertion.tip_error_mm for insertion in made.insertions]
        assert sum(made.outcomes.values()) == len(MANY)
        assert made.outcomes[Outcome.REACHED] == sum(error <= 2.0 for error in errors)
        assert made.reached_share == made.outcomes[Outcome.REACHED] / len(MANY)
        assert made.reached_low < made.reached_share < made.reached_high
        assert made.median_error_mm == pytest.approx(float(np.median(errors)))
        assert made.clearance_mm == min(insertion.clearance_mm for insertion in made.insertions)

    def test_nothing_is_no_study(self) -> None:
        with pytest.raises(SettingsError):
            summary([])
