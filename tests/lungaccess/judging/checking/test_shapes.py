"""The re-integrated kinematics agree with closed forms, and the box distances with brute force."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from anatomy import structures
from lungaccess.judging.checking import shapes
from lungaccess.judging.checking.boxes import (
    Boxes,
    PathDistances,
    Select,
    Tiles,
    airway_except,
    has,
    labels_at,
    not_lumen,
)
from lungaccess.judging.checking.findings import angle_between

ARC = st.tuples(st.floats(0.01, 20.0), st.floats(-6.3, 6.3), st.floats(0.0, 0.05))


@settings(max_examples=30)
@given(arcs=st.lists(ARC, min_size=1, max_size=4))
def test_re_integration_against_closed_arcs(tools: Any, arcs: list[tuple[float, float, float]]) -> None:
    pieces = [shapes.Piece(length_mm=a, roll_rad=b, curvature_per_mm=c) for a, b, c in arcs]
    curve = shapes.integrate(np.eye(4), pieces)
    frames, _ = tools.follow(np.eye(4), arcs, 1.0)
    np.testing.assert_allclose(curve.end, frames[-1], atol=1e-7)
    assert np.isclose(curve.arc_mm[-1], sum(a for a, _, _ in arcs))
    assert np.linalg.norm(np.diff(curve.points, axis=0), axis=1).max() <= shapes.STEP_MM + 1e-9
    turned = angle_between(curve.tangents[:-1], curve.tangents[1:]).sum()
    assert np.isclose(turned, sum(a * c for a, _, c in arcs), atol=1e-6)


@given(at=st.floats(0.0, 12.0))
def test_a_cut_changes_no_pose(at: float) -> None:
    pieces = [
        shapes.Piece(length_mm=4.0, roll_rad=0.3, curvature_per_mm=0.01),
        shapes.Piece(length_mm=6.0, roll_rad=-1.3, curvature_per_mm=0.03),
    ]
    cut = shapes.integrate(np.eye(4), shapes.cut_at(pieces, at))
    np.testing.assert_allclose(cut.end, shapes.integrate(np.eye(4), pieces).end, atol=1e-9)
    if 0.0 < at < 10.0:
        assert np.abs(cut.arc_mm - at).min() < 1e-8


@given(curvature=st.floats(0.0, 1.0), length=st.floats(1e-6, 50.0), turn=st.floats(-7.0, 7.0))
def test_exponential_against_that_of_scipy(curvature: float, length: float, turn: float) -> None:
    for matrix in (shapes.twist(curvature) * length, shapes.twist(0.0) * turn):
        np.testing.assert_allclose(shapes.expm(matrix), expm(matrix), rtol=1e-12, atol=1e-12)


SELECTS = (
    has(structures.VESSEL),
    has(structures.AIRWAY),
    has(structures.LUMEN),
    has(structures.OBSTACLES | structures.FISSURE),
    not_lumen,
    airway_except(0),
    airway_except(1),
    airway_except(7),
)
LOW, HIGH = np.array([20.0, -26.0, 5.0]), np.array([88.0, 26.0, 92.0])


def drawn_points(data: st.DataObject, count: int) -> np.ndarray:
    share = data.draw(st.lists(st.floats(0, 1), min_size=3 * count, max_size=3 * count))
    return LOW + np.array(share).reshape(count, 3) * (HIGH - LOW)


@pytest.fixture(scope="module")
def tiles(lung: Any) -> Tiles:
    """One for all examples: what was kept from the one before must serve the next."""
    return Tiles(lung)


def wanted_mm(lung: Any, tools: Any, select: Select, points: np.ndarray) -> np.ndarray:
    """Brute force over every voxel of the lung and of a rim of two voxels around it, which is outside."""
    labels = np.pad(lung.labels, 2, constant_values=structures.OUTSIDE)
    grid = lung.grid.crop((-2, -2, -2), np.asarray(lung.labels.shape) + 2)
    return np.asarray(tools.brute_distance(SimpleNamespace(grid=grid), select(labels), points))


@settings(max_examples=25)
@given(data=st.data(), select=st.sampled_from(SELECTS))
def test_box_distances_against_brute_force(
    lung: Any, tiles: Tiles, tools: Any, data: st.DataObject, select: Select
) -> None:
    points = drawn_points(data, 4)
    wanted = wanted_mm(lung, tools, select, points)
    np.testing.assert_allclose(Boxes(tiles, select, 20.0).distance_mm(points), wanted, atol=1e-9)
    np.testing.assert_allclose(Boxes(Tiles(lung), select, 20.0).distance_mm(points), wanted, atol=1e-9)


@settings(max_examples=25)
@given(data=st.data(), select=st.sampled_from(SELECTS))
def test_least_distance_of_a_path_is_that_of_its_points(
    tiles: Tiles, data: st.DataObject, select: Select
) -> None:
    corners = drawn_points(data, 3)
    t = np.linspace(0.0, 1.0, 150)[:, None]
    path = np.concatenate([a + t * (b - a) for a, b in zip(corners[:-1], corners[1:], strict=True)])
    boxes = Boxes(tiles, select, 20.0)
    assert PathDistances(boxes, path).least_mm() == boxes.distance_mm(path).min()


@settings(max_examples=25)
@given(data=st.data(), select=st.sampled_from(SELECTS), within=st.floats(0.3, 20.0))
def test_segments_and_points_give_the_same_clearance(
    tiles: Tiles, data: st.DataObject, select: Select, within: float
) -> None:
    """FCL on the exact surface against the search among boxes."""
    a, b = drawn_points(data, 2)
    path = a + np.linspace(0.0, 1.0, 200)[:, None] * (b - a)
    boxes = Boxes(tiles, select, 20.0)
    segments, exact = PathDistances(boxes, path).segments_mm(within), boxes.distance_mm(path)
    step = float(np.linalg.norm(path[1] - path[0]))
    ends = np.minimum(exact[:-1], exact[1:])
    assert (segments <= np.minimum(ends, within) + 1e-9).all()
    assert (segments >= np.minimum(ends - step / 2, within) - 1e-9).all()


def test_a_segment_is_never_farther_than_its_ends(tiles: Tiles) -> None:
    """FCL overlooks the nearest face beside some of these segments, which are parallel to it."""
    path = np.linspace([47.625, -26.0, 5.0], [47.625, 26.0, 5.0], 200)
    boxes = Boxes(tiles, has(structures.OBSTACLES | structures.FISSURE), 20.0)
    exact = boxes.distance_mm(path)
    segments = PathDistances(boxes, path).segments_mm(1.0)
    assert (segments <= np.minimum(exact[:-1], exact[1:])).all()
    assert (exact > 0.0).sum() > 50


def test_beyond_the_grid_is_outside(lung: Any) -> None:
    far = lung.grid.lps([[-3.0, 5.0, 5.0], [5.0, 5.0, 500.0]])
    assert (labels_at(lung, far) == structures.OUTSIDE).all()
    assert (Boxes(Tiles(lung), has(structures.OUTSIDE), 20.0).distance_mm(far) == 0.0).all()
    assert (Boxes(Tiles(lung), has(structures.VESSEL), 20.0).distance_mm(far)[1] == 20.0).all()
