"""Motion of the lung by breathing when nothing is known of the patient: that of ten others by height."""

import numpy as np

from anatomy.base.typed import Float

HEIGHTS = np.arange(0.05, 1.0, 0.1)
"""Middles of the tenths of a lung's height, from the apex."""
SHARE_OF_MOTION = np.array([0.04, 0.08, 0.15, 0.21, 0.29, 0.39, 0.52, 0.65, 0.74, 0.69])
"""g at these heights: means over ten patients with 4-D CT of quiet breathing (DIR-Lab), computed from the
landmarks of [Fu2019]."""
POPULATION_ERROR_MM = 4.7
"""This model leaves so much of those patients' motion: more than most nodules forgive."""


def share_of_motion(height: float) -> float:
    """Return g: motion to the feet of a place by its height, 0 at the apex to 1 at the base, as a share."""
    return float(shares_of_motion(np.asarray(height)))


def shares_of_motion(heights: Float) -> Float:
    """Return g at heights of any shape."""
    return np.asarray(np.interp(heights, HEIGHTS, SHARE_OF_MOTION))
