"""Arc paths against small steps of their own, and paths taken out of search trees."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from anatomy.base.typed import Float
from anatomy.kernels.arcs import arc_to_point, pose_on_arc
from anatomy.margins import Margins
from anatomy.structures import VESSEL
from stages.needle.device import Needle
from stages.needle.environment import needle_environment
from stages.needle.kernels import tree
from stages.needle.path import ArcPath, arc_transform, blocker_on_path, direct_path, path_from_tree
from tests.stages.scenes import Canvas

ARCS = st.lists(
    st.tuples(
        st.floats(0.0, 40.0), st.floats(-math.pi, math.pi), st.one_of(st.just(0.0), st.floats(0.0, 0.05))
    ),
    min_size=1,
    max_size=5,
)


def start_frame(seed: int) -> Float:
    rng = np.random.default_rng(seed)
    frame = np.eye(4)
    frame[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    frame[:3, 3] = rng.uniform(-100, 100, 3)
    return frame


def walked(start: Float, arcs: list[tuple[float, float, float]], steps: int) -> list[Float]:
    """Frames along the path: turn a little about +y, go a little along +z, again and again."""
    frames = [start]
    for length, roll, kappa in arcs:
        rolled = np.eye(4)
        rolled[:3, :3] = Rotation.from_rotvec([0, 0, roll]).as_matrix()
        frame = frames[-1] @ rolled
        small = np.eye(4)
        half = Rotation.from_rotvec([0, 0.5 * kappa * length / steps, 0]).as_matrix()
        small[:3, :3] = half @ half
        small[:3, 3] = half @ [0, 0, length / steps]
        for _ in range(steps):
            frame = frame @ small
            frames.append(frame)
    return frames


@given(arcs=ARCS, seed=st.integers(0, 1000))
def test_frames_agree_with_small_steps(arcs: list[tuple[float, float, float]], seed: int) -> None:
    path = ArcPath(lps_from_start=start_frame(seed), arcs=np.array(arcs))
    expected = walked(start_frame(seed), arcs, 200)[::200]
    assert np.abs(path.frames() - np.stack(expected)).max() < 1e-3
    rotations = path.frames()[:, :3, :3]
    assert np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max() < 1e-12


@given(arcs=ARCS, seed=st.integers(0, 1000), step=st.floats(0.3, 30.0))
def test_samples(arcs: list[tuple[float, float, float]], seed: int, step: float) -> None:
    path = ArcPath(lps_from_start=start_frame(seed), arcs=np.array(arcs))
    points, lengths = path.sample(step)
    assert np.array_equal(points[0], start_frame(seed)[:3, 3]) and lengths[0] == 0.0
    assert np.allclose(points[-1], path.frames()[-1][:3, 3], atol=1e-9)
    assert lengths[-1] == pytest.approx(path.length_mm)
    assert (np.diff(lengths) >= 0).all() and np.diff(lengths).max() <= step + 1e-9
    gaps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert (gaps <= np.diff(lengths) + 1e-9).all()
    whole = np.interp(lengths, *_dense(path))
    assert np.abs(whole - points[:, 0]).max() < 0.05


def _dense(path: ArcPath) -> tuple[Float, Float]:
    """Arc length and x along the path in steps of a hundredth of each arc."""
    frames = walked(path.lps_from_start, [tuple(a) for a in path.arcs], 100)
    lengths = np.concatenate([[0.0], np.cumsum(np.repeat(path.arcs[:, 0] / 100, 100))])
    return lengths + 1e-12 * np.arange(len(lengths)), np.array([f[0, 3] for f in frames])


@given(arcs=ARCS, seed=st.integers(0, 1000))
def test_largest_angle_from_the_start(arcs: list[tuple[float, float, float]], seed: int) -> None:
    path = ArcPath(lps_from_start=start_frame(seed), arcs=np.array(arcs))
    tangents = np.array([f[:3, 2] for f in walked(start_frame(seed), arcs, 300)])
    dense = math.acos(float(np.clip(tangents @ tangents[0], -1, 1).min()))
    assert path.max_angle_from_start_rad() == pytest.approx(dense, abs=0.02)
    assert path.max_angle_from_start_rad() >= dense - 1e-6


def test_the_largest_angle_can_lie_within_an_arc() -> None:
    """Out by 60 degrees, then an arc square to that, which goes farther and comes back."""
    kappa = 0.05
    arcs = [(math.radians(60) / kappa, 0.0, kappa), (math.radians(240) / kappa, math.radians(80), kappa)]
    path = ArcPath(lps_from_start=np.eye(4), arcs=np.array(arcs))
    ends = [math.acos(float(frame[2, 2])) for frame in path.frames()]
    assert path.max_angle_from_start_rad() > max(ends) + math.radians(10)


def test_turn_and_length_are_sums() -> None:
    path = ArcPath(
        lps_from_start=np.eye(4), arcs=np.array([[10.0, 0.3, 0.02], [5.0, 1.0, 0.0], [4.0, 0, 0.05]])
    )
    assert path.length_mm == 19.0
    assert path.accumulated_turn_rad == pytest.approx(0.4)


def test_arrays_cannot_be_written() -> None:
    start, arcs = np.eye(4), np.array([[1.0, 0.0, 0.0]])
    path = ArcPath(lps_from_start=start, arcs=arcs)
    start[0, 3] = 7.0
    assert path.lps_from_start[0, 3] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        path.arcs[0, 0] = 2.0
    with pytest.raises(ValueError, match="read-only"):
        path.lps_from_start[0, 3] = 2.0


@given(seed=st.integers(0, 10000))
def test_direct_path_ends_at_the_target(seed: int) -> None:
    target = start_frame(seed)[:3, 3] + np.random.default_rng(seed).normal(size=3) * 20
    path = direct_path(start_frame(seed), target)
    assert np.linalg.norm(path.frames()[-1][:3, 3] - target) < 1e-9
    assert len(path.arcs) == 1 and path.arcs[0, 2] >= 0.0


def test_direct_path_straight_ahead() -> None:
    path = direct_path(np.eye(4), [0.0, 0.0, 12.0])
    assert path.arcs[0].tolist()[::2] == [12.0, 0.0]


def test_half_a_circle_with_small_curvature_is_no_special_case() -> None:
    for kappa in (0.0, 1e-12, 1e-7, 1e-5, 1e-3):
        end = arc_transform(30.0, 0.0, kappa)
        assert end[0, 3] == pytest.approx(0.5 * kappa * 900.0, rel=1e-3, abs=1e-15)


def test_path_from_tree() -> None:
    """A tree of three nodes and a side branch, made arc by arc with the arc kernels."""
    start = start_frame(4)
    nodes, parents = np.zeros((6, tree.NODE_COLUMNS)), np.zeros(6, dtype=np.int64)
    nodes[0, :3], nodes[0, 3:6] = start[:3, 3], start[:3, 2]
    goals = np.random.default_rng(0).normal(size=(4, 3)) * 4
    for n, parent in enumerate([0, 1, 0, 2], start=1):
        pose = tuple(nodes[parent, :6])
        q = nodes[parent, :3] + 30 * nodes[parent, 3:6] + goals[n - 1]
        length, bend, _ = arc_to_point(pose, tuple(q))
        nodes[n, :6] = pose_on_arc(pose, bend, length)
        nodes[n, tree.ARC_LENGTH] = length
        nodes[n, tree.BEND : tree.BEND + 4] = bend
        parents[n] = parent
    for last, arcs in ((1, 1), (2, 2), (3, 1), (4, 3)):
        path = path_from_tree(start, nodes, parents, last)
        assert len(path.arcs) == arcs
        assert np.allclose(path.frames()[-1][:3, 3], nodes[last, :3], atol=1e-9)
        assert np.allclose(path.frames()[-1][:3, 2], nodes[last, 3:6], atol=1e-9)


def test_a_path_is_proved_arc_by_arc() -> None:
    canvas = Canvas.empty([-15, -15, -5], [15, 15, 35], 1.0)
    canvas.add(canvas.ball([0, 0, 20], 2.0), VESSEL)
    needle = Needle(diameter_mm=1.0, max_curvature_per_mm=0.05)
    environment = needle_environment(canvas.lung(), needle, Margins(), with_fissures=False)
    clear = ArcPath(lps_from_start=np.eye(4), arcs=np.array([[10.0, 0.0, 0.0], [4.0, 0.0, 0.0]]))
    blocked = ArcPath(lps_from_start=np.eye(4), arcs=np.array([[10.0, 0.0, 0.0], [14.0, 0.0, 0.0]]))
    around = ArcPath(
        lps_from_start=np.eye(4), arcs=np.array([[12.0, 1.0, 0.05], [10.0, math.pi, 0.05], [5.0, 0.0, 0.0]])
    )
    assert blocker_on_path(environment, clear, -1) == 0
    assert blocker_on_path(environment, blocked, -1) == VESSEL
    assert blocker_on_path(environment, around, -1) == 0


@pytest.mark.parametrize(
    "target",
    [
        (0, 0, 0), (0, 0, 30), (1e-320, 0, 0), (0, 1e-12, 1e-12), (5, 0, 0), (1e-9, 0, 30), (1e-200, 0, 1),
        (1e-9, 0, -30), (0, 0, 5e-324), (-1e9, 0, 1e-9),
    ],
)  # fmt: skip
def test_the_arc_to_a_coincident_or_collinear_point_ends_there(target: tuple[float, float, float]) -> None:
    path = direct_path(np.eye(4), target)
    assert np.isfinite(path.arcs).all()
    error_mm = np.linalg.norm(path.frames()[-1][:3, 3] - target)
    assert error_mm <= 1e-9 + 16 * np.finfo(float).eps * path.arcs[0, 0]


def test_no_arc_leads_straight_back() -> None:
    assert direct_path(np.eye(4), (0, 0, -30)).arcs[0, 0] == math.inf
