"""The tubes' settings."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from anatomy.base.errors import SettingsError
from stages.tube.device import ConcentricTubes, Tube
from tests.stages.tube.pairs import WIDE

INNER, OUTER = replace(WIDE.inner, length_mm=660.0), WIDE.outer
TUBES = ConcentricTubes(outer=OUTER, inner=INNER)


@pytest.mark.parametrize(("tube", "stiffness_n_m2"), [(INNER, 6.498e-3), (OUTER, 1.655e-2)])
def test_bending_stiffness_of_thin_nitinol_tubes(tube: Tube, stiffness_n_m2: float) -> None:
    assert 1e-6 * tube.bending_stiffness_n_mm2 == pytest.approx(stiffness_n_m2, rel=5e-4)


def test_overlapped_curvature_of_the_default_pair() -> None:
    stiffness = INNER.bending_stiffness_n_mm2
    shared = INNER.precurvature_per_mm * stiffness / (stiffness + OUTER.bending_stiffness_n_mm2)
    assert 1e3 * shared == pytest.approx(7.05, abs=0.005)


def test_strain_at_rest() -> None:
    assert INNER.rest_strain == pytest.approx(0.01875)
    assert OUTER.rest_strain == 0.0


def test_inner_tube_can_be_ahead_by_the_difference_of_lengths() -> None:
    assert TUBES.max_inner_protrusion_mm == 20.0


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"outer_diameter_mm": -1.5}, "outer_diameter_mm"),
        ({"inner_diameter_mm": 1.5}, "inner_diameter_mm"),
        ({"length_mm": 0.0}, "length_mm"),
        ({"length_mm": float("nan")}, "length_mm"),
        ({"curved_length_mm": 400.0, "length_mm": 300.0}, "curved_length_mm"),
        ({"curved_length_mm": 0.0}, "precurvature_per_mm"),
        ({"precurvature_per_mm": 0.0}, "precurvature_per_mm"),
        ({"precurvature_per_mm": -0.025}, "precurvature_per_mm"),
        ({"youngs_modulus_gpa": 0.0}, "youngs_modulus_gpa"),
        ({"poisson_ratio": 0.5}, "poisson_ratio"),
    ],
)
def test_impossible_tubes_are_refused(changes: dict[str, float], key: str) -> None:
    with pytest.raises(SettingsError, match=key):
        replace(INNER, **changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"inner": replace(INNER, outer_diameter_mm=1.65)}, r"inner\.outer_diameter_mm = 1\.65"),
        ({"inner": replace(INNER, length_mm=639.0)}, r"inner\.length_mm = 639\.0"),
        ({"inner": replace(INNER, precurvature_per_mm=0.054)}, r"inner\.precurvature_per_mm = 0\.054"),
        ({"max_strain": 0.018}, r"inner\.precurvature_per_mm = 0\.025"),
        ({"max_extension_mm": 0.0}, "max_extension_mm"),
        (
            {"outer": replace(OUTER, length_mm=50.0), "inner": replace(INNER, length_mm=59.0)},
            r"max_extension_mm = 60\.0",
        ),
        ({"max_lateral_sweep_mm": -1.0}, "max_lateral_sweep_mm"),
        ({"min_wall_angle_deg": 91.0}, "min_wall_angle_deg"),
        ({"max_strain": 0.5}, "max_strain"),
    ],
)
def test_pairs_that_cannot_work_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        replace(TUBES, **changes)


def test_strain_limit_is_inclusive() -> None:
    limit = TUBES.max_strain / INNER.radius_mm
    at_limit = replace(INNER, precurvature_per_mm=limit * (1.0 - 1e-12))
    assert replace(TUBES, inner=at_limit).inner.rest_strain <= TUBES.max_strain
    with pytest.raises(SettingsError, match="strain"):
        replace(TUBES, inner=replace(INNER, precurvature_per_mm=limit * (1.0 + 1e-12)))
