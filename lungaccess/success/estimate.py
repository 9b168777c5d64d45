"""The chance of success of a plan under errors and a procedure, counted with common random numbers."""

from __future__ import annotations

from anatomy.records import frozen_value
from lungaccess.plans.plan import Plan
from lungaccess.problem.task import Task
from lungaccess.procedure import Procedure, simulate_procedure
from lungaccess.risk import ErrorModel, RiskAssessor, Share

FRESH_SEED = 1 << 20
"""Added to a search's seed for the draws that it never sees."""


@frozen_value
class HalvingSettings:
    """Successive halving: how many candidates take part, and with how many draws [Jamieson2016].

    Parameters
    ----------
    pool : int
        Candidates that it begins with.
    of_a_tip : int
        Of one scope tip so many: its deployments are alike, and other tips fail otherwise.
    samples, kept : tuple of int
        Draws of each round, and contenders that are left after it; one is left after the last.
    fresh : int
        Draws of an estimate that decides nothing.
    """

    pool: int
    of_a_tip: int
    samples: tuple[int, ...]
    kept: tuple[int, ...]
    fresh: int


OPEN_LOOP = HalvingSettings(pool=150, of_a_tip=8, samples=(256, 1024, 4096), kept=(24, 6), fresh=16384)
"""The best is nearly always among 150 of first order; a share of one half is known to 1 % at the end."""
MEASURED = HalvingSettings(pool=24, of_a_tip=1, samples=(8, 24, 120), kept=(8, 3), fresh=120)
"""A procedure that plans again takes a thousand times as long as one that does not, and the deployment is
chosen anew at the tip as measured: tips compete, with few draws."""


class ChanceEstimator:
    """Counts successes of the plans of one task.

    Attributes
    ----------
    errors : ErrorModel
    procedure : Procedure
    halving : HalvingSettings
    """

    def __init__(
        self, task: Task, errors: ErrorModel, procedure: Procedure, *, radius_mm: float | None
    ) -> None:
        self.errors, self.procedure = errors, procedure
        self._lung, self._seed, self._radius_mm = task.lung, task.seed, radius_mm
        self.halving = OPEN_LOOP if procedure.is_open_loop else MEASURED

    def successes(self, plan: Plan, samples: int) -> int:
        """Return how many of `samples` procedures succeed; all plans have the same luck."""
        return self._share(plan, samples, self._seed).count

    def fresh(self, plan: Plan, samples: int) -> Share:
        """Return the share of successes of draws that no search sees."""
        return self._share(plan, samples, self._seed + FRESH_SEED)

    def radius_mm(self, plan: Plan) -> float:
        """Return the radius of the goal about the target of a plan."""
        return RiskAssessor(plan, self._lung, radius_mm=self._radius_mm).radius_mm

    def _share(self, plan: Plan, samples: int, seed: int) -> Share:
        if self.procedure.is_open_loop:
            assessor = RiskAssessor(plan, self._lung, radius_mm=self._radius_mm)
            return assessor.success(assessor.draws(samples, seed), self.errors)
        return simulate_procedure(
            plan, self._lung, errors=self.errors, procedure=self.procedure, samples=samples, seed=seed,
            radius_mm=self._radius_mm,
        ).succeeds  # fmt: skip
