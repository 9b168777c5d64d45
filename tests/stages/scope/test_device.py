"""The bronchoscope's settings."""

from __future__ import annotations

import math
from typing import Any

import pytest

from anatomy.base.errors import SettingsError
from stages.scope.device import Bronchoscope

SCOPE: dict[str, Any] = {
    "name": "s",
    "outer_diameter_mm": 4.2,
    "channel_diameter_mm": 2.0,
    "bend_up_deg": 180.0,
    "bend_down_deg": 130.0,
    "bending_length_mm": 15.0,
    "min_bending_radius_mm": 8.0,
    "min_shaft_radius_mm": 10.0,
    "bending_stiffness_n_mm2": 1000.0,
}


def test_radius_is_half_the_diameter() -> None:
    scope = Bronchoscope(**SCOPE)
    assert scope.radius_mm == 2.1
    assert scope.lumen_margin_mm == 0.0


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("outer_diameter_mm", -4.2),
        ("outer_diameter_mm", 42.0),
        ("outer_diameter_mm", float("nan")),
        ("channel_diameter_mm", 0.0),
        ("channel_diameter_mm", 4.2),
        ("lumen_margin_mm", -0.1),
        ("bend_up_deg", 3600.0),
        ("bend_down_deg", -130.0),
        ("bending_length_mm", 0.0),
        ("min_bending_radius_mm", 2.1),
        ("min_shaft_radius_mm", 1.0),
        ("bending_stiffness_n_mm2", 0.0),
        ("rigid_head_mm", 15.0),
        ("name", ""),
    ],
)
def test_impossible_bronchoscopes_are_refused(key: str, value: object) -> None:
    with pytest.raises(SettingsError, match=key):
        Bronchoscope(**(SCOPE | {key: value}))


def test_bends_end_at_the_angle_or_at_the_radius() -> None:
    """15 mm in a radius of 8 mm are 1.875 rad, 107 degrees: less than 130 and than 180."""
    assert Bronchoscope(**SCOPE).bends_rad == pytest.approx((-1.875, 1.875))
    gentle = Bronchoscope(**(SCOPE | {"bend_down_deg": 90.0}))
    assert gentle.bends_rad == pytest.approx((-math.pi / 2, 1.875))


def test_the_shaft_lies_in_the_wider_of_both_radii() -> None:
    assert Bronchoscope(**SCOPE).laying_curvature_per_mm == pytest.approx(0.1)
    assert Bronchoscope(**(SCOPE | {"min_shaft_radius_mm": 5.0})).laying_curvature_per_mm == pytest.approx(
        0.125
    )
