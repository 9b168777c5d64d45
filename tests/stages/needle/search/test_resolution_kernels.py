"""What the search that ends is made of: paths into the ball about the goal, and its queue."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from anatomy.kernels.arcs import pose_on_arc
from stages.needle.kernels import goal_ball
from stages.needle.kernels.proof import Limits
from stages.needle.search.kernels import resolution_nodes


class TestGoalBall:
    """Shortest paths into the ball about the goal."""

    RADIUS = 30.0

    @classmethod
    def limits(cls, tolerance: float, max_angle_deg: float) -> Limits:
        values = dict.fromkeys(Limits._fields, 0.0) | {"kappa": 1.0 / cls.RADIUS}
        return Limits(
            **values | {"goal_tolerance_mm": tolerance, "max_angle_rad": math.radians(max_angle_deg)}
        )

    @given(
        rho=st.floats(0.0, 60.0),
        h=st.floats(-10.0, 60.0),
        tolerance=st.sampled_from([0.0, 0.5, 2.0]),
        max_angle_deg=st.sampled_from([30.0, 60.0, 90.0]),
    )
    @settings(max_examples=300)
    def test_the_bound_is_the_shortest_of_a_dense_family(
        self, rho: float, h: float, tolerance: float, max_angle_deg: float
    ) -> None:
        """The limit of the angle decides whether there is one, but not how short it may be."""
        found = goal_ball.least_length(rho, h, self.limits(tolerance, max_angle_deg), 1.0, math.pi)
        expected = self.dense(rho, h, tolerance, math.radians(max_angle_deg))
        if math.isfinite(found) == math.isfinite(expected):
            if math.isfinite(found):
                assert found == pytest.approx(self.dense(rho, h, tolerance, math.pi), abs=0.02)
        else:
            around = [
                math.isfinite(self.dense(abs(rho + dx), h + dz, tolerance, math.radians(max_angle_deg)))
                for dx in (-0.01, 0.0, 0.01)
                for dz in (-0.01, 0.0, 0.01)
            ]
            assert any(around) and not all(around), "only at the edge of what is reached"

    @classmethod
    def dense(cls, rho: float, h: float, tolerance: float, max_angle: float) -> float:
        """Return the least length at which a path CS of a dense family is in the ball."""
        angle = np.linspace(0.0, max_angle, 40001)
        x, z = rho - cls.RADIUS * (1.0 - np.cos(angle)), h - cls.RADIUS * np.sin(angle)
        along = x * np.sin(angle) + z * np.cos(angle)
        reach = max(tolerance, 5e-3)
        spare2 = reach**2 - (x * x + z * z - along**2)
        half = np.sqrt(np.maximum(spare2, 0.0))
        hit = (spare2 >= 0.0) & (along + half >= 0.0)
        length = cls.RADIUS * angle + np.maximum(along - half, 0.0)
        return float(np.min(length[hit], initial=math.inf))

    @given(
        goal=st.tuples(st.floats(-40.0, 40.0), st.floats(-40.0, 40.0), st.floats(-10.0, 60.0)),
        tolerance=st.sampled_from([0.0, 0.5, 2.0]),
    )
    def test_paths_end_where_they_first_are_in_the_ball(
        self, goal: tuple[float, float, float], tolerance: float
    ) -> None:
        # A goal that lies at the start but for rounding needs no path, or a whole circle.
        assume(math.hypot(*goal) > 1e-6)
        limits = self.limits(tolerance, 180.0)
        start = (0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
        bound = goal_ball.least_length(math.hypot(goal[0], goal[1]), goal[2], limits, 1.0, math.pi)
        left = min(tolerance, math.hypot(*goal))
        first, first_length, second, second_length, ahead = goal_ball.shortest_into_ball(start, goal, limits)
        legs = [(first, first_length), (second, second_length)]
        if math.isfinite(bound):
            assert first_length + second_length == pytest.approx(bound, abs=1e-5)
            assert math.dist(end_of(start, legs)[:3], goal) == pytest.approx(left, abs=1e-5)
        if ahead > 0.0:
            assert math.dist(end_of(start, [*legs, (second, ahead)])[:3], goal) < 1e-6
        bend, length = goal_ball.single_into_ball(start, goal, limits)
        if length > 0.0:
            assert bend[0] <= limits.kappa * (1.0 + 1e-9)
            assert math.dist(end_of(start, [(bend, length)])[:3], goal) == pytest.approx(left, abs=1e-5)


def end_of(pose: Any, legs: list[Any]) -> Any:
    """Return the pose after some legs."""
    for bend, length in legs:
        pose = pose_on_arc(pose, bend, length)
    return pose


class TestQueue:
    """The order in which entries are taken."""

    def test_smallest_bound_among_the_lowest_rank_and_the_next_three(self) -> None:
        rng = np.random.default_rng(7)
        size = 600
        lists = np.zeros((80, 2), dtype=np.int32)
        lists[:, resolution_nodes.HEAD] = -1
        entries = np.zeros((size, resolution_nodes.ENTRY_COLUMNS), dtype=np.int32)
        queue = np.zeros(size), entries, np.zeros(size), np.zeros(size, dtype=np.int32), lists
        state = np.zeros(resolution_nodes.STATE_SIZE, dtype=np.int64)
        state[resolution_nodes.FREE] = -1
        waiting: dict[int, tuple[float, int]] = {}
        lowest = pushed = most = 0
        while pushed < 3000 or waiting:
            if pushed < 3000 and len(waiting) < size and (not waiting or rng.uniform() < 0.6):
                f, rank = float(rng.uniform()), min(lowest + int(rng.integers(0, 12)), 70)
                resolution_nodes.push(queue, state, f, pushed, -pushed, rank)
                waiting[pushed] = f, rank
                pushed += 1
                most = max(most, len(waiting))
                continue
            lowest = min(rank for _f, rank in waiting.values())
            ahead = {n: f for n, (f, rank) in waiting.items() if rank <= lowest + 3}
            f, first, second, rank = resolution_nodes.pop(queue, state)
            assert first == min(ahead, key=ahead.__getitem__)
            assert second == -first and (f, rank) == waiting.pop(first)
            assert state[resolution_nodes.WAITING] == len(waiting)
        assert most > 400
