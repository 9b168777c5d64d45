"""Replanning: from any pose, within all limits counted from the first start, or an honest refusal."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from anatomy.errors import FrameError, SettingsError
from anatomy.margins import Margins
from anatomy.poses import pose, roll_towards
from anatomy.structures import OBSTACLES, VESSEL
from anatomy.typed import Float
from stages.needle.device import Needle
from stages.needle.environment import NeedleEnvironment, needle_environment
from stages.needle.kernels import tree
from stages.needle.objective import Objective
from stages.needle.path import ArcPath, arc_transform, blocker_on_path, direct_path
from stages.needle.query import Query
from stages.needle.replanning.reaiming import LEAST_GAIN, Attempts, Root, Source
from stages.needle.replanning.replanner import Failure, Replan, Replanner, ReplanSettings, with_reserve
from stages.needle.search.base import RestartingRRT, root_of
from tests.stages.scenes import Canvas, brute_clearance, line_tree

KAPPA = 1 / 40
BALL_MM = 4.0
CURVED_RAD = 0.6


def ball_environment(goal_tolerance_mm: float = 0.0, **changes: float) -> NeedleEnvironment:
    """Free lung with a vessel ball in the middle of the way from (0, 0, -28) to (0, 0, 28)."""
    canvas = Canvas.empty([-32, -32, -32], [32, 32, 32], 1.0)
    canvas.add(canvas.ball([0, 0, 0], BALL_MM), VESSEL)
    values: dict[str, float] = {"diameter_mm": 1.0, "max_curvature_per_mm": KAPPA, **changes}
    return needle_environment(
        canvas.lung(), Needle(**values), Margins(), with_fissures=False, goal_tolerance_mm=goal_tolerance_mm
    )


def frame_at(place: Any, forward: Any = (0.0, 0.0, 1.0)) -> Float:
    return np.array(pose(place, forward))


START = frame_at([0.0, 0.0, -28.0])
BESIDE = frame_at([12.0, 0.0, -28.0])
"""From here the way ahead is free."""
TARGET = np.array([0.0, 0.0, 28.0])


def query(start: Float = START, target: Any = TARGET, **more: Any) -> Query:
    return Query(lps_from_start=start, target=np.asarray(target, dtype=float), **more)


def around_the_ball(environment: NeedleEnvironment) -> ArcPath:
    search = RestartingRRT(environment, query(), seed=2)
    search.advance(20_000)
    assert search.path is not None
    return search.path


def straight(start: Float, length: float) -> ArcPath:
    return ArcPath(lps_from_start=start, arcs=np.array([[length, 0.0, 0.0]]))


def replanner(
    environment: NeedleEnvironment, asked: Query, plan: ArcPath | None = None, **more: Any
) -> Replanner:
    """Return a replanner whose plan, by default, goes straight on."""
    return Replanner(environment, asked, plan or straight(asked.lps_from_start, 10.0), **more)


def require(replan: Replan) -> ArcPath:
    assert replan.path is not None, replan.why
    return replan.path


def angle_from(direction: Float, path: ArcPath) -> float:
    """Return the largest angle, in radians, between a direction and samples of a path's directions."""
    points, _ = path.sample(0.01)
    ways = np.diff(points, axis=0)
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    return float(np.arccos(np.clip(ways @ direction, -1.0, 1.0)).max())


