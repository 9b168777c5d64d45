"""Where the paths from a start to a target can be, and how steep to the line between the two."""

from __future__ import annotations

import math

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from stages.needle.infeasibility.kernels import bounds

ROUNDING = 1e-8
"""Share by which curvature and angles are taken too large, so that rounding rules out no path."""


@frozen_record
class PathBounds:
    """Bounds of the places and directions of all paths.

    Parameters
    ----------
    ends : (ENDS_SIZE,) float64
        See `stages.needle.infeasibility.kernels.bounds`.
    steepest : float
        Largest sine of the angle between a path and the line from start to target.
    aside_mm, before_mm : float
        How far aside of that line, and how far before the start or behind the target, a path can go.
    """

    ends: Float
    steepest: float
    aside_mm: float
    before_mm: float

    @classmethod
    def of(cls, total_mm: float, tolerance_mm: float, kappa: float, length_mm: float) -> PathBounds:
        """Return the bounds for a target `total_mm` from the start.

        Parameters
        ----------
        total_mm, tolerance_mm : float
            Distance from start to target, and how far from the target a path may end.
        kappa : float
            Greatest curvature, 1/mm.
        length_mm : float
            Greatest length of a path.
        """
        radius, widest = 1.0 / kappa, total_mm + tolerance_mm
        ends = np.zeros(bounds.ENDS_SIZE)
        ends[: bounds.LONGEST] = total_mm, tolerance_mm
        ends[bounds.SPINDLE_RADIUS] = math.inf
        steepest, longest, highest = 1.0, length_mm, math.inf
        if widest < 2.0 * radius:
            half = math.asin(0.5 * widest / radius)
            tilt = math.asin(tolerance_mm / total_mm)
            offset = radius * math.cos(half)
            ends[bounds.SPINDLE_MIDDLE :] = 0.5 * widest, offset, radius + widest * tilt
            steepest = math.sin(min(half + tilt + ROUNDING, 0.5 * math.pi))
            longest = min(longest, 2.0 * half * radius)
            highest = radius + widest * tilt - offset
        longest += tolerance_mm
        ends[bounds.LONGEST] = longest
        return cls(
            ends=ends,
            steepest=steepest,
            aside_mm=min(0.5 * math.sqrt(longest**2 - total_mm**2) + bounds.SPARE, highest),
            before_mm=0.5 * (longest - total_mm) + bounds.SPARE,
        )

    def width_mm(self, depth_mm: float, kappa: float) -> float:
        """Return about how wide paths spread at a depth without obstacles, by their start and the spindle."""
        of_start = kappa * depth_mm**2
        radius, total = float(self.ends[bounds.SPINDLE_RADIUS]), float(self.ends[bounds.TOTAL])
        if not math.isfinite(radius):
            return of_start
        aside = math.sqrt(max(radius**2 - (depth_mm - 0.5 * total) ** 2, 0.0))
        return min(of_start, 2.0 * max(aside - float(self.ends[bounds.SPINDLE_OFFSET]), 0.0))
