"""The needle's workspace against dense families of curves."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stages.needle.kernels import connections, goal_ball
from stages.needle.path import ArcPath
from tests.stages.needle.needles import RADIUS, limits_of


class TestWorkspace:
    """The set of points that the needle reaches in free space."""

    def test_straight_ahead(self) -> None:
        assert goal_ball.workspace_length(0.0, 40.0, limits_of()) == 40.0
        assert goal_ball.workspace_length(0.0, 0.0, limits_of()) == 0.0

    def test_quarter_circle(self) -> None:
        assert goal_ball.workspace_length(RADIUS, RADIUS, limits_of()) == pytest.approx(math.pi * RADIUS / 2)

    @pytest.mark.parametrize("limit", ["max_angle_rad", "max_turn_rad"])
    def test_either_turning_limit_cuts_the_quarter_circle_off(self, limit: str) -> None:
        assert (
            goal_ball.workspace_length(RADIUS, RADIUS, limits_of(**{limit: math.radians(89.9)})) == math.inf
        )

    def test_length_limit(self) -> None:
        quarter = math.pi * RADIUS / 2
        within, beyond = limits_of(max_length_mm=quarter + 1e-6), limits_of(max_length_mm=quarter - 1e-6)
        assert goal_ball.workspace_length(RADIUS, RADIUS, within) < math.inf
        assert goal_ball.workspace_length(RADIUS, RADIUS, beyond) == math.inf
        assert goal_ball.workspace_length(0.0, 40.0, limits_of(max_length_mm=39.9)) == math.inf

    def test_quarter_circle_then_straight(self) -> None:
        found = goal_ball.workspace_length(RADIUS + 30.0, RADIUS, limits_of())
        assert found == pytest.approx(math.pi * RADIUS / 2 + 30.0)

    @pytest.mark.parametrize("rho", [0.0, 1e-6, 5.0, 60.0, 120.0])
    def test_behind_is_out_of_reach(self, rho: float) -> None:
        assert goal_ball.workspace_length(rho, -1.0, limits_of()) == math.inf

    def test_inside_the_tightest_circle_only_a_path_of_more_than_half_a_turn_leads(self) -> None:
        assert goal_ball.workspace_length(RADIUS, 10.0, limits_of(max_length_mm=500.0)) == math.inf
        wide = limits_of(max_angle_rad=math.pi, max_turn_rad=3 * math.pi, max_length_mm=500.0)
        assert math.pi * RADIUS < goal_ball.workspace_length(RADIUS, 10.0, wide) < 2.5 * math.pi * RADIUS

    @given(angle=st.floats(1e-3, math.pi / 2), share=st.floats(0.05, 1.0))
    def test_ends_of_arcs_within_the_limits_are_in(self, angle: float, share: float) -> None:
        """Also those of the tightest arc, where rounding decides."""
        radius = RADIUS / share
        length = radius * angle
        found = goal_ball.workspace_length(
            radius * (1 - math.cos(angle)), radius * math.sin(angle), limits_of(max_length_mm=length + 1e-9)
        )
        assert found <= length + 1e-9

    def test_is_the_shortest_of_all_arcs_followed_by_straight_lines(self) -> None:
        """Against a dense family of them, for points all over the half plane."""
        rng = np.random.default_rng(1)
        limits = limits_of(max_angle_rad=math.radians(70.0), max_length_mm=120.0)
        angle = np.linspace(0.0, math.radians(70.0), 20001)
        for rho, h in rng.uniform([0.0, -20.0], [110.0, 120.0], (400, 2)):
            found = goal_ball.workspace_length(rho, h, limits)
            x, z = RADIUS * (1 - np.cos(angle)), RADIUS * np.sin(angle)
            ahead = (rho - x) * np.sin(angle) + (h - z) * np.cos(angle)
            miss = np.abs((rho - x) * np.cos(angle) - (h - z) * np.sin(angle))
            hit = (ahead >= -0.005) & (miss < 0.01)
            length = float(np.min((RADIUS * angle + ahead)[hit], initial=math.inf))
            if math.isfinite(found):
                assert length == pytest.approx(found, abs=0.5), (rho, h)
            else:
                assert length > 120.0 - 0.5, (rho, h)

    def test_no_curve_leads_out_of_it(self) -> None:
        """Ends of random curves within the limits lie inside, and the shortest path is no longer."""
        rng = np.random.default_rng(2)
        max_angle, max_turn = math.radians(80.0), math.radians(150.0)
        limits = limits_of(max_angle_rad=max_angle, max_turn_rad=max_turn)
        tested = 0
        for _ in range(3000):
            curvature = rng.choice([0.0, 1.0, rng.uniform()], 5) / RADIUS
            length = rng.uniform(0.5, 28.0, 5)
            # Half of the curves keep to one plane, where they get farthest aside.
            roll = rng.uniform(-np.pi, np.pi, 5) if rng.uniform() < 0.5 else np.array([0.3, 0, 0, 0, 0])
            path = ArcPath(lps_from_start=np.eye(4), arcs=np.column_stack([length, roll, curvature]))
            if path.max_angle_from_start_rad() > max_angle or path.accumulated_turn_rad > max_turn:
                continue
            tested += 1
            x, y, z = path.frames()[-1][:3, 3]
            assert goal_ball.workspace_length(math.hypot(x, y), z, limits) <= path.length_mm + 1e-6, path.arcs
        assert tested > 1000

    @given(
        forward=st.floats(-1.0, 1.0),
        phase=st.floats(0.0, 2 * math.pi),
        turn=st.floats(0.0, 2 * math.pi - 1e-3),
    )
    def test_largest_angle_along_an_arc(self, forward: float, phase: float, turn: float) -> None:
        aside = math.sqrt(1 - forward**2) * math.cos(phase)
        a = np.linspace(0.0, turn, 4001)
        dense = float((forward * np.cos(a) + aside * np.sin(a)).min())
        assert dense - 1e-5 <= connections.least_cosine(forward, aside, turn) <= dense + 1e-12
