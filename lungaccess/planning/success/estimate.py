"""The chance of success of a plan under errors and a procedure."""

from anatomy.lung import Lung
from lungaccess.planning.procedure import ProcedureReport, simulate_procedure
from lungaccess.plans.chance import Chance
from lungaccess.plans.plan import Plan
from lungaccess.problem.errors import ErrorModel
from lungaccess.problem.procedures import DEFAULT_PROCEDURE, Procedure
from lungaccess.uncertainty.risk import RiskReport, assess

FRESH_SEED = 1 << 20
"""Added to a search's seed for the draws that it never sees."""


MEASURED_PROCEDURE = "measured-tip"
"""The procedure of whoever states none when planning for success: real systems measure, and plan again."""
Estimate = RiskReport | ProcedureReport | Chance
"""What a chance of success is read from: an estimate with all its parts, or what a plan states of one."""


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
    processes: int = 1,
) -> RiskReport | ProcedureReport:
    """Return how often a plan succeeds: deviated as it stands in open loop, else by simulated procedures.

    PlanFileError and SettingsError are raised as by `lungaccess.uncertainty.risk.RiskAssessor`, also if there
    are no samples.

    Args:
        each_kind: See `lungaccess.uncertainty.risk.assess`; of open loop alone.
        processes: How many share the work of simulated procedures; the estimate is the same.
    """
    if procedure.is_open_loop:
        return assess(
            plan, lung, model=errors, samples=samples, seed=seed, radius_mm=radius_mm, each_kind=each_kind
        )
    return simulate_procedure(
        plan, lung, errors=errors, procedure=procedure, samples=samples, seed=seed, radius_mm=radius_mm,
        processes=processes,
    )  # fmt: skip


def chance_of(found: Estimate) -> Chance:
    """Return the chance of success that an estimate counts."""
    if isinstance(found, Chance):
        return found
    procedure = Procedure(name=DEFAULT_PROCEDURE, description="The devices are not corrected on their way.")
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
        tissue=found.tissue,
    )
