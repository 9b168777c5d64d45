"""Tips on the medial axis: between points, along the tree, drawn by length."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chisquare

from anatomy.airway_tree import AirwayTree
from stages.scope.tips import (
    ARC_PIECE_RAD,
    MAX_TURN_AT_TIP_RAD,
    MedialAxis,
    approach,
    leaving_point,
    looks_ahead,
    step_length_mm,
    tip_at,
    turned_aside,
    walk,
)
from tests.stages.scenes import forked_tree

CARINA = np.array([0.0, 0.0, 20.0])
TREE = forked_tree(
    [
        (np.array([0.0, 0.0, 44.0]), CARINA, 6.0, -1),
        (CARINA, np.array([26.0, 0.0, -4.0]), 4.0, 0),
        (CARINA, np.array([-10.0, 0.0, 10.0]), 4.0, 0),
        (np.array([26.0, 0.0, -4.0]), np.array([26.0, 30.0, -4.0]), 2.0, 1),
    ]
)


def depth_mm(tree: AirwayTree, point: int, back_mm: float) -> float:
    return float(tree.distance_from_root_mm[point]) - back_mm


def test_a_tip_at_a_point() -> None:
    tip = tip_at(TREE, 30)
    assert np.allclose(tip.lps_from_scope_tip[:3, 3], TREE.points_lps[30])
    assert np.allclose(tip.lps_from_scope_tip[:3, 2], TREE.tangents[30])
    assert (tip.tree_point, tip.back_mm) == (30, 0.0)


@given(point=st.integers(0, TREE.n_points - 1), back=st.floats(-1.0, 3.0))
def test_a_tip_before_a_point(point: int, back: float) -> None:
    """Is on the segment to the parent, no farther back than that, and a proper frame."""
    tip = tip_at(TREE, point, back)
    expected = min(max(back, 0.0), step_length_mm(TREE, point))
    assert tip.back_mm == pytest.approx(expected)
    parent = max(int(TREE.parent_point[point]), 0)
    position, frame = tip.lps_from_scope_tip[:3, 3], tip.lps_from_scope_tip[:3, :3]
    assert np.linalg.norm(position - TREE.points_lps[point]) == pytest.approx(expected)
    assert np.linalg.norm(position - TREE.points_lps[parent]) == pytest.approx(
        step_length_mm(TREE, point) - expected
    )
    assert np.allclose(frame.T @ frame, np.eye(3)) and np.linalg.det(frame) == pytest.approx(1.0)


def test_the_root_has_no_step() -> None:
    assert step_length_mm(TREE, 0) == 0.0
    assert tip_at(TREE, 0, 2.0).back_mm == 0.0


def test_looking_ahead() -> None:
    """Along a branch; not square to it just behind a sharp fork; yes again farther on."""
    corner = TREE.branch_points(3)
    assert looks_ahead(TREE, tip_at(TREE, 0))
    assert all(looks_ahead(TREE, tip_at(TREE, int(p))) for p in TREE.branch_points(1))
    assert not looks_ahead(TREE, tip_at(TREE, int(corner[0])))
    assert looks_ahead(TREE, tip_at(TREE, int(corner[-1])))
    turned = [math.acos(float(np.clip(_chord(int(p)) @ TREE.tangents[p], -1, 1))) for p in corner]
    for point, angle in zip(corner, turned, strict=True):
        assert looks_ahead(TREE, tip_at(TREE, int(point))) == (angle <= MAX_TURN_AT_TIP_RAD)


def _chord(point: int) -> np.ndarray:
    """Direction to a point from the first point of its route that is 2 mm or more away."""
    route = TREE.points_lps[TREE.route(point)[::-1]]
    apart = np.linalg.norm(route - route[0], axis=1)
    begin = route[np.argmax(apart >= 2.0)]
    return np.asarray((route[0] - begin) / np.linalg.norm(route[0] - begin))


@given(point=st.integers(1, TREE.n_points - 1), back=st.floats(0.0, 0.5), distance=st.floats(-80.0, 0.0))
def test_walking_back_follows_the_route(point: int, back: float, distance: float) -> None:
    tip = tip_at(TREE, point, back)
    moved = walk(TREE, tip, distance, np.random.default_rng(0))
    assert depth_mm(TREE, moved.tree_point, moved.back_mm) == pytest.approx(
        max(depth_mm(TREE, point, tip.back_mm) + distance, 0.0), abs=1e-9
    )
    assert moved.tree_point in TREE.route(point)


@given(point=st.integers(0, TREE.n_points - 1), distance=st.floats(0.0, 120.0), seed=st.integers(0, 99))
def test_walking_on_stays_on_the_way_down(point: int, distance: float, seed: int) -> None:
    moved = walk(TREE, tip_at(TREE, point), distance, np.random.default_rng(seed))
    gone = depth_mm(TREE, moved.tree_point, moved.back_mm) - depth_mm(TREE, point, 0.0)
    assert point in TREE.route(moved.tree_point)
    at_an_end = not (TREE.parent_point == moved.tree_point).any() and moved.back_mm == 0.0
    assert gone == pytest.approx(distance, abs=1e-9) or (at_an_end and gone <= distance)


def test_walking_takes_either_fork() -> None:
    rng = np.random.default_rng(0)
    last = TREE.carina_point
    ends = [walk(TREE, tip_at(TREE, last), 5.0, rng).lps_from_scope_tip[0, 3] > 0 for _ in range(200)]
    assert 60 < sum(ends) < 140


def test_walking_nowhere() -> None:
    tip = tip_at(TREE, 40, 0.2)
    moved = walk(TREE, tip, 0.0, np.random.default_rng(0))
    assert np.allclose(moved.lps_from_scope_tip, tip.lps_from_scope_tip)


def test_the_medial_axis_is_drawn_uniformly_by_length() -> None:
    allowed = np.ones(TREE.n_points, dtype=bool)
    allowed[TREE.branch_points(2)] = False
    axis = MedialAxis(TREE, allowed)
    lengths = TREE.branch_length_mm
    assert axis.length_mm == pytest.approx(lengths[[0, 1, 3]].sum())
    rng = np.random.default_rng(1)
    tips = [axis.sample(rng) for _ in range(6000)]
    branch = TREE.branch_of_point[[tip.tree_point for tip in tips]]
    assert not (branch == 2).any()
    for b, bins in ((0, 24), (1, 30), (3, 20)):
        begin = TREE.distance_from_root_mm[TREE.branch_points(b)[-1]] - lengths[b]
        at = [
            depth_mm(TREE, t.tree_point, t.back_mm) - begin
            for t, at_b in zip(tips, branch == b, strict=True)
            if at_b
        ]
        counts, _ = np.histogram(at, bins=bins, range=(0.0, float(lengths[b])))
        assert counts.sum() == pytest.approx(6000 * lengths[b] / axis.length_mm, rel=0.1)
        assert chisquare(counts).pvalue > 0.01


def test_an_empty_axis() -> None:
    assert MedialAxis(TREE, np.zeros(TREE.n_points, dtype=bool)).length_mm == 0.0


@pytest.mark.parametrize("polar_deg", [0.0, 10.0, 20.0, 30.0])
@pytest.mark.parametrize("azimuth", [0.0, 2.0, 4.5])
def test_a_turned_tip_leaves_the_axis_gently(polar_deg: float, azimuth: float) -> None:
    along = tip_at(TREE, int(TREE.branch_points(1)[-1]))
    tip = turned_aside(TREE, along, math.radians(polar_deg), azimuth)
    line = approach(TREE, tip)
    assert line is not None
    pose = tip.lps_from_scope_tip
    assert np.allclose(line[-1], pose[:3, 3]) and np.allclose(
        line[0], TREE.points_lps[leaving_point(TREE, tip)]
    )
    steps = np.diff(line, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    assert lengths.max() <= 2.5 + 1e-9
    assert np.allclose(steps[-1] / lengths[-1], pose[:3, 2], atol=1e-9)
    cosines = (steps[:-1] * steps[1:]).sum(axis=1) / (lengths[:-1] * lengths[1:])
    turns = np.arccos(np.clip(cosines, -1.0, 1.0))
    assert turns.max() <= ARC_PIECE_RAD + 1e-9
    assert turns.sum() == pytest.approx(math.radians(polar_deg), abs=0.35)
    chord = line[-1] - line[0]
    cosine = chord @ pose[:3, 2] / np.linalg.norm(chord)
    assert math.acos(min(cosine, 1.0)) == pytest.approx(math.radians(polar_deg), abs=1e-6)


def test_no_scope_bends_without_room() -> None:
    along = tip_at(TREE, int(TREE.branch_points(1)[-1]))
    assert approach(TREE, turned_aside(TREE, along, math.radians(150.0), 0.0)) is None


@given(distance=st.floats(-6.0, 3.0), polar=st.floats(0.05, 0.7), azimuth=st.floats(-3.0, 3.0))
def test_a_turned_tip_stays_turned_on_its_walk(distance: float, polar: float, azimuth: float) -> None:
    tip = turned_aside(TREE, tip_at(TREE, int(TREE.branch_points(1)[-3])), polar, azimuth)
    moved = walk(TREE, tip, distance, np.random.default_rng(0))
    assert moved.turned
    for each in (tip, moved):
        chord = each.lps_from_scope_tip[:3, 3] - TREE.points_lps[leaving_point(TREE, each)]
        cosine = chord @ each.lps_from_scope_tip[:3, 2] / np.linalg.norm(chord)
        assert math.acos(min(float(cosine), 1.0)) == pytest.approx(polar, abs=1e-6)
