"""The chance of success of a plan under errors and a procedure, counted with common random numbers."""

from __future__ import annotations

from lungaccess.plans.plan import Plan
from lungaccess.problem.task import Task
from lungaccess.procedure import Procedure, simulate_procedure
from lungaccess.risk import ErrorModel, RiskAssessor, Share

FRESH_SEED = 1 << 20
"""Added to a search's seed for the draws that it never sees."""
OPEN_LOOP_SAMPLES = (256, 1024, 4096, 16384)
MEASURED_SAMPLES = (16, 48, 128, 400)
"""Draws of three rounds of a race, and of the estimate on fresh draws.  A procedure that plans again takes
about a thousand times as long as one that does not, and few draws tell the good from the bad."""


class ChanceEstimator:
    """Counts successes of the plans of one task.

    Attributes
    ----------
    errors : ErrorModel
    procedure : Procedure
    rounds : tuple of int
        Draws of the rounds of a race.
    fresh_samples : int
        Draws of an estimate that decides nothing.
    """

    def __init__(
        self, task: Task, errors: ErrorModel, procedure: Procedure, *, radius_mm: float | None
    ) -> None:
        self.errors, self.procedure = errors, procedure
        self._lung, self._seed, self._radius_mm = task.lung, task.seed, radius_mm
        *rounds, self.fresh_samples = OPEN_LOOP_SAMPLES if procedure.is_open_loop else MEASURED_SAMPLES
        self.rounds = tuple(rounds)

    def successes(self, plan: Plan, samples: int) -> int:
        """Return how many of `samples` procedures succeed; all plans have the same luck."""
        return self._share(plan, samples, self._seed).count

    def fresh(self, plan: Plan) -> Share:
        """Return the share of successes of draws that no search sees."""
        return self._share(plan, self.fresh_samples, self._seed + FRESH_SEED)

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
