"""Poses: rigid right-handed frames that look where the device goes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from anatomy.base.errors import FrameError
from anatomy.poses import ANTERIOR, SUPERIOR, bending_directions, pose, poses_on_arc, roll_towards

vectors = st.tuples(*[st.floats(-10.0, 10.0)] * 3).map(np.array)


@given(point=vectors, forward=vectors, sideways=st.none() | vectors)
def test_a_pose_is_a_rigid_right_handed_frame(
    point: np.ndarray, forward: np.ndarray, sideways: np.ndarray | None
) -> None:
    assume(np.linalg.norm(forward) > 1e-3)
    if sideways is not None:
        assume(np.linalg.norm(np.cross(forward, sideways)) > 1e-3 * np.linalg.norm(forward))
    frame = pose(point, forward, sideways)
    np.testing.assert_allclose(frame[:3, :3].T @ frame[:3, :3], np.eye(3), atol=1e-9)
    assert np.linalg.det(frame[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(frame[:3, 2] * np.linalg.norm(forward), forward, atol=1e-9)
    assert frame[:3, 3].tolist() == point.tolist()
    assert frame[3].tolist() == [0.0, 0.0, 0.0, 1.0]
    if sideways is not None:
        assert frame[:3, 0] @ sideways > 0.0
        assert abs(frame[:3, 1] @ sideways) < 1e-6


def test_x_is_anterior_unless_the_device_looks_there() -> None:
    down = pose((1.0, 2.0, 3.0), -SUPERIOR)
    np.testing.assert_allclose(down[:3, 0], ANTERIOR)
    np.testing.assert_allclose(pose((0, 0, 0), ANTERIOR)[:3, 0], SUPERIOR)
    np.testing.assert_allclose(pose((0, 0, 0), -ANTERIOR)[:3, 0], SUPERIOR)
    with pytest.raises(ValueError, match="read-only"):
        down[0, 0] = 1.0


@pytest.mark.parametrize(
    ("forward", "sideways", "missing"),
    [
        ((0.0, 0.0, 0.0), None, "forward"),
        ((math.nan, 0.0, 1.0), None, "forward"),
        ((0.0, 0.0, 2.0), (0.0, 0.0, -1.0), "sideways"),
        ((0.0, 0.0, 2.0), (0.0, 0.0, 0.0), "sideways"),
    ],
)
def test_a_pose_needs_two_directions(
    forward: tuple[float, ...], sideways: tuple[float, ...] | None, missing: str
) -> None:
    with pytest.raises(FrameError, match=missing):
        pose((0.0, 0.0, 0.0), forward, sideways)


@given(angle=st.floats(-3.1, 3.1), forward=vectors)
def test_roll_is_the_angle_of_a_bending_direction(angle: float, forward: np.ndarray) -> None:
    assume(np.linalg.norm(forward) > 1e-3)
    frame = pose((5.0, 6.0, 7.0), forward)
    (direction,) = bending_directions(frame, angle)
    assert np.linalg.norm(direction) == pytest.approx(1.0)
    assert abs(direction @ frame[:3, 2]) < 1e-9
    assert roll_towards(frame, direction) == pytest.approx(angle, abs=1e-9)
    # A part along the axis does not turn it.
    assert roll_towards(frame, 3.0 * direction + 2.0 * frame[:3, 2]) == pytest.approx(angle, abs=1e-9)


def test_bending_directions_count_from_x_towards_y() -> None:
    frame = pose((0.0, 0.0, 0.0), (1.0, 1.0, 0.0))
    x, y, _z = frame[:3, :3].T
    np.testing.assert_allclose(bending_directions(frame, [0.0, math.pi / 2, math.pi]), [x, y, -x], atol=1e-12)


def test_arcs_from_many_frames_are_those_from_each() -> None:
    frames = np.array([pose((1.0, 2.0, n), (0.1 * n, 1.0, -1.0)) for n in range(5)])
    bends, at = np.linspace(-0.02, 0.05, 5), [0.0, 3.0, 7.5]
    each = [poses_on_arc(frame, 0.3, bend, at) for frame, bend in zip(frames, bends, strict=True)]
    np.testing.assert_allclose(poses_on_arc(frames, 0.3, bends, at), each, rtol=0.0, atol=1e-12)
