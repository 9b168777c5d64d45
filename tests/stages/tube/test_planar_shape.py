"""The shape of straight outer and curved inner tube, and its sweep, against integration."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anatomy.margins import Margins
from stages.tube import kernels, tube_constants
from tests.stages.tube.flat_wall import CURVED, KAPPA, NUMBERS, OVERLAP, TUBES, tubes_of


def planar_by_steps(outer: float, inner: float, s: float, steps: int = 4000) -> tuple[float, float]:
    """Integrate the curvature along the centreline, midpoint by midpoint."""
    at = (np.arange(steps) + 0.5) * s / steps
    straight = max(inner - CURVED, 0.0)
    kappa = np.where(at < straight, 0.0, np.where(at < outer, OVERLAP, KAPPA))
    angle = np.concatenate([[0.0], np.cumsum(kappa * s / steps)])
    middle = 0.5 * (angle[1:] + angle[:-1])
    return float(np.sin(middle).sum() * s / steps), float(np.cos(middle).sum() * s / steps)


class TestShape:
    """`planar_point` and `lateral_sweep`."""

    def test_the_stiffer_outer_tube_straightens_the_overlap(self) -> None:
        stiffness = [t.outer_diameter_mm**4 - t.inner_diameter_mm**4 for t in (TUBES.inner, TUBES.outer)]
        assert pytest.approx(KAPPA * stiffness[0] / sum(stiffness)) == OVERLAP
        assert 0 < OVERLAP < 0.5 * KAPPA

    def test_inner_tube_alone_is_one_arc(self) -> None:
        aside, ahead = kernels.planar_point(NUMBERS, 0.0, 30.0, 30.0)
        assert aside == pytest.approx((1 - math.cos(0.75)) / KAPPA)
        assert ahead == pytest.approx(math.sin(0.75) / KAPPA)

    def test_covered_wholly_it_is_one_flatter_arc(self) -> None:
        aside, ahead = kernels.planar_point(NUMBERS, 30.0, 30.0, 30.0)
        assert aside == pytest.approx((1 - math.cos(30 * OVERLAP)) / OVERLAP)
        assert ahead == pytest.approx(math.sin(30 * OVERLAP) / OVERLAP)

    def test_beyond_the_curved_length_it_begins_straight(self) -> None:
        assert kernels.planar_point(NUMBERS, 0.0, 55.0, 15.0) == pytest.approx((0.0, 15.0))
        aside, ahead = kernels.planar_point(NUMBERS, 0.0, 55.0, 55.0)
        assert (aside, ahead) == pytest.approx(((1 - math.cos(1.0)) / KAPPA, 15 + math.sin(1.0) / KAPPA))

    def test_without_precurvature_it_is_a_line(self) -> None:
        straight = tube_constants(tubes_of(curved_length_mm=0.0, kappa=0.0), Margins())
        assert kernels.planar_point(straight, 10.0, 30.0, 25.0) == (0.0, 25.0)
        assert kernels.lateral_sweep(straight, 10.0, 50.0) == 0.0

    @given(inner=st.floats(0.0, 60.0), outer=st.floats(0.0, 1.0), s=st.floats(0.0, 1.0))
    def test_agrees_with_integrated_curvature(self, inner: float, outer: float, s: float) -> None:
        found = kernels.planar_point(NUMBERS, outer * inner, inner, s * inner)
        assert found == pytest.approx(planar_by_steps(outer * inner, inner, s * inner), abs=0.02)

    @given(inner=st.floats(0.0, CURVED), outer=st.floats(0.0, 1.0))
    def test_no_sweep_while_the_tip_is_within_the_curved_length(self, inner: float, outer: float) -> None:
        assert kernels.lateral_sweep(NUMBERS, outer * inner, inner) == 0.0

    @given(beyond=st.floats(0.5, 20.0), outer=st.floats(0.0, 1.0))
    @settings(max_examples=40)
    def test_sweep_beyond(self, beyond: float, outer: float) -> None:
        """The straight part pushes the bend ahead, farther the longer it is; against all tips and points."""
        inner = CURVED + beyond
        sweep = kernels.lateral_sweep(NUMBERS, outer * inner, inner)
        assert sweep > 0.0
        assert sweep >= kernels.lateral_sweep(NUMBERS, outer * inner, CURVED + 0.5 * beyond) - 0.02
        worst = 0.0
        for tip in np.linspace(0.0, inner, 61):
            for s in np.linspace(0.0, tip, 61):
                before = kernels.planar_point(NUMBERS, min(tip, outer * inner), tip, s)
                after = kernels.planar_point(NUMBERS, outer * inner, inner, s)
                worst = max(worst, math.dist(before, after))
        assert worst - 1e-3 <= sweep <= worst + 0.25
