"""The check's own scope: products of exponentials, and the least gap of a motion, in states and between."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lungaccess.judging.checking import shapes
from lungaccess.judging.checking.scope import Motion, least_gap_mm, motion_of, screws
from stages.scope.motion import ScopeMotion

SECTION_MM = 16.0
ENTRY = np.array([[0.0, 0.6, 0.8, 5.0], [1.0, 0.0, 0.0, -3.0], [0.0, 0.8, -0.6, 2.0], [0.0, 0.0, 0.0, 1.0]])


def random_states(rng: np.random.Generator, count: int) -> np.ndarray:
    """States that advance and turn in place by turns."""
    states = [np.array([0.0, *rng.uniform(-1.0, 1.0, 2)])]
    for n in range(count):
        step = np.array([rng.uniform(0.5, 4.0), 0.0, 0.0]) if n % 2 else np.append(0.0, rng.uniform(-1, 1, 2))
        states.append(states[-1] + step)
    return np.array(states)


@given(x=st.floats(-0.3, 0.3), y=st.floats(-0.3, 0.3), length=st.floats(0.0, 30.0))
def test_a_screw_is_the_exponential_of_its_twist(x: float, y: float, length: float) -> None:
    generator = np.zeros((4, 4))
    generator[:3, 2], generator[2, :2] = [x, y, 0.0], [-x, -y]
    generator[2, 3] = 1.0
    found = screws(np.array([[x, y]]), np.array([length]))[0]
    np.testing.assert_allclose(found, shapes.expm(generator * length), atol=1e-9)


@pytest.mark.parametrize("curvature", [0.0, 1e-9, 1e-5, 1e-3, 1e-2])
def test_a_screw_is_smooth_where_it_gets_straight(curvature: float) -> None:
    point = screws(np.array([[curvature, 0.0]]), np.array([20.0]))[0, :3, 3]
    bent = 0.5 * curvature * 20.0**2
    np.testing.assert_allclose(point, [bent, 0.0, 20.0], atol=2.0 * bent * curvature * 20.0 + 1e-12)


@settings(max_examples=20)
@given(seed=st.integers(0, 10_000))
def test_tip_and_body_are_those_of_the_closed_form(seed: int) -> None:
    states = random_states(np.random.default_rng(seed), 15)
    motion = ScopeMotion(lps_from_entry=ENTRY, states=states, bending_length_mm=SECTION_MM)
    own = motion_of(ENTRY, states, SECTION_MM)
    np.testing.assert_allclose(own.tip, motion.lps_from_tip, atol=1e-9)
    points, along = own.body(0.5)
    assert along[-1] == pytest.approx(motion.length_mm)
    np.testing.assert_allclose(points, motion.body(0.5)[:, :3, 3], atol=1e-9)


class Ball:
    """Distances to a ball, which stand in for those to the border of the lumen."""

    def __init__(self, centre: np.ndarray, radius_mm: float) -> None:
        self.centre, self.radius_mm, self.asked = centre, radius_mm, 0

    def distance_mm(self, points: np.ndarray) -> np.ndarray:
        self.asked += len(points)
        return np.maximum(np.linalg.norm(points - self.centre, axis=1) - self.radius_mm, 0.0)


def by_brute_force(motion: Motion, ball: Ball) -> float:
    """The least distance from the ball to the section, with many states put between those of the motion."""
    least = np.inf
    along = np.linspace(0.0, motion.section_mm, 161)
    for n in range(len(motion.states) - 1):
        for share in np.linspace(0.0, 1.0, 101):
            state = (1.0 - share) * motion.states[n] + share * motion.states[n + 1]
            step = screws(motion.bends[n : n + 1], np.array([state[0] - motion.states[n, 0]]))[0]
            base = motion.bases[n] @ step
            bend = state[2] / motion.section_mm * np.array([np.cos(state[1]), np.sin(state[1])])
            local = screws(np.tile(bend, (len(along), 1)), along)[:, :3, 3]
            points = local @ base[:3, :3].T + base[:3, 3]
            least = min(least, float(ball.distance_mm(points).min()))
    return least


@pytest.mark.slow
@settings(max_examples=25)
@given(seed=st.integers(0, 10_000), enough=st.floats(0.5, 4.0))
def test_the_least_gap_is_that_of_brute_force(seed: int, enough: float) -> None:
    rng = np.random.default_rng(seed)
    motion = motion_of(ENTRY, random_states(rng, 6), SECTION_MM)
    beside = rng.uniform(1.0, 8.0) * rng.standard_normal(3)
    ball = Ball(motion.tip[:3, 3] - rng.uniform(0.0, 14.0) * motion.tip[:3, 2] + beside, 1.0)
    true, found = by_brute_force(motion, ball), least_gap_mm(motion, ball, enough, 0.5)  # type: ignore[arg-type]
    assert found > true - 2e-3
    assert (found < enough) == (true < enough) or abs(true - enough) < 2e-3


def test_what_is_hit_between_two_free_states_only_is_found() -> None:
    states = np.array([[0.0, -0.8, 1.2], [0.0, 0.8, 1.2]])
    motion = motion_of(np.eye(4), states, SECTION_MM)
    middle = motion_of(np.eye(4), np.array([[0.0, 0.0, 1.2]]), SECTION_MM).tip[:3, 3]
    ball = Ball(middle, 0.5)
    ends = [least_gap_mm(motion_of(np.eye(4), states[[n]], SECTION_MM), ball, 2.0, 2.0) for n in (0, 1)]  # type: ignore[arg-type]
    assert min(ends) > 2.0
    assert least_gap_mm(motion, ball, 2.0, 2.0) < 1.0  # type: ignore[arg-type]


def test_many_states_need_few_distances() -> None:
    states = random_states(np.random.default_rng(1), 300)
    states[:, 1:] *= 0.02
    ball = Ball(np.array([1e3, 0.0, 0.0]), 1.0)
    assert least_gap_mm(motion_of(ENTRY, states, SECTION_MM), ball, 3.0, 3.0) > 3.0  # type: ignore[arg-type]
    assert ball.asked < 300 * 12


def test_a_record_is_what_its_motion_says() -> None:
    from lungaccess.plans.insertion import scope_insertion

    tree: Any = SimpleNamespace(
        branch_of_point=np.array([0, 1, 2]),
        branch_parent=np.array([-1, 0, 1]),
        generation=np.array([0, 1, 2]),
        carina_lps=np.array([3.0, 4.0, 30.25]),
    )
    motion = ScopeMotion(
        lps_from_entry=np.eye(4),
        states=np.array([[0.0, 0.0, 0.0], [25.0, 0.0, 0.0], [25.0, 0.5, 0.4]]),
        bending_length_mm=SECTION_MM,
    )
    scope = scope_insertion(motion, tree, 2, 0.7)
    assert scope.branches.tolist() == [0, 1, 2]
    assert (scope.generation, scope.length_mm, scope.min_lumen_margin_mm) == (2, 41.0, 0.7)
    assert scope.max_curvature_per_mm == pytest.approx(0.4 / SECTION_MM)
    # The bend leads away from the carina's side by little: the nearest place is about where z is that of it.
    assert scope.length_from_carina_mm == pytest.approx(41.0 - 30.25, abs=0.7)
