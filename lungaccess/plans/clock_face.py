"""Where something is in the picture of a scope, on the face of a clock."""

from __future__ import annotations

import math

from anatomy.base.typed import Float

STRAIGHT_RAD = math.radians(4.0)
"""What lies nearer to the middle of the picture is straight ahead."""
STRAIGHT_AHEAD = "straight ahead"


def clock_hour(lps_from_tip: Float, point_lps: Float) -> int:
    """Return where a point is in the picture of a tip on a clock, 1 to 12; 0 if it is straight ahead.

    The top of the picture is +x of the tip, where a positive bend turns it, and its right is +y.
    """
    up, right, ahead = lps_from_tip[:3, :3].T @ (point_lps - lps_from_tip[:3, 3])
    if math.atan2(math.hypot(up, right), ahead) < STRAIGHT_RAD:
        return 0
    return round(math.degrees(math.atan2(right, up)) / 30.0) % 12 or 12


def clock_words(hour: int) -> str:
    """Say where in the picture an hour of `clock_hour` is."""
    return f"at {hour} o'clock" if hour else STRAIGHT_AHEAD
