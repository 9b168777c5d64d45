"""The curves of a plan's devices end where the plan says, and agree with the check's own integration."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lungaccess.judging.checking import shapes
from lungaccess.plans.curves import STEP_MM
from lungaccess.plans.parts import NeedleArc
from lungaccess.plans.plan import Plan
from tests.lungaccess.tube_shapes import stated_shape

lengths_of_arcs = st.lists(
    st.tuples(st.floats(1.0, 30.0), st.floats(-3.1, 3.1), st.floats(0.0, 0.02)), max_size=5
)


def test_tubes_and_needle_end_where_the_plan_says(toy_plan: Plan) -> None:
    scope, tubes, needle = toy_plan.curves()
    np.testing.assert_allclose(scope.lps_from_device[-1], toy_plan.scope.lps_from_scope_tip, atol=1e-12)
    np.testing.assert_allclose(tubes.points_lps[0], toy_plan.scope.lps_from_scope_tip[:3, 3])
    np.testing.assert_allclose(tubes.points_lps[-1], toy_plan.tube.lps_from_tip[:3, 3], atol=1e-9)
    np.testing.assert_allclose(needle.points_lps[-1], toy_plan.needle.end_lps, atol=1e-9)
    for curve, length in ((tubes, toy_plan.tube.inner_insertion_mm), (needle, toy_plan.needle.length_mm)):
        assert curve.arc_length_mm[-1] == pytest.approx(length)
        chords = np.linalg.norm(np.diff(curve.points_lps, axis=0), axis=1)
        assert chords.sum() == pytest.approx(length, rel=1e-4)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(arcs=lengths_of_arcs)
def test_any_needle_is_the_one_that_the_check_integrates(arcs: list[Any], toy_plan: Plan) -> None:
    needle = replace(
        toy_plan.needle,
        arcs=tuple(NeedleArc(length_mm=a, roll_rad=b, curvature_per_mm=c) for a, b, c in arcs),
    )
    curve = replace(toy_plan, needle=needle).curves().needle
    pieces = [shapes.Piece(length_mm=a, roll_rad=b, curvature_per_mm=c) for a, b, c in arcs]
    integrated = shapes.integrate(needle.lps_from_start, pieces)
    np.testing.assert_allclose(curve.lps_from_device[-1], integrated.end, atol=1e-6)
    assert curve.arc_length_mm[-1] == pytest.approx(integrated.arc_mm[-1])
    assert (np.diff(curve.arc_length_mm) > 0.0).all()
    assert np.diff(curve.arc_length_mm).max(initial=0.0) <= STEP_MM + 1e-9


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(outer=st.floats(0.0, 40.0), more=st.floats(0.1, 30.0))
def test_any_tubes_are_the_ones_that_the_check_integrates(outer: float, more: float, toy_plan: Plan) -> None:
    shape = stated_shape(toy_plan.system.tubes, outer, outer + more)
    tube = replace(toy_plan.tube, outer_insertion_mm=outer, inner_insertion_mm=outer + more, shape=shape)
    plan = replace(toy_plan, tube=tube)
    curve = plan.curves().tubes
    integrated = shapes.integrate(toy_plan.scope.lps_from_scope_tip, shapes.tube_pieces(plan))
    np.testing.assert_allclose(curve.lps_from_device[-1], integrated.end, atol=1e-6)
    nearest = shapes.distance_to_polyline(curve.points_lps, integrated.points)
    assert nearest.max() < 1e-4
    assert curve.arc_length_mm[-1] == pytest.approx(outer + more)
