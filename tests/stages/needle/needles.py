"""The limits of a needle of 50 mm radius."""

from __future__ import annotations

import math

from stages.needle.kernels.proof import Limits

RADIUS = 50.0


def limits_of(**values: float) -> Limits:
    """Limits of a needle of 50 mm radius, 90 and 180 degrees, 150 mm."""
    needle = {
        "kappa": 1 / RADIUS,
        "max_length_mm": 150.0,
        "max_angle_rad": math.pi / 2,
        "max_turn_rad": math.pi,
    }
    return Limits(**dict.fromkeys(Limits._fields, 0.0) | needle | values)