def clearances(environment: NeedleEnvironment, path: ArcPath) -> tuple[Float, Float]:
    points, lengths = path.sample(0.05)
    return brute_clearance(environment.obstacles.labels, environment.grid, points, OBSTACLES, 6.0), lengths


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
        environment = ENVIRONMENTS["ball"]
        plan = PLANS["ball"]
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
        found = replanner(ENVIRONMENTS["ball"], query(BESIDE, target), plan).replan(tip, target, 4.0)
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
        found = replanner(ENVIRONMENTS["ball"], query(BESIDE, end[:3, 3]), plan).replan(tip, end[:3, 3], 17.0)
        path = require(found)
        assert found.source is Source.REST and len(path.arcs) == 2
        assert np.allclose(path.frames()[1][:3, 3], corner[:3, 3], atol=1e-9)

    def test_without_corners_it_is_the_single_arc(self) -> None:
        plan = direct_path(BESIDE, TARGET + [9.0, 0.0, 0.0])
        tip = frame_at([12.5, 0.5, -18.0], [0.02, 0.0, 1.0])
        target = TARGET + [9.0, 1.0, 0.0]
        found = replanner(ENVIRONMENTS["ball"], query(BESIDE, target), plan).replan(tip, target, 10.0)
        path = require(found)
        assert found.source is Source.DIRECT
        assert np.allclose(path.arcs, direct_path(tip, target).arcs, atol=1e-9)

    def test_the_replan_becomes_the_plan(self) -> None:
        again = replanner(ENVIRONMENTS["ball"], query(), PLANS["ball"])
        tip = frame_at([0.5, 0.0, -26.0])
        path = require(again.replan(tip, TARGET, 2.0))
        assert again.plan is path
        failed = again.replan(frame_at([0.0, 0.0, 0.0]), TARGET, 4.0)
        assert failed.path is None and again.plan is path

    def test_the_search_goes_around_where_the_plan_does_not(self) -> None:
        environment = ENVIRONMENTS["ball"]
        blocked = straight(START, 56.0)
        none = replanner(environment, query(), blocked, iterations=0).replan(START, TARGET, 0.0)
        assert none.failure is Failure.NOT_FOUND
        found = replanner(environment, query(), blocked, iterations=4000).replan(START, TARGET, 0.0)
        assert found.source is Source.SEARCH
        assert blocker_on_path(environment, require(found), -1) == 0

    @pytest.mark.parametrize("objective", [Objective(length=1.0), Objective(inverse_clearance=1.0)])
    def test_the_search_never_makes_it_dearer(self, objective: Objective) -> None:
        environment, plan = ENVIRONMENTS["ball"], PLANS["ball"]
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
        found = replanner(ENVIRONMENTS["ball"], query(BESIDE, target)).replan(BESIDE, target, 0.0)
        attempts = Attempts(
            ENVIRONMENTS["ball"], Objective(length=1.0).arrays(None), Root(query=query(BESIDE, target))
        )
        attempts.by_legs()
        assert found.source is Source.DIRECT
        assert (1.0 - LEAST_GAIN) * found.cost < attempts.cost < found.cost

    def test_the_same_calls_give_the_same_replans(self) -> None:
        def run(seed: int) -> list[Float]:
            made = replanner(ENVIRONMENTS["ball"], query(), straight(START, 56.0), seed=seed, iterations=4000)
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
        found = replanner(ENVIRONMENTS["ball"], query(BESIDE)).replan(BESIDE, BESIDE[:3, 3], 5.0)
        assert found.source is Source.ARRIVED
        assert len(require(found).arcs) == 0 and found.cost == 0.0


