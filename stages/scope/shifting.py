"""Tips before and after a tip along its own motion, each with a proved motion of its own."""

import math

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float
from stages.scope.device import SHORTEST_MM
from stages.scope.motion import ADVANCE, ScopeMotion


@frozen_record
class TipRow:
    """Tips in a row along the motion to one of them; K tips.

    Parameters
    ----------
    motion : ScopeMotion
        That of the tip at shift 0.
    shifts_mm : (K,) float64
        How much farther the base of the bending section stops, negative for less far.
    tips : (K, 9) float64
        Point, direction, and +x of the working channel's frame, LPS mm.
    proved : (K,) bool
        Whether the motion to the tip is proved, and the tip where tips of plans may be.
    """

    motion: ScopeMotion
    shifts_mm: Float
    tips: Float
    proved: Bool

    def motion_to(self, index: int) -> ScopeMotion:
        """Return the motion to a tip."""
        return shifted(self.motion, float(self.shifts_mm[index]))


def shifted(motion: ScopeMotion, shift_mm: float) -> ScopeMotion:
    """Return a motion whose base stops `shift_mm` farther, where the section takes the same twist and bend.

    The base stops earlier on its way, or goes on along its last arc.  It says nothing about the lumen.
    """
    states = motion.states
    stop = float(states[-1, ADVANCE]) + shift_mm
    slides = np.flatnonzero(np.diff(states[:, ADVANCE]) > SHORTEST_MM)
    if shift_mm == 0.0 or not len(slides):
        return motion
    held = slides[states[slides, ADVANCE] <= stop]
    if not len(held):
        return motion
    last = int(held[-1])
    rows = [tuple(row) for row in states[: last + 1].tolist()]
    slide(rows, stop)
    _, twist, bend = rows[-1]
    to_twist, to_bend = states[-1, 1:].tolist()
    most = max(abs(bend), abs(to_bend))
    direct = math.hypot(to_bend - bend, most * (to_twist - twist))
    turn(rows, to_twist, to_bend, direct > abs(bend) + abs(to_bend))
    return ScopeMotion(
        lps_from_entry=motion.lps_from_entry,
        states=np.array(rows),
        bending_length_mm=motion.bending_length_mm,
    )


def evenly(step_mm: float, reach_mm: float) -> Float:
    """Return shifts `(K,)` a step apart as far as `reach_mm` each way, 0 in the middle."""
    count = round(reach_mm / step_mm)
    return step_mm * np.arange(-count, count + 1, dtype=np.float64)


def as_shifts(values: ArrayLike) -> Float:
    """Return shifts as a float64 array `(K,)`."""
    return np.ascontiguousarray(np.atleast_1d(np.asarray(values, dtype=np.float64)))


State = tuple[float, ...]
"""Advance in mm, twist and bend in rad."""


def turn(rows: list[State], twist: float, bend: float, by_straight: bool) -> None:
    """Add a change in place, which may go by the straight section: twisting that moves nothing."""
    advance, twist_before, bend_before = rows[-1]
    if (twist, bend) == (twist_before, bend_before):
        return
    if by_straight and bend_before != 0.0:
        rows.append((advance, twist_before, 0.0))
    if by_straight and twist != twist_before and bend != 0.0:
        rows.append((advance, twist, 0.0))
    rows.append((advance, twist, bend))


def slide(rows: list[State], advance_mm: float) -> None:
    """Add an advance with twist and bend held; one that goes on with the advance before replaces its end."""
    if advance_mm <= rows[-1][0]:
        return
    _, twist, bend = rows[-1]
    if len(rows) > 1 and rows[-2][1:] == (twist, bend):
        rows.pop()
    rows.append((advance_mm, twist, bend))
