"""What came of many simulated procedures: shares, reasons of failure, and what each stage corrected."""

from collections.abc import Mapping

from anatomy.base.records import frozen_value
from lungaccess.problem.procedures import Procedure
from lungaccess.uncertainty.risk import DrawnReport, Share

NO_PATH = "no path left"
"""A procedure that ended because no path was found from a pose as measured."""


@frozen_value
class StageReport:
    """What planning again after one stage did; of the replans, `without_path` found none.

    Args:
        stage: "scope", "tube" or "needle": what was measured.
        corrected_mm: Median distance from the target at which the plan so far would have ended if it had gone
            on from the pose as measured; nan where the stage was not measured.
    """

    stage: str
    replans: int
    without_path: Share
    corrected_mm: float


@frozen_value
class ProcedureReport(DrawnReport):
    """What came of many simulated procedures; `touches` counts those in any attempt.

    Args:
        ends: Every procedure once: "success", or the first that holds of pleura, vessel, airway, fissure,
            "stays in the airway", `NO_PATH`, and "misses the goal".
        placements: Mean number of times that the bronchoscope was placed.
    """

    procedure: Procedure
    ends: Mapping[str, Share]
    placements: float
    stages: tuple[StageReport, ...]

    @property
    def failures(self) -> tuple[tuple[str, Share], ...]:
        """What made procedures fail, the most frequent first."""
        found = [(name, share) for name, share in self.ends.items() if name != "success" and share.count]
        return tuple(sorted(found, key=lambda each: -each[1].count))
