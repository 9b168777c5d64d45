"""The chance of success of a plan under errors and a procedure, counted with common random numbers."""

from __future__ import annotations

from collections.abc import Callable

from anatomy.base.records import frozen_value
from anatomy.lung import Lung
from lungaccess.planning.procedure import (
    DEFAULT_PROCEDURE,
    Procedure,
    ProcedureReport,
    Simulator,
    simulate_procedure,
)
from lungaccess.plans.chance import Chance
from lungaccess.plans.plan import Plan
from lungaccess.problem.task import Task
from lungaccess.uncertainty.risk import ErrorModel, RiskAssessor, RiskReport, Share, assess, goal_radius
from lungaccess.uncertainty.risk.breathing import model_for

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

Estimate = RiskReport | ProcedureReport | Chance
"""What a chance of success is read from: an estimate with all its parts, or what a plan states of one."""


UNCORRECTED = "The devices are not corrected on their way."


def estimate_success(
    plan: Plan,
    lung: Lung,
    *,
    errors: ErrorModel,
    procedure: Procedure,
    samples: int,
    seed: int,
    radius_mm: float | None = None,
    each_kind: bool = False,
) -> RiskReport | ProcedureReport:
    """Return how often a plan succeeds: deviated as it stands in open loop, else by simulated procedures.

    Parameters
    ----------
    each_kind : bool
        See `lungaccess.uncertainty.risk.assess`; of open loop alone.

    Raises
    ------
    PlanFileError, SettingsError
        See `lungaccess.uncertainty.risk.RiskAssessor`; also if there are no samples.
    """
    if procedure.is_open_loop:
        return assess(
            plan, lung, model=errors, samples=samples, seed=seed, radius_mm=radius_mm, each_kind=each_kind
        )
    return simulate_procedure(
        plan, lung, errors=errors, procedure=procedure, samples=samples, seed=seed, radius_mm=radius_mm
    )


def chance_of(found: Estimate) -> Chance:
    """Return the chance of success that an estimate counts."""
    if isinstance(found, Chance):
        return found
    procedure = Procedure(name=DEFAULT_PROCEDURE, description=UNCORRECTED)
    procedure = found.procedure if isinstance(found, ProcedureReport) else procedure
    return Chance(
        errors=found.model.label,
        procedure=procedure.name,
        corrections=procedure.description,
        sizes=found.model.words(with_needle=found.with_needle),
        assumed=found.model.assumed,
        radius_mm=found.radius_mm,
        radius_origin=found.radius_origin,
        with_needle=found.with_needle,
        samples=found.samples,
        seed=found.seed,
        successes=found.succeeds.count,
        failures={name: share.count for name, share in found.failures},
    )


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
        self._lung, self._seed, self._given_mm = task.lung, task.seed, radius_mm
        self.radius_mm = goal_radius(task.lung, task.target.lps_mm, radius_mm)[0]
        self.halving = OPEN_LOOP if procedure.is_open_loop else MEASURED

    def counter(self, plan: Plan) -> Counter:
        """Return what counts the successes of a plan; what it prepares serves all draws."""
        if self.procedure.is_open_loop:
            assessor = RiskAssessor(plan, self._lung, radius_mm=self.radius_mm)
            errors = model_for(self.errors, plan, self._lung)
            return lambda samples, seed: assessor.success(assessor.draws(samples, seed), errors)
        simulator = Simulator(plan, self._lung, self.errors, self.procedure, radius_mm=self.radius_mm)
        return lambda samples, seed: simulator.report(samples, seed).succeeds

    def successes(self, counter: Counter, samples: int) -> int:
        """Return how many of `samples` procedures succeed; all plans have the same luck."""
        return counter(samples, self._seed).count

    def fresh(self, plan: Plan, samples: int) -> RiskReport | ProcedureReport:
        """Return an estimate on draws that no search sees."""
        return estimate_success(
            plan, self._lung, errors=self.errors, procedure=self.procedure, samples=samples,
            seed=self._seed + FRESH_SEED, radius_mm=self._given_mm,
        )  # fmt: skip
