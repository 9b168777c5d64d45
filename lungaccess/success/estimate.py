"""The chance of success of a plan under errors and a procedure, counted with common random numbers."""

from __future__ import annotations

from collections.abc import Callable

from anatomy.records import frozen_value
from lungaccess.plans.plan import Plan
from lungaccess.problem.task import Task
from lungaccess.procedure import Procedure, Simulator
from lungaccess.risk import ErrorModel, RiskAssessor, Share, goal_radius

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
"""The order of first order is rough, so the pool is several times what is kept; after 4,096 draws a share of
one half is known to 1 %, as much as two good candidates differ by."""
MEASURED = HalvingSettings(pool=24, of_a_tip=1, samples=(8, 24, 120), kept=(8, 3), fresh=120)
"""A procedure that plans again takes a thousand times as long as one that does not, and the deployment is
chosen anew at the tip as measured: tips compete, with few draws."""


Counter = Callable[[int, int], Share]
"""Counts the successes of one plan: of so many draws, by a seed."""


class ChanceEstimator:
    """Counts successes of the plans of one task.

    Attributes
    ----------
    errors : ErrorModel
    procedure : Procedure
    halving : HalvingSettings
    radius_mm : float
        Radius of the goal.
    """

    def __init__(
        self, task: Task, errors: ErrorModel, procedure: Procedure, *, radius_mm: float | None
    ) -> None:
        self.errors, self.procedure = errors, procedure
        self._lung, self._seed = task.lung, task.seed
        self.radius_mm = goal_radius(task.lung, task.target.lps_mm, radius_mm)[0]
        self.halving = OPEN_LOOP if procedure.is_open_loop else MEASURED

    def counter(self, plan: Plan) -> Counter:
        """Return what counts the successes of a plan; what it prepares serves all draws."""
        if self.procedure.is_open_loop:
            assessor = RiskAssessor(plan, self._lung, radius_mm=self.radius_mm)
            return lambda samples, seed: assessor.success(assessor.draws(samples, seed), self.errors)
        simulator = Simulator(plan, self._lung, self.errors, self.procedure, radius_mm=self.radius_mm)
        return lambda samples, seed: simulator.report(samples, seed).succeeds

    def successes(self, counter: Counter, samples: int) -> int:
        """Return how many of `samples` procedures succeed; all plans have the same luck."""
        return counter(samples, self._seed).count

    def fresh(self, plan: Plan, samples: int) -> Share:
        """Return the share of successes of draws that no search sees."""
        return self.counter(plan)(samples, self._seed + FRESH_SEED)