class TestCarriedOver:
    """Limits count from the first start, not from the tip."""

    def test_length_already_inserted(self) -> None:
        """Of 100 mm, 80 are inserted: 20 are left."""
        environment = ball_environment(max_length_mm=100.0)
        asked = query(BESIDE, TARGET)
        tip = frame_at([12.0, 0.0, 0.0])

        def to(distance: float) -> Replan:
            return replanner(environment, asked).replan(tip, tip[:3, 3] + [0.0, 0.0, distance], 80.0)

        assert require(to(19.9)).length_mm == pytest.approx(19.9)
        assert to(20.1).failure is Failure.OUT_OF_LENGTH
        assert "20.1 mm ahead, 20.0 mm are left" in to(20.1).why
        spent = replanner(environment, asked).replan(tip, TARGET, 100.0)
        assert spent.failure is Failure.OUT_OF_LENGTH

    def test_turn_already_accumulated(self) -> None:
        environment = ball_environment(max_accumulated_turn_deg=60.0)
        aside = BESIDE[:3, 3] + [6.0, 0.0, 20.0]
        needed = float(direct_path(BESIDE, aside).accumulated_turn_rad)
        limit = math.radians(60.0)

        def with_turn(turned: float) -> Replan:
            made = replanner(environment, query(BESIDE, aside))
            return made.replan(BESIDE, aside, 10.0, turned_rad=turned)

        assert with_turn(limit - needed - 1e-6).path is not None
        refused = with_turn(limit - 0.5 * needed)
        assert refused.failure is Failure.OUT_OF_REACH and "of turning left" in refused.why

    def test_the_turn_of_the_plans_so_far_is_known(self) -> None:
        """Half of an arc of 0.8 rad is behind the needle; then half of the replan, too."""
        environment = ball_environment(max_accumulated_turn_deg=math.degrees(1.0))
        plan = ArcPath(lps_from_start=BESIDE, arcs=np.array([[32.0, 0.0, KAPPA]]))
        made = replanner(environment, query(BESIDE), plan)
        halfway = ArcPath(lps_from_start=BESIDE, arcs=np.array([[16.0, 0.0, KAPPA]])).frames()[-1]
        end = plan.frames()[-1][:3, 3]
        require(made.replan(halfway, end, 16.0))
        later = ArcPath(lps_from_start=BESIDE, arcs=np.array([[24.0, 0.0, KAPPA]])).frames()[-1]
        to = ArcPath(lps_from_start=later, arcs=np.array([[15.0, 0.0, KAPPA]])).frames()[-1][:3, 3]
        assert made.replan(later, to, 24.0).path is not None, "0.4 + 0.2 + 0.375 rad"
        to = ArcPath(lps_from_start=later, arcs=np.array([[17.0, 0.0, KAPPA]])).frames()[-1][:3, 3]
        assert made.replan(later, to, 24.0).failure is Failure.OUT_OF_REACH, "0.4 + 0.2 + 0.425 rad"

    @pytest.mark.parametrize("side", [1.0, -1.0])
    def test_the_angle_counts_from_the_first_direction(self, side: float) -> None:
        """The tip has turned by 0.6 rad; it may turn back by as much as it likes, but not on."""
        environment = ball_environment(max_angle_from_start_deg=math.degrees(0.8))
        start = frame_at([12.0, 0.0, -20.0])
        tip = frame_at([16.0, 0.0, -10.0], [math.sin(CURVED_RAD), 0.0, math.cos(CURVED_RAD)])
        roll = roll_towards(tip, [side, 0.0, 0.0])
        arc = ArcPath(lps_from_start=tip, arcs=np.array([[12.0, roll, KAPPA]]))
        target = arc.frames()[-1][:3, 3]
        found = replanner(environment, query(start)).replan(tip, target, 15.0)
        fresh = replanner(environment, query(tip)).replan(tip, target, 15.0)
        assert fresh.path is not None, "counted from the tip, 0.3 rad are allowed to both sides"
        assert (found.path is not None) == (side < 0)
        if found.path is not None:
            assert angle_from(start[:3, 2], found.path) <= 0.8 + 1e-4

    def test_searches_count_from_the_reference(self) -> None:
        """The tip leans by 0.5 rad: around the ball it may lean to one side only."""
        environment = ball_environment(max_angle_from_start_deg=math.degrees(0.9))
        reference = np.array([math.sin(0.5), 0.0, math.cos(0.5)])
        asked = query(inserted_mm=12.0, turned_rad=0.5, reference=reference)
        search = RestartingRRT(environment, asked)
        for _ in range(20):
            search.advance(1000)
        assert search.path is not None
        assert angle_from(reference, search.path) <= 0.9 + 1e-4
        rows = search.nodes[: search.count]
        assert rows[0, tree.PATH_LENGTH] == 12.0 and rows[0, tree.PATH_TURN] == 0.5

    def test_a_reference_along_the_start_changes_nothing(self) -> None:
        plain = RestartingRRT(ENVIRONMENTS["ball"], query())
        stated = RestartingRRT(ENVIRONMENTS["ball"], query(reference=np.array([0.0, 0.0, 2.0])))
        for search in (plain, stated):
            search.advance(500)
        assert plain.path is not None and stated.path is not None
        assert np.array_equal(plain.path.arcs, stated.path.arcs)

    def test_the_exemption_is_used_up(self) -> None:
        """Inside the pierced wall at 2 mm of needle that is allowed, at 6 mm it is not."""
        canvas = Canvas.empty([-12, -12, -12], [12, 12, 24], 0.5)
        a, b = [-10.0, 0.0, 0.0], [10.0, 0.0, 0.0]
        canvas.airway(canvas.capsule(a, b, 2.0), canvas.capsule(a, b, 4.0), 0)
        lung = canvas.lung(line_tree(a, b, 2.0))
        needle = Needle(diameter_mm=0.8, max_curvature_per_mm=KAPPA, exit_exemption_mm=5.0)
        environment = needle_environment(lung, needle, Margins(), with_fissures=False)
        start, tip = frame_at([0.0, 0.0, 1.0]), frame_at([0.0, 0.0, 3.2])
        target = np.array([0.0, 0.0, 15.0])
        made = replanner(environment, query(start, target, branch=0), straight(start, 14.0))
        assert made.replan(tip, target, 2.2).path is not None
        late = made.replan(tip, target, 6.0)
        assert late.failure is Failure.TOUCHES and "airway" in late.why

    def test_a_query_on_its_way_is_checked(self) -> None:
        for wrong in ({"inserted_mm": -1.0}, {"turned_rad": math.nan}):
            with pytest.raises(SettingsError):
                query(**wrong)
        for reference in (np.zeros(3), np.array([1.0, math.inf, 0.0]), np.ones(2)):
            with pytest.raises(FrameError):
                query(reference=reference)


