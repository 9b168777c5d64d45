"""Shortest connections of bounded curvature, the trumpet and the spindle against closed forms and search."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from anatomy.kernels.arcs import pose_on_arc
from stages.needle.kernels import connections, goal_ball
from stages.needle.kernels.proof import Limits

RADIUS = 50.0
KAPPA = 1 / RADIUS
START = (0.0, 0.0, 0.0, 0.0, 0.0, 1.0)

COORDINATE = st.floats(-160.0, 160.0)


def end_of_legs(pose: tuple[float, ...], q: tuple[float, ...]) -> tuple[np.ndarray, float, float]:
    """Follow the legs of the shortest path; return the end, the length and the turn."""
    first, first_length, second, second_length = connections.shortest_legs(pose, q, KAPPA)
    middle = pose_on_arc(pose, first, first_length)
    end = pose_on_arc(middle, second, second_length)
    return (
        np.array(end[:3]),
        first_length + second_length,
        first[0] * first_length + second[0] * second_length,
    )


@given(x=COORDINATE, y=COORDINATE, z=COORDINATE)
def test_the_legs_end_at_the_point_and_are_as_long_as_stated(x: float, y: float, z: float) -> None:
    assume(math.sqrt(x * x + y * y + z * z) > 1e-3)
    end, length, turn = end_of_legs(START, (x, y, z))
    assert end == pytest.approx([x, y, z], abs=1e-5)
    stated = connections.shortest_path(math.hypot(x, y), z, KAPPA, math.pi, 10.0)
    assert length == pytest.approx(stated, abs=1e-6)
    assert turn <= 4 * math.pi


@given(x=COORDINATE, y=COORDINATE, z=COORDINATE, turns=st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3))
def test_legs_turn_with_the_pose(x: float, y: float, z: float, turns: list[float]) -> None:
    """A rotated problem has the rotated answer."""
    from scipy.spatial.transform import Rotation

    assume(math.hypot(x, y, z) > 1e-3)
    rotation = Rotation.from_rotvec(turns)
    point = tuple(float(v) for v in rotation.apply([x, y, z]) + [5.0, -3.0, 2.0])
    tangent = rotation.apply([0.0, 0.0, 1.0])
    pose = (5.0, -3.0, 2.0, *(float(v) for v in tangent))
    _, length, _ = end_of_legs(START, (x, y, z))
    end, same, _ = end_of_legs(pose, point)
    # Right behind the start any plane will do, and near the edge of the circle CS turns into CC.
    rho = math.hypot(x, y)
    assume(abs(math.hypot(rho - RADIUS, z) - RADIUS) > 1e-6 and not (rho < 1e-6 and z < 0))
    assert end == pytest.approx(point, abs=1e-5)
    assert same == pytest.approx(length, abs=1e-5)


def test_closed_forms() -> None:
    """A quarter turn and 30 mm; half a turn; the point one radius to the side, by two arcs."""
    assert connections.arc_and_straight(RADIUS + 30.0, RADIUS, KAPPA) == pytest.approx((math.pi / 2, 30.0))
    assert connections.arc_and_straight(2 * RADIUS, 0.0, KAPPA) == pytest.approx((math.pi, 0.0))
    assert connections.arc_and_straight(RADIUS, 0.0, KAPPA) == (math.inf, math.inf)
    away, back = connections.two_arcs(RADIUS, 0.0, KAPPA)
    # The centres lie 2 R apart, the point R from the second and 2 R from the first: an isosceles triangle.
    assert away == pytest.approx(math.acos(7 / 8))
    assert back == pytest.approx(2 * math.pi - (math.pi - away - math.acos(1 / 4)))
    assert connections.two_arcs(3 * RADIUS, 3 * RADIUS, KAPPA) == (math.inf, math.inf)


def reached_by_random_paths(count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where random plane paths of four arcs end (rho, h), their lengths and largest angles."""
    rng = np.random.default_rng(seed)
    x = np.zeros(count)
    y = np.zeros(count)
    angle = np.zeros(count)
    length = np.zeros(count)
    turned = np.zeros(count)
    for _ in range(4):
        kappa = rng.choice([-1, 1, 0, 0.5, -0.5], count) * KAPPA
        s = rng.uniform(0, 90, count)
        for _step in range(200):
            ds = s / 200
            angle += 0.5 * kappa * ds
            x += np.sin(angle) * ds
            y += np.cos(angle) * ds
            angle += 0.5 * kappa * ds
            turned = np.maximum(turned, np.abs(angle))
        length += s
    return np.stack([np.abs(x), y]), length, turned


def test_no_path_is_shorter_and_none_leads_out_of_the_trumpet() -> None:
    ends, lengths, largest = reached_by_random_paths(20_000, 1)
    for rho, h, length, angle in zip(*ends, lengths, largest, strict=True):
        shortest = connections.shortest_path(rho, h, KAPPA, math.pi, 100.0)
        assert shortest <= length + 0.01
        if angle <= math.pi / 2:
            assert connections.shortest_path(rho, h, KAPPA, math.pi / 2 + 0.01, math.pi) < math.inf


def test_a_goal_just_out_of_reach_is_reached_within_the_tolerance() -> None:
    def workspace_length(goal_tolerance_mm: float) -> float:
        values = dict.fromkeys(Limits._fields, 0.0) | {"kappa": KAPPA, "max_length_mm": 150.0}
        values |= {"max_angle_rad": math.pi / 2, "max_turn_rad": math.pi / 2}
        limits = Limits(**values | {"goal_tolerance_mm": goal_tolerance_mm})
        return float(goal_ball.workspace_length(rho, h, limits))

    turn = 0.7
    rho, h = (RADIUS - 0.8) * -math.cos(turn) + RADIUS, (RADIUS - 0.8) * math.sin(turn)
    assert workspace_length(0.0) == math.inf
    assert workspace_length(0.7) == math.inf
    centre = RADIUS - 0.8
    entered = turn - math.acos((RADIUS**2 + centre**2 - 0.9**2) / (2.0 * RADIUS * centre))
    assert workspace_length(0.9) == pytest.approx(entered * RADIUS)
    assert connections.nearest_turn(rho, h, KAPPA) == pytest.approx((turn, 0.8))
