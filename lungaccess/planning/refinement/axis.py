"""The scope's tip as a smooth function of how far the scope goes on its way, and back to a motion."""

from __future__ import annotations

import numpy as np

from anatomy.base.typed import Float
from lungaccess.planning.refinement.layout import AXIS_DEGREE, AXIS_SCALE_MM
from lungaccess.plans.tip_rows import TipRows
from stages.scope import ScopeTip, evenly

SAMPLE_MM = 0.125
"""Step in which poses of the tip are proved and fitted; a voxel is several times as large."""


class LocalAxis:
    """The way of a scope's tip as its base goes on or stops earlier, AXIS_SCALE_MM each way.

    Attributes
    ----------
    low_mm, high_mm : float
        How far the base can be moved, back (negative) and on, with a proved motion everywhere between.
    points, tangents : (3, AXIS_DEGREE + 1) float64
        Coefficients of the tip's point and direction, LPS mm, in powers of the shift by AXIS_SCALE_MM.
    """

    def __init__(self, rows: TipRows, tip: ScopeTip) -> None:
        self._rows, self._tip = rows, tip
        shifts = evenly(SAMPLE_MM, AXIS_SCALE_MM)
        row = rows.along(tip, shifts)
        home = len(shifts) // 2
        refused = np.flatnonzero(~row.proved)
        low = int(refused[refused < home].max(initial=-1)) + 1
        high = int(refused[refused > home].min(initial=len(shifts))) - 1
        self.low_mm, self.high_mm = float(shifts[low]), float(shifts[high])
        self.points, self.tangents = _fit(shifts[low : high + 1], row.tips[low : high + 1], home - low)

    def tip(self, shift_mm: float) -> ScopeTip | None:
        """Return the tip with the base moved by `shift_mm`, None if that motion is not proved."""
        return self._rows.moved(self._tip, min(max(shift_mm, self.low_mm), self.high_mm))


def one_tip(tip: ScopeTip) -> tuple[Float, Float]:
    """Return the coefficients of an axis that is one tip."""
    points, tangents = np.zeros((3, AXIS_DEGREE + 1)), np.zeros((3, AXIS_DEGREE + 1))
    points[:, 0], tangents[:, 0] = tip.lps_from_scope_tip[:3, 3], tip.lps_from_scope_tip[:3, 2]
    return points, tangents


def _fit(shifts: Float, tips: Float, home: int) -> tuple[Float, Float]:
    """Return the coefficients `(3, AXIS_DEGREE + 1)` of point and tangent; exact at no shift."""
    powers = (shifts[:, None] / AXIS_SCALE_MM) ** np.arange(1, AXIS_DEGREE + 1)
    fitted = []
    for values in (tips[:, :3], tips[:, 3:6]):
        rest = np.linalg.lstsq(powers, values - values[home], rcond=1e-9)[0]
        fitted.append(np.vstack([values[home], rest]).T)
    return fitted[0], fitted[1]
