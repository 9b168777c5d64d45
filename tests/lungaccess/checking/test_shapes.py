"""The re-integrated kinematics agree with closed forms, and the box distances with brute force."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from anatomy import structures
from lungaccess.checking import shapes
from lungaccess.checking.poses import angle_between
from lungaccess.checking.space import Boxes, has, labels_at, not_lumen, region_around, segment_clearance_mm

ARC = st.tuples(st.floats(0.01, 20.0), st.floats(-6.3, 6.3), st.floats(0.0, 0.05))


@settings(max_examples=30)
@given(arcs=st.lists(ARC, min_size=1, max_size=4))
def test_re_integration_against_closed_arcs(tools: Any, arcs: list[tuple[float, float, float]]) -> None:
    pieces = [shapes.Piece(length_mm=a, roll_rad=b, curvature_per_mm=c) for a, b, c in arcs]
    curve = shapes.integrate(np.eye(4), pieces)
    frames, _ = tools.follow(np.eye(4), [(a, b, c if c > 1e-9 else 0.0) for a, b, c in arcs], 1.0)
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


def test_bend_of_the_tubes(system: Any) -> None:
    """A share of the precurvature in the overlap, all of it beyond, none where the curve is over."""
    tubes = system.tubes
    inner, outer = tubes.inner, tubes.outer
    share = inner.bending_stiffness_n_mm2 / (inner.bending_stiffness_n_mm2 + outer.bending_stiffness_n_mm2)
    bend = shapes.bend_of(tubes, 20.0, 50.0)
    assert bend.edges_mm == (0.0, 10.0, 20.0, 50.0)
    np.testing.assert_allclose(bend.per_mm, (0.0, 0.025 * share, 0.025))
    assert shapes.bend_of(tubes, 0.0, 30.0).per_mm == (0.025,)
    np.testing.assert_allclose(shapes.bend_of(tubes, 30.0, 30.0).per_mm, 0.025 * share)


def test_planar_quadrature_is_the_curve_in_space(system: Any) -> None:
    bend = shapes.bend_of(system.tubes, 22.0, 47.0)
    flat = shapes.planar_shape(bend, 0.25)
    curve = shapes.tube_curve(np.eye(4), 0.0, bend)
    np.testing.assert_allclose(curve.end[[0, 2], 3], flat[-1], atol=1e-5)
    assert shapes.distance_to_polyline(curve.points[::7, [0, 2]], flat).max() < 1e-3


def test_follow_the_leader_within_the_curved_length(system: Any) -> None:
    final = shapes.planar_shape(shapes.bend_of(system.tubes, 15.0, 40.0), 0.1)
    for bend in shapes.deployment_bends(system.tubes, 15.0, 40.0, 3.0):
        assert shapes.distance_to_polyline(shapes.planar_shape(bend, 0.5), final).max() < 1e-3


@settings(max_examples=15)
@given(data=st.data())
def test_box_distances_against_brute_force(lung: Any, tools: Any, data: st.DataObject) -> None:
    low, high = np.array([20.0, -20.0, 5.0]), np.array([75.0, 20.0, 70.0])
    share = np.array(data.draw(st.lists(st.floats(0, 1), min_size=12, max_size=12))).reshape(4, 3)
    points = low + share * (high - low)
    for select in (has(structures.VESSEL), not_lumen, has(structures.AIRWAY | structures.OUTSIDE)):
        boxes = Boxes(region_around(lung, points, 20.0), select)
        wanted = tools.brute_distance(lung, select(lung.labels), points)
        np.testing.assert_allclose(boxes.distance_mm(points), wanted, atol=1e-9)


def test_segments_and_points_give_the_same_clearance(lung: Any, plan: Any) -> None:
    """FCL on the exact surface against the search among boxes."""
    points = plan.needle.lps_from_start[:3, 3] + np.linspace(0, 1, 300)[:, None] * [25.0, 4.0, -6.0]
    boxes = Boxes(region_around(lung, points, 20.0), has(structures.VESSEL))
    segments = segment_clearance_mm(boxes, points, 20.0)
    exact = boxes.distance_mm(points)
    step = float(np.linalg.norm(points[1] - points[0]))
    assert (segments <= np.minimum(exact[:-1], exact[1:]) + 1e-9).all()
    assert (segments >= np.minimum(exact[:-1], exact[1:]) - step / 2 - 1e-9).all()


def test_beyond_the_grid_is_outside(lung: Any) -> None:
    far = lung.grid.lps([[-3.0, 5.0, 5.0], [5.0, 5.0, 500.0]])
    assert (labels_at(lung, far) == structures.OUTSIDE).all()
    boxes = Boxes(region_around(lung, far, 20.0), has(structures.OUTSIDE))
    assert (boxes.distance_mm(far) == 0.0).all()
