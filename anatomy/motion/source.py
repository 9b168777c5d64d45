"""What is known of a patient's breathing, as it was read: a field, landmark pairs, or other people's."""

from typing import Literal

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.grid import Grid, Volume


@frozen_record
class MotionSource:
    """Motion between end-exhale (phase 0) and end-inhale (phase 1) of quiet breathing, in LPS mm.

    One of three kinds: a displacement field, `vectors` `(ni, nj, nk, 3)` at the voxel centres of `grid`;
    landmark pairs, the same places of tissue at both ends, `exhale_lps` and `inhale_lps` `(N, 3)`; or the
    model of a population for a 95 % motion of the patient, `population_motion_mm`.

    Args:
        masks_phase: The phase that the patient's masks show.
        amplitude, hysteresis: See `Motion`.
        maps_from ("end-exhale" or "end-inhale"): Where the points of a displacement field lie; the vectors
            lead to the other end.
        other_lungs: The lungs at the end of the breath that is farther from the phase of the masks, to
            compare with.
    """

    description: str
    masks_phase: float
    amplitude: float = 1.0
    maps_from: Literal["end-exhale", "end-inhale"] = "end-exhale"
    grid: Grid | None = None
    vectors: Float | None = None
    exhale_lps: Float | None = None
    inhale_lps: Float | None = None
    population_motion_mm: float | None = None
    hysteresis: float = 0.0
    other_lungs: Volume | None = None


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
