"""The bronchoscope's settings."""

from __future__ import annotations

from typing import Any

import pytest

from anatomy.errors import SettingsError
from stages.scope.device import Bronchoscope

SCOPE: dict[str, Any] = {
    "name": "s",
    "outer_diameter_mm": 4.2,
    "channel_diameter_mm": 2.0,
    "bend_up_deg": 180.0,
    "bend_down_deg": 130.0,
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
        ("name", ""),
    ],
)
def test_impossible_bronchoscopes_are_refused(key: str, value: object) -> None:
    with pytest.raises(SettingsError, match=key):
        Bronchoscope(**(SCOPE | {key: value}))
