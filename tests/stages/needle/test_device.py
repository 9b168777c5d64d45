"""The needle's settings."""

from __future__ import annotations

from typing import Any

import pytest

from anatomy.base.errors import SettingsError
from anatomy.shafts import SlottedSegment
from stages.needle.device import Needle

NEEDLE: dict[str, Any] = {"diameter_mm": 1.0, "max_curvature_per_mm": 1.0 / 121.0}
SLOTS: dict[str, float] = {"length_mm": 200.0, "stiffness_factor": 0.1, "strain_factor": 0.75}


def test_radii() -> None:
    needle = Needle(**NEEDLE)
    assert needle.radius_mm == 0.5
    assert needle.min_radius_of_curvature_mm == pytest.approx(121.0, rel=1e-15)


def test_defaults_are_the_stated_limits() -> None:
    needle = Needle(**NEEDLE)
    assert (needle.max_angle_from_start_deg, needle.max_accumulated_turn_deg) == (90.0, 180.0)
    assert (needle.max_length_mm, needle.exit_exemption_mm) == (150.0, 5.0)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("diameter_mm", -1.0),
        ("diameter_mm", 10.0),
        ("max_curvature_per_mm", 0.0),
        ("max_curvature_per_mm", float("nan")),
        ("max_curvature_per_mm", 121.0),
        ("max_length_mm", float("inf")),
        ("max_angle_from_start_deg", 0.0),
        ("max_angle_from_start_deg", 181.0),
        ("max_accumulated_turn_deg", -180.0),
        ("exit_exemption_mm", -5.0),
        ("exit_exemption_mm", 100.0),
        ("inner_diameter_mm", 1.0),
        ("inner_diameter_mm", -0.1),
        ("youngs_modulus_gpa", -1.0),
        ("poisson_ratio", 0.5),
        ("slotted_segments", (SlottedSegment(from_tip_mm=5.0, **SLOTS), SlottedSegment(**SLOTS))),
    ],
)
def test_impossible_needles_are_refused(key: str, value: float) -> None:
    with pytest.raises(SettingsError, match=key):
        Needle(**(NEEDLE | {key: value}))


def test_slots_count_for_strain_as_far_as_they_cover_what_passes_a_bend() -> None:
    plain = Needle(**NEEDLE)
    slotted = Needle(**NEEDLE, slotted_segments=(SlottedSegment(**SLOTS),))
    assert plain.most_bent_per_mm(500.0) == pytest.approx(0.16)
    assert slotted.most_bent_per_mm(200.0) == pytest.approx(0.16 / 0.75)
    assert slotted.most_bent_per_mm(200.1) == pytest.approx(0.16)
    behind = Needle(**NEEDLE, slotted_segments=(SlottedSegment(from_tip_mm=1.0, **SLOTS),))
    assert behind.most_bent_per_mm(100.0) == pytest.approx(0.16)
