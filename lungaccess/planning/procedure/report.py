"""What came of many simulated procedures: shares, reasons of failure, and what each stage corrected."""

from __future__ import annotations

from collections.abc import Mapping

from anatomy.base.records import frozen_value
from lungaccess.problem.errors import ErrorModel
from lungaccess.problem.procedures import Procedure
from lungaccess.uncertainty.risk import Share

NO_PATH = "no path left"
"""A procedure that ended because no path was found from a pose as measured."""


@frozen_value
class StageReport:
    """What planning again after one stage did.

    Parameters
    ----------
    stage : str
        "scope", "tube" or "needle": what was measured.
    replans : int
        How often the rest was planned again.
    without_path : Share
        Of these, how many found none.
    corrected_mm : float
        Median distance from the target at which the plan so far would have ended if it had gone on from the
        pose as measured; nan where the stage was not measured.
    """

    stage: str
    replans: int
    without_path: Share
    corrected_mm: float


@frozen_value
class ProcedureReport:
    """What came of many simulated procedures.

    Parameters
    ----------
    radius_mm, radius_origin : float, str
        Radius of the goal about the target, and where the radius came from.
    succeeds : Share
        Ends within the radius, leaves the airway, and touches nothing that is forbidden.
    touches : mapping of str to Share
        As those of a `RiskReport`, in any attempt.
    ends : mapping of str to Share
        Every procedure once: "success", or the first that holds of pleura, vessel, airway, fissure, "stays
        in the airway", `NO_PATH`, and "misses the goal".
    miss_mm : mapping of float to float
        Distance of the tip from the target that a share of the inserted needles does not exceed.
    placements : float
        Mean number of times that the bronchoscope was placed.
    stages : tuple of StageReport
        What was measured, in its order.
    with_needle : bool
        Whether the plan has a needle; its tubes end at the target where it has none.
    """

    model: ErrorModel
    procedure: Procedure
    samples: int
    seed: int
    radius_mm: float
    radius_origin: str
    succeeds: Share
    touches: Mapping[str, Share]
    ends: Mapping[str, Share]
    miss_mm: Mapping[float, float]
    placements: float
    stages: tuple[StageReport, ...]
    with_needle: bool = True

    @property
    def failures(self) -> tuple[tuple[str, Share], ...]:
        """What made procedures fail, the most frequent first."""
        found = [(name, share) for name, share in self.ends.items() if name != "success" and share.count]
        return tuple(sorted(found, key=lambda each: -each[1].count))
