"""What a replanner keeps of the plan in hand, and where clearance is lost."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anatomy.base.errors import FrameError, SettingsError
from anatomy.base.typed import Float
from anatomy.margins import Margins
from anatomy.poses import roll_towards
from anatomy.structures import VESSEL
from stages.needle.device import Needle
from stages.needle.environment import needle_environment
from stages.needle.kernels import tree
from stages.needle.path import ArcPath, direct_path
from stages.needle.replanning.reaiming import Source
from stages.needle.replanning.replanner import Failure, Replan, ReplanSettings
from stages.needle.search.base import RestartingRRT
from tests.stages.needle.replanning.around_a_ball import (
    BALL_MM,
    BESIDE,
    CURVED_RAD,
    KAPPA,
    TARGET,
    angle_from,
    ball_environment,
    clearances,
    frame_at,
    query,
    replanner,
    require,
    straight,
    with_ball,
)
from tests.stages.scenes import Canvas, line_tree


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
        plain = RestartingRRT(with_ball(), query())
        stated = RestartingRRT(with_ball(), query(reference=np.array([0.0, 0.0, 2.0])))
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
        environment = with_ball()
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
        length = require(replanner(with_ball(), query()).replan(tip, target, 28.0)).length_mm
        short = ball_environment(max_length_mm=28.0 + length - 0.02)
        found = replanner(short, query()).replan(tip, target, 28.0)
        assert found.path is None or 28.0 + found.path.length_mm <= short.needle.max_length_mm

    def test_towards_the_obstacle_there_is_no_way_out(self) -> None:
        found = replanner(with_ball(), query()).replan(self.near(0.55, lean=1.2), TARGET, 28.0)
        assert found.path is None and found.failure is Failure.STUCK
        assert "vessel" in found.why

    def test_nor_without_length_for_it(self) -> None:
        made = replanner(with_ball(), query(), settings=ReplanSettings(relaxed_mm=0.0))
        assert made.replan(self.near(0.75), TARGET, 28.0).failure is Failure.STUCK

    def test_a_needle_that_touches_is_not_moved(self) -> None:
        found = replanner(with_ball(), query()).replan(self.near(0.45), TARGET, 28.0)
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
