"""The spline and the proof of its curvature and depth."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import BSpline

from anatomy.base.errors import SettingsError
from stages.scope.route.curve import Curve, interpolate
from stages.scope.route.proof import prove
from tests.stages.scope.route.tubes import chain, corner, straight


def wiggle(seed: int, n: int = 14) -> Curve:
    rng = np.random.default_rng(seed)
    along = np.arange(n)[:, None] * np.array((0.0, 0.0, 3.0))
    return interpolate(along + rng.normal(0.0, 0.5, (n, 3)))


def circle_curve(radius: float) -> Curve:
    t = np.linspace(0.0, 0.5 * np.pi, 12)
    return interpolate(radius * np.stack((np.cos(t), np.sin(t), np.zeros_like(t)), axis=1))


def test_curve_equals_the_textbook_spline_and_its_derivatives() -> None:
    curve = wiggle(1)
    u = curve.parameters(7)
    reference = BSpline(curve.knots, curve.control_mm, 3)
    for order in range(3):
        np.testing.assert_allclose(curve.at(u)[order], reference(u, nu=order), atol=1e-11)


def test_curve_runs_through_its_points() -> None:
    points = np.random.default_rng(0).normal(size=(9, 3)) * 5.0
    curve = interpolate(points)
    along = np.concatenate(((0.0,), np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))))
    np.testing.assert_allclose(curve.at(along)[0], points, atol=1e-10)


@pytest.mark.parametrize("count", [2, 3])
def test_few_points_make_a_curve(count: int) -> None:
    points = np.stack((np.arange(count) * 4.0, np.zeros(count), np.zeros(count)), axis=1)
    assert interpolate(points).length_mm() == pytest.approx(4.0 * (count - 1))


def test_one_point_is_refused() -> None:
    with pytest.raises(SettingsError):
        interpolate(np.ones((3, 3)))


def test_knots_that_fall_are_refused() -> None:
    good = wiggle(0)
    knots = np.array(good.knots)
    knots[5] = knots[6]
    with pytest.raises(SettingsError, match="rising"):
        Curve(control_mm=good.control_mm, knots=knots)


def test_curvature_of_a_circle() -> None:
    curve = circle_curve(20.0)
    np.testing.assert_allclose(curve.curvature_per_mm(curve.parameters(9)), 0.05, rtol=0.02)


@pytest.mark.parametrize("seed", range(25))
def test_proved_limits_hold_on_dense_samples_and_are_decided_tightly(seed: int) -> None:
    """Just above the true extremes the proof succeeds, just below it finds a counter-example."""
    curve, tube = wiggle(seed), straight(length=60.0, radius=9.0)
    u = curve.parameters(4000)
    largest, least = curve.curvature_per_mm(u).max(), tube.depth_mm(curve.at(u)[0]).min()
    held = prove(curve, tube, max_curvature_per_mm=1.01 * largest, needed_mm=least - 0.02)
    assert held.holds
    assert largest <= held.curvature_bound_per_mm <= 1.01 * largest
    assert least - 0.02 <= held.depth_bound_mm <= least
    bent = prove(curve, tube, max_curvature_per_mm=0.99 * largest, needed_mm=least - 0.02)
    assert not bent.holds
    near = prove(curve, tube, max_curvature_per_mm=1.01 * largest, needed_mm=least + 0.01)
    assert "too near the wall" in near.reasons()


def test_a_peak_between_samples_does_not_escape() -> None:
    """Sixteen samples a span miss this bend by a fifth; the proof does not."""
    control = np.array([(0, 0, 0), (4, 0, 0), (4.0, 0.1, 0), (4.02, 4, 0)], dtype=float)
    curve = Curve(control_mm=control, knots=np.array([0, 0, 0, 0, 8, 8, 8, 8], dtype=float))
    tube = chain(control, 6.0)
    dense = curve.curvature_per_mm(curve.parameters(100_000)).max()
    coarse = curve.curvature_per_mm(curve.parameters(5)).max()
    assert coarse < 0.9 * dense
    between = 0.5 * (coarse + dense)
    assert not prove(curve, tube, max_curvature_per_mm=between, needed_mm=0.0).holds
    assert prove(curve, tube, max_curvature_per_mm=1.01 * dense, needed_mm=0.0).holds


def test_a_cusp_is_never_proved() -> None:
    control = np.array([(0, 0, 0), (5, 0, 0), (0, 0, 0), (5, 0, 0)], dtype=float)
    curve = Curve(control_mm=control, knots=np.array([0, 0, 0, 0, 5, 5, 5, 5], dtype=float))
    assert not prove(curve, straight(), max_curvature_per_mm=1e6, needed_mm=0.0).holds


def test_proof_far_from_the_origin() -> None:
    """Millimetres of a scanner may be in the thousands."""
    curve, far = circle_curve(20.0), np.array((1500.0, -900.0, 2000.0))
    moved = Curve(control_mm=curve.control_mm + far, knots=curve.knots)
    tube = chain(curve.sampled(4) + far, 1.0)
    largest = curve.curvature_per_mm(curve.parameters(500)).max()
    assert prove(moved, tube, max_curvature_per_mm=1.001 * largest, needed_mm=0.9).holds


def test_leaving_the_lumen_is_found() -> None:
    tube = corner(60.0, 1.0)
    a, b = tube.nodes_mm[0], tube.nodes_mm[-1]
    proof = prove(interpolate(np.stack((a, b))), tube, max_curvature_per_mm=1.0, needed_mm=0.0)
    assert "too near the wall" in proof.reasons()
    assert tube.depth_mm(proof.points_mm[proof.failed_spans]).min() < 0.0
