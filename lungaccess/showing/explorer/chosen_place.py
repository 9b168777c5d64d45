"""A place that a plan is asked to go through: where the tubes leave the airway, or the tip of the scope."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.records import frozen_value
from lungaccess.planning import TIP_WITHIN_MM
from lungaccess.planning.coupled.exits import PLACE_MM
from lungaccess.problem.request import StatedPlace

DIGITS = 3
"""Of the point in mm, as the command states it; the search takes the same number."""


@frozen_value
class ChosenPlace:
    """A place, LPS mm, with the words of the command for it.

    Parameters
    ----------
    kind : "exit" or "scope tip"
    lps_mm : (3,) floats
        As the command states them.
    """

    kind: Literal["exit", "scope tip"]
    lps_mm: tuple[float, float, float]

    @classmethod
    def of(cls, kind: Literal["exit", "scope tip"], point: ArrayLike) -> ChosenPlace:
        """Return the place of a point `(3,)`."""
        x, y, z = np.round(np.asarray(point, dtype=np.float64), DIGITS).tolist()
        return cls(kind=kind, lps_mm=(x, y, z))

    @property
    def within_mm(self) -> float:
        """How far from the place a plan may be."""
        return PLACE_MM if self.kind == "exit" else TIP_WITHIN_MM

    @property
    def stated(self) -> StatedPlace:
        """The place as a request states it."""
        return StatedPlace(kind=self.kind, lps_mm=np.array(self.lps_mm), within_mm=self.within_mm)

    @property
    def words(self) -> list[str]:
        """Options of the command that makes the same search."""
        option = "--" + self.kind.replace(" ", "-")
        point = "lps:" + ",".join(str(value) for value in self.lps_mm)
        return [option, point, f"{option}-within", str(self.within_mm)]
