"""Replanning: from any pose, within all limits counted from the first start, or an honest refusal."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from anatomy.base.errors import FrameError, SettingsError
from anatomy.base.typed import Float
from stages.needle.objective import Objective
from stages.needle.path import ArcPath, arc_transform, blocker_on_path, direct_path
from stages.needle.replanning.reaiming import LEAST_GAIN, Attempts, Root, Source
from stages.needle.replanning.replanner import Failure, ReplanSettings, with_reserve
from stages.needle.search.base import root_of
from tests.stages.needle.replanning.around_a_ball import (
    BALL_MM,
    BESIDE,
    KAPPA,
    START,
    TARGET,
    angle_from,
    around_the_ball,
    ball_environment,
    clearances,
    frame_at,
    query,
    replanner,
    require,
    straight,
    with_ball,
)


class TestFound:
    """What a replan is when there is one."""

    @given(
        aside=st.tuples(*[st.floats(-2.0, 2.0)] * 2),
        lean=st.tuples(*[st.floats(-0.25, 0.25)] * 2),
        share=st.floats(0.0, 0.9),
        moved=st.tuples(*[st.floats(-2.0, 2.0)] * 3),
    )
    @hypothesis_settings(max_examples=40)
    def test_is_clear_within_the_limits_and_ends_at_the_target(
        self, aside: Any, lean: Any, share: float, moved: Any
    ) -> None:
        environment = with_ball()
        plan = around_the_ball()
        done = share * plan.length_mm
        points, lengths = plan.sample(0.1)
        at = int(np.searchsorted(lengths, done))
        ahead = points[min(at + 1, len(points) - 1)] - points[max(at - 1, 0)]
        tip = frame_at(points[at] + [*aside, 0.0], ahead / np.linalg.norm(ahead) + [*lean, 0.0])
        target = TARGET + moved
        found = replanner(environment, query(), plan, iterations=300).replan(tip, target, done)
        if found.path is None:
            assert found.failure is not None and found.why and found.source is None
            return
        path, needle = found.path, environment.needle
        assert found.failure is None and found.why == ""
        end = path.frames()[-1][:3, 3]
        assert np.array_equal(path.lps_from_start, tip)
        assert found.miss_mm == pytest.approx(float(np.linalg.norm(end - target)), abs=1e-9)
        assert found.miss_mm < (1e-6 if found.source not in (Source.NEAREST, Source.ARRIVED) else 1.0)
        if found.source is Source.ARRIVED:
            return
        assert path.arcs[:, 2].max() <= needle.max_curvature_per_mm * (1 + 1e-9)
        assert done + path.length_mm <= needle.max_length_mm + 1e-9
        assert angle_from(START[:3, 2], path) <= math.radians(needle.max_angle_from_start_deg) + 1e-4
        gap, lengths = clearances(environment, path)
        beyond = lengths > found.relaxed_mm + 1e-9
        assert gap[beyond].min(initial=9.0) >= environment.required_clearance_mm - 1e-6
        assert (
            gap.min() >= min(environment.required_clearance_mm, found.relaxed_clearance_mm or math.inf) - 1e-6
        )

    def test_the_rest_of_the_plan_is_steered_through_its_own_corners(self) -> None:
        turns = [[14.0, 0.3, 0.4 * KAPPA], [14.0, 2.0, 0.5 * KAPPA], [14.0, -2.0, 0.3 * KAPPA]]
        plan = ArcPath(lps_from_start=BESIDE, arcs=np.array(turns))
        *corners, target = plan.frames()[1:, :3, 3]
        tip = ArcPath(lps_from_start=BESIDE, arcs=np.array([[4.0, 0.3, 0.4 * KAPPA]])).frames()[-1]
        tip[:3, 3] += [0.3, -0.2, 0.0]
        found = replanner(with_ball(), query(BESIDE, target), plan).replan(tip, target, 4.0)
        path = require(found)
        assert found.source is Source.REST
        points, _ = path.sample(0.005)
        for corner in corners:
            assert np.linalg.norm(points - corner, axis=1).min() < 0.005

    def test_a_corner_that_lies_behind_is_not_steered_through(self) -> None:
        """3 mm beyond the first corner, only the second counts."""
        turns = [[14.0, 0.3, 0.4 * KAPPA], [14.0, 2.0, 0.5 * KAPPA], [14.0, -2.0, 0.3 * KAPPA]]
        plan = ArcPath(lps_from_start=BESIDE, arcs=np.array(turns))
        _first, corner, end = plan.frames()[1:]
        tip = plan.frames()[1] @ arc_transform(3.0, *turns[1][1:])
        found = replanner(with_ball(), query(BESIDE, end[:3, 3]), plan).replan(tip, end[:3, 3], 17.0)
        path = require(found)
        assert found.source is Source.REST and len(path.arcs) == 2
        assert np.allclose(path.frames()[1][:3, 3], corner[:3, 3], atol=1e-9)

    def test_without_corners_it_is_the_single_arc(self) -> None:
        plan = direct_path(BESIDE, TARGET + [9.0, 0.0, 0.0])
        tip = frame_at([12.5, 0.5, -18.0], [0.02, 0.0, 1.0])
        target = TARGET + [9.0, 1.0, 0.0]
        found = replanner(with_ball(), query(BESIDE, target), plan).replan(tip, target, 10.0)
        path = require(found)
        assert found.source is Source.DIRECT
        assert np.allclose(path.arcs, direct_path(tip, target).arcs, atol=1e-9)

    def test_the_replan_becomes_the_plan(self) -> None:
        again = replanner(with_ball(), query(), around_the_ball())
        tip = frame_at([0.5, 0.0, -26.0])
        path = require(again.replan(tip, TARGET, 2.0))
        assert again.plan is path
        failed = again.replan(frame_at([0.0, 0.0, 0.0]), TARGET, 4.0)
        assert failed.path is None and again.plan is path

    def test_the_search_goes_around_where_the_plan_does_not(self) -> None:
        environment = with_ball()
        blocked = straight(START, 56.0)
        none = replanner(environment, query(), blocked, iterations=0).replan(START, TARGET, 0.0)
        assert none.failure is Failure.NOT_FOUND
        found = replanner(environment, query(), blocked, iterations=4000).replan(START, TARGET, 0.0)
        assert found.source is Source.SEARCH
        assert blocker_on_path(environment, require(found), -1) == 0

    @pytest.mark.parametrize("objective", [Objective(length=1.0), Objective(inverse_clearance=1.0)])
    def test_the_search_never_makes_it_dearer(self, objective: Objective) -> None:
        environment, plan = with_ball(), around_the_ball()
        for seed in range(5):
            tip = np.array(START)
            tip[:3, 3] += np.random.default_rng(seed).normal(0.0, 0.5, 3)
            costs = [
                replanner(environment, query(), plan, iterations=n, seed=seed, objective=objective)
                .replan(tip, TARGET, 0.0)
                .cost
                for n in (0, 1000)
            ]
            assert costs[1] <= costs[0]

    def test_a_way_is_kept_unless_another_one_is_clearly_cheaper(self) -> None:
        """The arc and straight to a point a little aside is shorter, but by less than the gain asked for."""
        target = TARGET + [12.0, 6.0, 0.0]
        found = replanner(with_ball(), query(BESIDE, target)).replan(BESIDE, target, 0.0)
        attempts = Attempts(
            with_ball(), Objective(length=1.0).arrays(None, 1.0), Root(query=query(BESIDE, target))
        )
        attempts.by_legs()
        assert found.source is Source.DIRECT
        assert (1.0 - LEAST_GAIN) * found.cost < attempts.cost < found.cost

    def test_the_same_calls_give_the_same_replans(self) -> None:
        def run(seed: int) -> list[Float]:
            made = replanner(with_ball(), query(), straight(START, 56.0), seed=seed, iterations=4000)
            tips = [START, frame_at([0.3, 0.1, -24.0]), frame_at([1.0, -0.2, -20.0], [0.1, 0.0, 1.0])]
            return [require(made.replan(tip, TARGET, 4.0 * n)).arcs for n, tip in enumerate(tips)]

        first, again, other = run(1), run(1), run(2)
        assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
        assert any(a.shape != b.shape or not np.array_equal(a, b) for a, b in zip(first, other, strict=True))

    def test_a_goal_tolerance_is_used_only_where_the_target_cannot_be_met(self) -> None:
        environment = ball_environment(goal_tolerance_mm=1.5)
        target = TARGET + [12.0, 0.0, 0.0]
        found = replanner(environment, query(BESIDE, target)).replan(BESIDE, target, 0.0)
        assert found.miss_mm < 1e-6
        near = BESIDE[:3, 3] + [1.0, 0.0, 5.0]
        found = replanner(environment, query(BESIDE, near)).replan(BESIDE, near, 0.0)
        assert 0.1 < found.miss_mm <= 1.5

    def test_a_tip_at_the_target_has_arrived(self) -> None:
        found = replanner(with_ball(), query(BESIDE)).replan(BESIDE, BESIDE[:3, 3], 5.0)
        assert found.source is Source.ARRIVED
        assert len(require(found).arcs) == 0 and found.cost == 0.0


class TestReserve:
    """Some curvature is kept back for errors."""

    def test_a_space_with_a_reserve(self) -> None:
        held = with_reserve(with_ball(), 0.25)
        assert held.needle.max_curvature_per_mm == pytest.approx(0.75 * KAPPA)
        assert with_ball().needle.max_curvature_per_mm == KAPPA
        with pytest.raises(SettingsError):
            with_reserve(with_ball(), 1.0)

    @pytest.mark.parametrize(("share", "spent"), [(0.7, False), (0.9, True)])
    def test_is_spent_only_where_it_is_needed(self, share: float, spent: bool) -> None:
        arc = ArcPath(lps_from_start=BESIDE, arcs=np.array([[25.0, 0.0, share * KAPPA]]))
        target = arc.frames()[-1][:3, 3]
        settings = ReplanSettings(curvature_reserve=0.2)
        found = replanner(with_ball(), query(BESIDE), settings=settings).replan(BESIDE, target, 0.0)
        assert found.reserve_spent == spent
        assert (require(found).arcs[:, 2].max() > 0.8 * KAPPA * (1 + 1e-9)) == spent

    @pytest.mark.parametrize("seed", range(4))
    def test_is_kept_by_the_search(self, seed: int) -> None:
        """Around the ball there are paths that bend less."""
        settings = ReplanSettings(curvature_reserve=0.15)
        made = replanner(with_ball(), query(), settings=settings, seed=seed, iterations=8000)
        found = made.replan(START, TARGET, 0.0)
        assert found.source is Source.SEARCH and not found.reserve_spent


class TestRefused:
    """Why there is no path."""

    def test_a_target_just_out_of_reach_is_missed_by_little(self) -> None:
        arc = ArcPath(lps_from_start=BESIDE, arcs=np.array([[10.0, 0.0, KAPPA]]))
        end = arc.frames()[-1]
        aside = end[:3, 3] + 0.5 * end[:3, 0]
        near = replanner(with_ball(), query(BESIDE)).replan(BESIDE, aside, 0.0)
        assert near.source is Source.NEAREST
        assert near.miss_mm == pytest.approx(0.5, abs=1e-6)
        strict = ReplanSettings(largest_miss_mm=0.0)
        refused = replanner(with_ball(), query(BESIDE), settings=strict).replan(BESIDE, aside, 0.0)
        assert refused.failure is Failure.OUT_OF_REACH

    def test_a_tip_that_passed_its_target_stays_if_it_is_near_enough(self) -> None:
        behind = BESIDE[:3, 3] - [0.0, 0.0, 0.7]
        found = replanner(with_ball(), query(BESIDE)).replan(BESIDE, behind, 0.0)
        assert found.source is Source.ARRIVED and found.miss_mm == pytest.approx(0.7)
        far = replanner(with_ball(), query(BESIDE)).replan(BESIDE, behind - [0.0, 0.0, 1.0], 0.0)
        assert far.failure is Failure.OUT_OF_REACH

    def test_a_target_too_near_to_an_obstacle(self) -> None:
        at_ball = np.array([BALL_MM + 0.6, 0.0, 0.0])
        found = replanner(with_ball(), query(BESIDE)).replan(BESIDE, at_ball, 0.0)
        assert found.failure is Failure.TARGET_BLOCKED
        assert "vessel" in found.why

    def test_wrong_settings(self) -> None:
        with pytest.raises(SettingsError, match="iterations"):
            replanner(with_ball(), query(), iterations=-1)
        for wrong in ({"curvature_reserve": 1.0}, {"relaxed_mm": -1.0}, {"largest_miss_mm": math.nan}):
            with pytest.raises(SettingsError):
                ReplanSettings(**wrong)
        with pytest.raises(FrameError):
            replanner(with_ball(), query()).replan(np.zeros((4, 4)), TARGET, 0.0)


def test_the_root_of_a_needle_at_its_start_is_its_pose() -> None:
    row = root_of(query())
    assert np.array_equal(row[:6], [0, 0, -28, 0, 0, 1]) and not row[6:].any()