class TestLostClearance:
    """The tip is nearer to the ball than required."""

    def near(self, gap_mm: float, lean: float = 0.0) -> Float:
        """Return a tip beside the ball, `gap_mm` from the face of its outermost voxel, leaning towards it."""
        return frame_at([BALL_MM + gap_mm, 0.5, 0.5], [-math.sin(lean), 0.0, math.cos(lean)])

    def test_the_way_out_keeps_what_is_left_and_regains_what_is_required(self) -> None:
        environment = ENVIRONMENTS["ball"]
        radius, required = environment.needle.radius_mm, environment.required_clearance_mm
        tip = self.near(0.5 * (radius + required))
        target = np.array([4.0, 0.0, 28.0])
        found = replanner(environment, query()).replan(tip, target, 28.0)
        path = require(found)
        assert 0.0 < found.relaxed_mm <= 5.0
        assert radius <= found.relaxed_clearance_mm < required
        gap, lengths = clearances(environment, path)
        assert gap[0] < required
        assert gap.min() >= found.relaxed_clearance_mm - 1e-6
        assert gap[lengths > found.relaxed_mm].min() >= required - 1e-6

    def test_the_way_out_counts_as_length(self) -> None:
        target = np.array([4.0, 0.0, 28.0])
        tip = self.near(0.75)
        length = require(replanner(ENVIRONMENTS["ball"], query()).replan(tip, target, 28.0)).length_mm
        short = ball_environment(max_length_mm=28.0 + length - 0.02)
        found = replanner(short, query()).replan(tip, target, 28.0)
        assert found.path is None or 28.0 + found.path.length_mm <= short.needle.max_length_mm

    def test_towards_the_obstacle_there_is_no_way_out(self) -> None:
        found = replanner(ENVIRONMENTS["ball"], query()).replan(self.near(0.55, lean=1.2), TARGET, 28.0)
        assert found.path is None and found.failure is Failure.STUCK
        assert "vessel" in found.why

    def test_nor_without_length_for_it(self) -> None:
        made = replanner(ENVIRONMENTS["ball"], query(), settings=ReplanSettings(relaxed_mm=0.0))
        assert made.replan(self.near(0.75), TARGET, 28.0).failure is Failure.STUCK

    def test_a_needle_that_touches_is_not_moved(self) -> None:
        found = replanner(ENVIRONMENTS["ball"], query()).replan(self.near(0.45), TARGET, 28.0)
        assert found.failure is Failure.TOUCHES
        assert "0.45 mm from vessel" in found.why

    def test_the_search_starts_at_the_way_out(self) -> None:
        """A second ball beside the start, and the first one in the way."""
        canvas = Canvas.empty([-32, -32, -32], [32, 32, 32], 1.0)
        canvas.add(canvas.ball([0, 0, 0], BALL_MM) | canvas.ball([4.5, 0.5, -26.5], 3.2), VESSEL)
        needle = Needle(diameter_mm=1.0, max_curvature_per_mm=KAPPA)
        environment = needle_environment(canvas.lung(), needle, Margins(), with_fissures=False)
        tip = frame_at([0.2, 0.5, -28.0])
        unsearched = replanner(environment, query(tip), iterations=0).replan(tip, TARGET, 0.0)
        assert unsearched.failure is Failure.NOT_FOUND
        found = replanner(environment, query(tip), iterations=6000).replan(tip, TARGET, 0.0)
        assert found.source is Source.SEARCH and found.relaxed_mm > 0.0
        gap, lengths = clearances(environment, require(found))
        assert gap[0] < environment.required_clearance_mm
        assert gap.min() >= found.relaxed_clearance_mm - 1e-6
        assert gap[lengths > found.relaxed_mm].min() >= environment.required_clearance_mm - 1e-6
        assert found.miss_mm < 1e-6


