"""What a search over devices can make large: one line of a table for each criterion."""

from __future__ import annotations

from collections.abc import Callable
from statistics import fmean, median
from typing import NamedTuple

from anatomy.base.records import frozen_value
from lungaccess.problem.system import System


@frozen_value
class Contender:
    """A device, for each target counted whether the check accepts a plan, and what is made large.

    Parameters
    ----------
    chances : tuple of float
        For each target, the chance of success of its plan; 0 without one, or where no errors are stated.
    values : tuple of float
        The criteria of the search, in their order.
    """

    system: System
    reached: tuple[bool, ...] = ()
    chances: tuple[float, ...] = ()
    values: tuple[float, ...] = ()


class Criterion(NamedTuple):
    """A finite number that is the better the larger it is: its title with unit, and how it is counted."""

    title: str
    value: Callable[[Contender], float]
    needs_errors: bool = False


def _strain_left(device: Contender) -> float:
    """Return the share of the largest strain, %, that no tube has when it is held straight."""
    tubes = device.system.tubes
    return 100.0 * (1.0 - max(tube.rest_strain for tube in tubes.nested) / tubes.max_strain)


CRITERIA = {
    "reach": Criterion("targets reached, %", lambda device: 100.0 * fmean(device.reached)),
    "chance": Criterion("mean chance of success, %", lambda device: 100.0 * fmean(device.chances), True),
    "median-chance": Criterion("median chance, %", lambda device: 100.0 * median(device.chances), True),
    "needle-radius": Criterion(
        "needle's tightest radius, mm",
        lambda device: device.system.require_needle("The criterion").min_radius_of_curvature_mm,
    ),
    "strain-left": Criterion("strain left when straight, %", _strain_left),
}
"""The criteria by the names that a file gives them: a new one is one more line."""
