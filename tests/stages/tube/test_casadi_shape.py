"""Shapes of any design against the CasADi model, which shares nothing with the kernels."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.tube import ConvergenceError, Tube, TubeMechanics, derive_shape, tube_shapes
from tests.stages.tube.pairs import WIDE
from tests.stages.tube.test_shapes import ANY, COARSE, PAIR, TRIPLE, point_at, tube


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tubes", "count"),
    [((WIDE.inner, WIDE.outer), 1), (PAIR, 2), (TRIPLE, 1)],
    ids=["planar", "two", "three"],
)
def test_arcs_are_the_derived_shape(tubes: tuple[Tube, ...], count: int) -> None:
    shapes = tube_shapes(tubes, ANY, COARSE)
    far = np.flatnonzero((shapes.insertions_mm[:, 0] == 45.0) & (shapes.insertions_mm[:, -1] == 15.0))
    for shape in np.random.default_rng(3).choice(far, count, replace=False):
        derived = derive_shape(tubes, shapes.rotations_rad[shape], shapes.insertions_mm[shape])
        tip = shapes.scope_from_tip[shape]
        assert derived.base_from_tip[:3, 2:] == pytest.approx(tip[:3, 2:], abs=1e-5)
        assert derived.arc_lengths_mm[0] == pytest.approx(0.0, abs=1e-9)
        assert derived.points_mm[0] == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)
        assert (np.diff(derived.arc_lengths_mm) >= 0.0).all() and derived.arc_lengths_mm[-1] == 45.0
        arcs = shapes.arcs_of(shape)
        laid = np.array([point_at(arcs, s) for s in derived.arc_lengths_mm])
        off = np.linalg.norm(derived.points_mm - laid, axis=1).max()
        assert off <= shapes.arc_error_mm[shape] + 1e-5
        assert derived.at([22.5])[0] == pytest.approx(point_at(arcs, 22.5), abs=0.02)


def test_another_deployment_is_not_taken_for_it() -> None:
    """Half a degree or half a millimetre of claim against truth shows."""
    derived = derive_shape(PAIR, (0.0, 1.0), (40.0, 20.0))
    mechanics = TubeMechanics(PAIR)
    for rotations, insertions in (((0.0, 1.0 + math.radians(0.5)), (40.0, 20.0)), ((0.0, 1.0), (40.0, 20.5))):
        beta = np.array(insertions) - mechanics.lengths_mm
        other = mechanics.given_base_angles(np.array(rotations) + 0.5 * math.pi, beta)
        assert np.linalg.norm(other.base_from_tip[:3, 3] - derived.base_from_tip[:3, 3]) > 0.005


def test_where_tubes_snap_there_is_no_shape() -> None:
    tubes = (tube(1, 0.02), tube(2, 0.02))
    with pytest.raises(ConvergenceError, match="determinant"):
        derive_shape(tubes, (0.0, math.pi), (20.0, 20.0))
