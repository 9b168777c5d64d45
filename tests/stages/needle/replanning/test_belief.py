"""What is believed of a needle on its way: exact where nothing is unknown, and the curvature learned."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anatomy.base.typed import Float
from stages.needle.path import ArcPath, Query, arc_transform, direct_path
from stages.needle.replanning.insertion import FACTORS, Belief, TrueNeedle, Unknown, steer, tilt
from stages.needle.replanning.replanner import Replanner, ReplanSettings
from tests.stages.needle.replanning.around_a_ball import BESIDE, KAPPA, query, with_ball

STEP_MM, NOISE_MM, NOISE_RAD = 0.1, 0.5, math.radians(0.6)
NEEDED = 0.4 * KAPPA
"""Curvature of the way to the target: so much less than the needle's own that a weak one gets there, too."""


class Bent:
    """A needle that bends more or less than it is told, whose bevel errs, and a noisy tracker."""

    def __init__(self, factor: float, seed: int, *, roll_rad: float = 0.0, noise: float = 1.0) -> None:
        self.factor, self._roll_rad, self._noise, self.lag = factor, roll_rad, noise, 0.0
        self._rng = np.random.default_rng(seed)

    def roll(self) -> None:
        self.lag = self._roll_rad * self._rng.standard_normal()

    def bend(self, frame: Float, curvature: float, inserted_mm: float) -> tuple[float, float]:
        return self.lag, self.factor * curvature

    def measure(self, needle: TrueNeedle) -> tuple[Float, Float | None]:
        a, b = self._noise * NOISE_RAD * self._rng.standard_normal(2)
        seen = needle.frame @ tilt(math.hypot(a, b), math.atan2(b, a))
        seen[:3, 3] += self._noise * NOISE_MM * self._rng.standard_normal(3)
        return seen, None


def known(**more: float) -> Unknown:
    return Unknown(**({"tip_mm": NOISE_MM, "tip_rad": NOISE_RAD, "factor_ln": 0.4} | more))


def asked() -> tuple[Query, ArcPath]:
    path = ArcPath(lps_from_start=BESIDE, arcs=np.array([[45.0, 0.3, NEEDED]]))
    end = path.frames()[-1][:3, 3]
    return query(BESIDE, end), direct_path(BESIDE, end)


def inserted(truth: Bent, unknown: Unknown, **more: float) -> tuple[TrueNeedle, Belief, float]:
    """Return a needle that was steered beside the ball, what is believed of it, and its miss in mm."""
    wanted, path = asked()
    needle, belief = TrueNeedle(truth, BESIDE, 0.0), Belief(wanted, unknown)
    replanner = Replanner(
        with_ball(), wanted, path, iterations=0, settings=ReplanSettings(largest_miss_mm=2.0)
    )
    settings = {"step_mm": STEP_MM, "measure_every_mm": STEP_MM, "replan_every_mm": 2.0} | more
    steer(with_ball(), needle, belief, path, replanner, branch=-1, **settings)
    return needle, belief, float(np.linalg.norm(needle.frame[:3, 3] - wanted.target))


def test_dead_reckoning_is_exact_where_nothing_is_unknown() -> None:
    needle, belief, miss = inserted(Bent(1.0, 0, noise=0.0), Unknown(), measure_every_mm=3.0)
    assert miss < 1e-9 and np.allclose(needle.frame, belief.frame, atol=1e-9)
    assert belief.factor == 1.0 and belief.factor_ln == 0.0


@pytest.mark.parametrize("factor", [0.5, 0.8, 1.3, 2.0])
def test_the_curvature_is_learned_and_the_target_reached(factor: float) -> None:
    for seed in range(4):
        _needle, belief, miss = inserted(Bent(factor, seed, roll_rad=0.09), known(roll_rad=0.09))
        assert belief.factor == pytest.approx(factor, rel=0.1)
        assert belief.factor_ln < 0.1 and miss < 1.0


def test_a_weak_needle_that_is_taken_for_a_usual_one_goes_astray() -> None:
    """Without the estimate it is told to bend as planned, and a turn that it cannot make is planned."""
    told = [
        inserted(Bent(0.5, seed), known(factor_ln=spread))[2] for seed in range(4) for spread in (0.0, 0.4)
    ]
    assert np.median(told[1::2]) < 0.5 * np.median(told[::2])


def test_what_is_believed_errs_as_much_as_it_says() -> None:
    """The logarithm of the factor lies within twice its stated deviation of the truth, about as often."""
    rng = np.random.default_rng(5)
    found = []
    for seed in range(40):
        factor = math.exp(0.4 * rng.standard_normal())
        belief, needle = Belief(asked()[0], known()), TrueNeedle(Bent(factor, seed), BESIDE, 0.0)
        for _ in range(60):
            for body in (needle, belief):
                body.insert(STEP_MM, KAPPA)
            belief.correct(*needle.measure())
        found.append((math.log(belief.factor) - math.log(factor)) / belief.factor_ln)
    assert np.mean(np.abs(found) < 2.0) > 0.85 and np.std(found) > 0.4


def test_a_change_of_the_factor_moves_the_tip_as_the_filter_takes_it_to() -> None:
    for length, curvature in ((5.0, 1.0 / 30.0), (0.2, 1e-4), (30.0, 0.02)):
        frame = np.asarray(BESIDE @ arc_transform(0.0, 0.7, 0.0))
        belief, small = Belief(query(frame), known()), 1e-6
        moved = belief._bent_more(length, curvature)
        more, less = (frame @ arc_transform(length, 0.0, curvature * (1.0 + e)) for e in (small, -small))
        place = (more[:3, 3] - less[:3, 3]) / (2.0 * small)
        turned = np.cross(less[:3, 2], more[:3, 2]) / (2.0 * small)
        assert np.allclose(moved[:3], place, rtol=1e-3, atol=1e-6)
        assert np.allclose(moved[3:], turned, rtol=1e-3, atol=1e-6)


def test_a_bevel_that_lags_is_seen_and_turned_back() -> None:
    truth = Bent(1.0, 0, noise=0.1)
    truth.lag = 0.5
    belief = Belief(query(BESIDE), Unknown(roll_rad=0.3, tip_mm=0.05, tip_rad=0.001))
    belief.roll(1e-6)
    needle = TrueNeedle(truth, BESIDE, 0.0)
    for _ in range(150):
        for body in (needle, belief):
            body.insert(STEP_MM, KAPPA)
        belief.correct(*needle.measure())
    assert belief.lag_rad == pytest.approx(0.5, abs=0.1)


def test_an_exact_measurement_is_taken_as_it_is_wherever_the_needle_began() -> None:
    moved = np.array(BESIDE @ tilt(0.1, 0.4))
    moved[:3, 3] += [1.0, -2.0, 0.5]
    start = np.diag([4.0, 4.0, 4.0, 0.01, 0.01, 0.01])
    start[0, 4] = start[4, 0] = 0.2
    belief = Belief(query(BESIDE), Unknown(start=start, factor_ln=0.4))
    for _ in range(3):
        belief.insert(3.0, KAPPA)
        moved = moved @ arc_transform(3.0, 0.0, KAPPA)
        belief.correct(moved)
        assert np.allclose(belief.frame[:3, 3], moved[:3, 3], atol=1e-6)
        assert np.linalg.norm(belief.frame[:3, 2] - moved[:3, 2]) < 2e-4


def test_a_needle_that_goes_straight_is_not_divided_by_nothing() -> None:
    _needle, belief, miss = inserted(Bent(0.0, 1), known())
    assert FACTORS[0] <= belief.factor < 0.6 and math.isfinite(miss)
