"""Circular arcs: closed forms, limits and frames."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from anatomy.kernels.arcs import (
    any_normal,
    arc_to_point,
    normal_on_arc,
    point_on_arc,
    pose_on_arc,
    sine_length,
    versine_length,
)

ORIGIN_UP = (0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
coordinates = st.floats(-100.0, 100.0)
curvatures = st.floats(0.0, 0.05)
lengths = st.floats(0.0, 150.0)


@st.composite
def directions(draw: st.DrawFn) -> tuple[float, float, float]:
    vector = np.array(draw(st.tuples(*[st.floats(-1.0, 1.0)] * 3)))
    norm = float(np.linalg.norm(vector))
    assume(norm > 0.1)
    x, y, z = (vector / norm).tolist()
    return x, y, z


@st.composite
def poses(draw: st.DrawFn) -> tuple[float, ...]:
    return (*draw(st.tuples(coordinates, coordinates, coordinates)), *draw(directions()))


@st.composite
def bends(draw: st.DrawFn, pose: tuple[float, ...]) -> tuple[float, ...]:
    """Draw a curvature and a unit normal to the tangent of `pose`."""
    first = np.array(any_normal(*pose[3:]))
    second = np.cross(pose[3:], first)
    angle = draw(st.floats(-math.pi, math.pi))
    return (draw(curvatures), *(math.cos(angle) * first + math.sin(angle) * second))


@given(direction=directions())
def test_any_normal_is_a_unit_normal(direction: tuple[float, float, float]) -> None:
    normal = np.array(any_normal(*direction))
    assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-12)
    assert abs(normal @ direction) < 1e-12


def test_a_quarter_circle() -> None:
    radius = 20.0
    bend = (1 / radius, 1.0, 0.0, 0.0)
    end = pose_on_arc(ORIGIN_UP, bend, radius * math.pi / 2)
    np.testing.assert_allclose(end, (radius, 0, radius, 1, 0, 0), atol=1e-12)
    np.testing.assert_allclose(normal_on_arc(ORIGIN_UP, bend, radius * math.pi / 2), (0, 0, -1), atol=1e-12)


def test_no_curvature_is_straight() -> None:
    bend = (0.0, 1.0, 0.0, 0.0)
    np.testing.assert_allclose(pose_on_arc(ORIGIN_UP, bend, 30.0), (0, 0, 30, 0, 0, 1))
    np.testing.assert_allclose(normal_on_arc(ORIGIN_UP, bend, 30.0), (1, 0, 0))


@given(kappa=st.floats(1e-12, 0.05), s=lengths)
def test_small_angles_join_the_closed_form(kappa: float, s: float) -> None:
    """The half-angle form keeps its digits at every angle."""
    half = kappa * s / 2
    versine = 2.0 * math.sin(half) ** 2 / kappa
    assert versine_length(kappa, s) == pytest.approx(versine, rel=1e-9, abs=1e-10)
    assert sine_length(kappa, s) == pytest.approx(math.sin(kappa * s) / kappa, rel=1e-12, abs=1e-12)


@given(data=st.data(), pose=poses(), s=lengths)
def test_a_pose_on_an_arc_has_an_orthonormal_frame(
    data: st.DataObject, pose: tuple[float, ...], s: float
) -> None:
    bend = data.draw(bends(pose))
    end = np.array(pose_on_arc(pose, bend, s))
    normal = np.array(normal_on_arc(pose, bend, s))
    assert np.linalg.norm(end[3:]) == pytest.approx(1.0, abs=1e-12)
    assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-12)
    assert abs(end[3:] @ normal) < 1e-12
    binormal = np.cross(pose[3:], bend[1:])
    np.testing.assert_allclose(np.cross(end[3:], normal), binormal, atol=1e-12)


@given(data=st.data(), pose=poses(), s=st.floats(1.0, 150.0))
def test_the_tangent_is_the_derivative_of_the_point(
    data: st.DataObject, pose: tuple[float, ...], s: float
) -> None:
    bend = data.draw(bends(pose))
    step = 1e-3
    ahead, behind = (np.array(point_on_arc(pose, bend, s + h)) for h in (step, -step))
    np.testing.assert_allclose((ahead - behind) / (2 * step), pose_on_arc(pose, bend, s)[3:], atol=1e-6)


@given(data=st.data(), pose=poses(), a=lengths, b=lengths)
def test_two_pieces_of_an_arc_are_the_whole(
    data: st.DataObject, pose: tuple[float, ...], a: float, b: float
) -> None:
    bend = data.draw(bends(pose))
    middle = pose_on_arc(pose, bend, a)
    rest = (bend[0], *normal_on_arc(pose, bend, a))
    np.testing.assert_allclose(
        pose_on_arc(middle, rest, b), pose_on_arc(pose, bend, a + b), rtol=1e-10, atol=1e-8
    )


@given(pose=poses(), q=st.tuples(coordinates, coordinates, coordinates))
def test_the_arc_to_a_point_ends_there(pose: tuple[float, ...], q: tuple[float, float, float]) -> None:
    length, bend, turn = arc_to_point(pose, q)
    chord = float(np.linalg.norm(np.array(q) - pose[:3]))
    assume(math.isfinite(length) and length < 1e5)
    np.testing.assert_allclose(point_on_arc(pose, bend, length), q, atol=1e-6)
    assert length >= chord - 1e-9
    assert turn == pytest.approx(bend[0] * length, abs=1e-9)
    assert 0.0 <= turn <= 2 * math.pi + 1e-12
    assert abs(np.dot(bend[1:], pose[3:])) < 1e-6


@given(data=st.data(), pose=poses(), s=st.floats(0.5, 150.0))
def test_the_arc_to_the_end_of_an_arc_is_that_arc(
    data: st.DataObject, pose: tuple[float, ...], s: float
) -> None:
    bend = data.draw(bends(pose))
    assume(bend[0] > 1e-4 and bend[0] * s < 6.0)
    length, (kappa, *normal), turn = arc_to_point(pose, point_on_arc(pose, bend, s))
    assert length == pytest.approx(s, rel=1e-6)
    assert kappa == pytest.approx(bend[0], rel=1e-5, abs=1e-9)
    assert turn == pytest.approx(bend[0] * s, rel=1e-5)
    if bend[0] * s**2 > 1e-3:
        np.testing.assert_allclose(normal, bend[1:], atol=1e-6)


def test_a_point_ahead_is_reached_straight() -> None:
    length, bend, turn = arc_to_point(ORIGIN_UP, (0.0, 0.0, 12.0))
    assert (length, bend[0], turn) == (12.0, 0.0, 0.0)
    assert abs(bend[3]) < 1e-12
    assert arc_to_point(ORIGIN_UP, (0.0, 0.0, 0.0))[0] == 0.0


def test_a_point_straight_behind_is_infinitely_far() -> None:
    assert math.isinf(arc_to_point(ORIGIN_UP, (0.0, 0.0, -5.0))[0])
    # Next to it the arc is nearly a full, huge circle.
    length, bend, turn = arc_to_point(ORIGIN_UP, (0.01, 0.0, -5.0))
    assert turn == pytest.approx(2 * math.pi - 2 * math.atan(0.01 / 5.0))
    assert length == pytest.approx(turn / bend[0])
    assert bend[0] == pytest.approx(2 * 0.01 / (0.01**2 + 25.0))


def test_a_point_beside_is_half_a_circle_away() -> None:
    length, bend, turn = arc_to_point(ORIGIN_UP, (0.0, -8.0, 0.0))
    assert length == pytest.approx(4 * math.pi)
    assert turn == pytest.approx(math.pi)
    np.testing.assert_allclose(bend, (0.25, 0.0, -1.0, 0.0))
