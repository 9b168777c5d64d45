"""The tracker of a simulated insertion: late, noisy, and now and then lost; and what is made of it."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from anatomy.base.typed import Float
from lungaccess.planning.procedure.insertion.truth import Truth
from lungaccess.planning.procedure.tracker import Measured, Tracker
from stages.needle import GAIN, Belief, Query

USUAL_NOISE_MM, USUAL_EVERY_MM = 0.4, 5.0
"""The tracker for which `GAIN` is the best share."""
_TINY_MM = 1e-9


def gain_for(noise_mm: float, every_mm: float) -> float:
    """Return the share of a measurement that is believed: that of a steady Kalman filter [Kalman1960].

    How fast dead reckoning goes wrong follows from `GAIN`, the share for 0.4 mm every 5 mm: so a tracker that
    measures twenty times a second is believed less each time.

    Parameters
    ----------
    noise_mm : float
        Standard deviation of the tracker.
    every_mm : float
        Insertion between two measurements.
    """
    drift = GAIN**2 * USUAL_NOISE_MM**2 / (USUAL_EVERY_MM * (1.0 - GAIN)) * every_mm
    if noise_mm <= _TINY_MM:
        return 1.0
    return (math.sqrt(drift**2 + 4.0 * noise_mm**2 * drift) - drift) / (2.0 * noise_mm**2)


class Path(Protocol):
    """What a needle leaves behind: its frames, and the length inserted at each."""

    frames: list[Float]
    lengths: list[float]
    inserted_mm: float


class SimulatedTracker:
    """Measures a simulated needle; a `procedure.Tracker` whose clock is the inserted length.

    Parameters
    ----------
    truth : Truth
        Where noise, losses and the target come from.
    needle : Path
        The needle, and where it was before.
    latency_mm : float
        Insertion between a measurement and its use.
    """

    def __init__(self, truth: Truth, needle: Path, latency_mm: float) -> None:
        self._truth, self._needle, self._latency_mm = truth, needle, latency_mm

    def read(self) -> Measured | None:
        """Return a measurement that was made `latency_mm` ago, None if it is lost."""
        lengths, needle = self._needle.lengths, self._needle
        at_mm = max(needle.inserted_mm - self._latency_mm, lengths[0])
        row = int(np.searchsorted(lengths, at_mm + _TINY_MM, side="right")) - 1
        seen = self._truth.measure(needle.frames[row], lengths[row])
        if seen is None:
            return None
        return Measured(time_s=lengths[row], lps_from_tip=seen[0], target_lps=seen[1])


class TrackedTruth:
    """What really happens to a needle, as far as it is known: by any tracker."""

    def __init__(self, truth: Truth, tracker: Tracker) -> None:
        self._truth, self._tracker = truth, tracker
        self.roll, self.bend = truth.roll, truth.bend

    def measure(self, frame: Float, inserted_mm: float) -> tuple[Float, Float] | None:
        """Return tip and target as the tracker has them, None if it has nothing new."""
        seen = self._tracker.read()
        if seen is None or seen.target_lps is None:
            return None
        return seen.lps_from_tip, seen.target_lps


class DelayedBelief(Belief):
    """Where tip and target are taken to be, by measurements that come late.

    To a measurement is added what was commanded since it was made.
    """

    def __init__(self, query: Query, gain: float, latency_mm: float) -> None:
        super().__init__(query, gain)
        self._latency_mm = latency_mm
        self._reckoned = [np.array(query.lps_from_start)]
        self._at_mm = [0.0]

    def roll(self, angle: float) -> None:
        """Roll as commanded."""
        before = self.frame
        super().roll(angle)
        self._reckoned[-1] = self._reckoned[-1] @ np.linalg.inv(before) @ self.frame

    def insert(self, length: float, curvature: float) -> None:
        """Insert as commanded."""
        before = self.frame
        super().insert(length, curvature)
        self._reckoned.append(self._reckoned[-1] @ np.linalg.inv(before) @ self.frame)
        self._at_mm.append(self._at_mm[-1] + length)

    def correct(self, seen: Float, target: Float) -> None:
        """Take a measurement into account, brought up to now."""
        if self._latency_mm > 0.0:
            then = max(self._at_mm[-1] - self._latency_mm, 0.0)
            row = int(np.searchsorted(self._at_mm, then + _TINY_MM, side="right")) - 1
            seen = seen @ np.linalg.inv(self._reckoned[row]) @ self._reckoned[-1]
        super().correct(seen, target)