class TestReserve:
    """Some curvature is kept back for errors."""

    def test_a_space_with_a_reserve(self) -> None:
        held = with_reserve(ENVIRONMENTS["ball"], 0.25)
        assert held.needle.max_curvature_per_mm == pytest.approx(0.75 * KAPPA)
        assert ENVIRONMENTS["ball"].needle.max_curvature_per_mm == KAPPA
        with pytest.raises(SettingsError):
            with_reserve(ENVIRONMENTS["ball"], 1.0)

    @pytest.mark.parametrize(("share", "spent"), [(0.7, False), (0.9, True)])
    def test_is_spent_only_where_it_is_needed(self, share: float, spent: bool) -> None:
        arc = ArcPath(lps_from_start=BESIDE, arcs=np.array([[25.0, 0.0, share * KAPPA]]))
        target = arc.frames()[-1][:3, 3]
        settings = ReplanSettings(curvature_reserve=0.2)
        found = replanner(ENVIRONMENTS["ball"], query(BESIDE), settings=settings).replan(BESIDE, target, 0.0)
        assert found.reserve_spent == spent
        assert (require(found).arcs[:, 2].max() > 0.8 * KAPPA * (1 + 1e-9)) == spent

    @pytest.mark.parametrize("seed", range(4))
    def test_is_kept_by_the_search(self, seed: int) -> None:
        """Around the ball there are paths that bend less."""
        settings = ReplanSettings(curvature_reserve=0.15)
        made = replanner(ENVIRONMENTS["ball"], query(), settings=settings, seed=seed, iterations=8000)
        found = made.replan(START, TARGET, 0.0)
        assert found.source is Source.SEARCH and not found.reserve_spent


class TestRefused:
    """Why there is no path."""

    def test_a_target_just_out_of_reach_is_missed_by_little(self) -> None:
        arc = ArcPath(lps_from_start=BESIDE, arcs=np.array([[10.0, 0.0, KAPPA]]))
        end = arc.frames()[-1]
        aside = end[:3, 3] + 0.5 * end[:3, 0]
        near = replanner(ENVIRONMENTS["ball"], query(BESIDE)).replan(BESIDE, aside, 0.0)
        assert near.source is Source.NEAREST
        assert near.miss_mm == pytest.approx(0.5, abs=1e-6)
        strict = ReplanSettings(largest_miss_mm=0.0)
        refused = replanner(ENVIRONMENTS["ball"], query(BESIDE), settings=strict).replan(BESIDE, aside, 0.0)
        assert refused.failure is Failure.OUT_OF_REACH

    def test_a_tip_that_passed_its_target_stays_if_it_is_near_enough(self) -> None:
        behind = BESIDE[:3, 3] - [0.0, 0.0, 0.7]
        found = replanner(ENVIRONMENTS["ball"], query(BESIDE)).replan(BESIDE, behind, 0.0)
        assert found.source is Source.ARRIVED and found.miss_mm == pytest.approx(0.7)
        far = replanner(ENVIRONMENTS["ball"], query(BESIDE)).replan(BESIDE, behind - [0.0, 0.0, 1.0], 0.0)
        assert far.failure is Failure.OUT_OF_REACH

    def test_a_target_too_near_to_an_obstacle(self) -> None:
        at_ball = np.array([BALL_MM + 0.6, 0.0, 0.0])
        found = replanner(ENVIRONMENTS["ball"], query(BESIDE)).replan(BESIDE, at_ball, 0.0)
        assert found.failure is Failure.TARGET_BLOCKED
        assert "vessel" in found.why

    def test_wrong_settings(self) -> None:
        with pytest.raises(SettingsError, match="iterations"):
            replanner(ENVIRONMENTS["ball"], query(), iterations=-1)
        for wrong in ({"curvature_reserve": 1.0}, {"relaxed_mm": -1.0}, {"largest_miss_mm": math.nan}):
            with pytest.raises(SettingsError):
                ReplanSettings(**wrong)
        with pytest.raises(FrameError):
            replanner(ENVIRONMENTS["ball"], query()).replan(np.zeros((4, 4)), TARGET, 0.0)


def test_the_root_of_a_needle_at_its_start_is_its_pose() -> None:
    row = root_of(query())
    assert np.array_equal(row[:6], [0, 0, -28, 0, 0, 1]) and not row[6:].any()


ENVIRONMENTS = {"ball": ball_environment()}
PLANS = {"ball": around_the_ball(ENVIRONMENTS["ball"])}
