"""Where the needle has to end for a window: one aim for each place of the scope's tip.

How far a deployment misses the moving target depends on the place of the scope's tip and on where the devices
end, and on nothing else; see docs/theory/proofs.md.
"""

from collections.abc import Callable

import numpy as np

from anatomy.base.records import frozen_value
from anatomy.base.typed import Float
from anatomy.motion.motion import Motion
from lungaccess.uncertainty.breathing.kernels.aim import aim_between, most_shares
from lungaccess.uncertainty.breathing.window import (
    TOLERANCE_MM,
    WHOLE_BREATH,
    carrier,
    distance_mm,
    miss_allowed,
)

SAMPLES = 33
"""Phases that are looked at: between two of them the target strays from a line by micrometres."""
HALVINGS = 10
"""Of the width of phases that an aim is made for: to 0.1 % of the breath."""


@frozen_value
class Aim:
    """Where the needle has to end from one place of the scope's tip, and for which phases.

    Args:
        point_lps (tuple of 3 floats): LPS mm in the masks' phase.
        phases (tuple of 2 floats): First and last phase that it is made for.
        least_miss_mm: No end of the devices comes nearer to the target in all of them.
        allowed_mm: No end of the devices may miss the target by more: the tolerance, less what tissue strays.
        most_share: No end of the devices has the target within the tolerance in more of the breath.
    """

    point_lps: tuple[float, float, float]
    phases: tuple[float, float]
    least_miss_mm: float
    allowed_mm: float
    most_share: float


class MovingTarget:
    """A target and its motion, as the devices see it.

    Args:
        target_lps ((3,) float64, LPS mm): Place of the masks.
        phases (tuple of 2 floats): Phases that every aim is made for.
        widened: Whether aims are made for more phases about these, as many as the tolerance allows.
        middle: The phase about which they are made where none are given, the masks' if None.
    """

    def __init__(
        self,
        motion: Motion,
        target_lps: Float,
        phases: tuple[float, float] | None = None,
        *,
        widened: bool,
        middle: float | None = None,
    ) -> None:
        self._motion, self._target = motion, np.array(target_lps, dtype=np.float64)
        self._side = motion.side_of(target_lps)
        self._moves = motion.displacements_mm(self._target[None], self._side)[0]
        self._phases, self._widened = phases, widened
        self._middle = motion.masks_phase if middle is None else middle

    def aim(self, tip_lps: Float, towards: float | None = None) -> Aim:
        """Return the aim from a place `(3,)` of the scope's tip, about a phase in place of `middle`."""
        rigid = carrier(self._motion, tip_lps, self._side)
        point = np.zeros(3)

        def made_for(phases: tuple[float, float]) -> tuple[float, float]:
            begin, end = (self._motion.share(phase) for phase in phases)
            half, miss = aim_between(rigid, self._target, self._moves, begin, end, SAMPLES, point)
            return float(half), float(miss)

        def fits(phases: tuple[float, float]) -> bool:
            miss = made_for(phases)[1]
            # Share of the tolerance that an aim uses: the proof needs some room for rounding.
            return miss <= miss_allowed(self._motion, 0.999 * TOLERANCE_MM, distance_mm(point, tip_lps))

        middle = self._middle if towards is None else towards
        phases = self._phases or (middle, middle)
        if self._widened and fits(phases):
            phases = _widest(fits, phases, middle if self._phases is None else 0.5 * sum(phases))
        least_mm, _miss = made_for(phases)
        begin, end = (self._motion.share(phase) for phase in WHOLE_BREATH)
        apart = max(abs(begin), abs(end)) * distance_mm(self._moves, rigid.displacement)
        allowed = TOLERANCE_MM - self._motion.hysteresis * max(
            distance_mm(self._target, tip_lps) - apart, 0.0
        )
        shares = most_shares(rigid, self._target, self._moves, begin, end, SAMPLES, allowed)
        x, y, z = point.tolist()
        return Aim(
            point_lps=(x, y, z),
            phases=phases,
            least_miss_mm=least_mm,
            allowed_mm=allowed,
            most_share=shares / (end - begin) if end > begin else 1.0,
        )


def _widest(
    fits: Callable[[tuple[float, float]], bool], least: tuple[float, float], middle: float
) -> tuple[float, float]:
    """Return the widest phases about a middle, as far as the breath goes, that fit and hold the least."""

    def of_width(width: float) -> tuple[float, float]:
        begin = min(max(middle - 0.5 * width, least[1] - width, 0.0), least[0], 1.0 - width)
        return begin, begin + width

    low, high = least[1] - least[0], 1.0
    if fits(WHOLE_BREATH):
        return WHOLE_BREATH
    for _ in range(HALVINGS):
        width = 0.5 * (low + high)
        low, high = (width, high) if fits(of_width(width)) else (low, width)
    return of_width(low)
