"""Plan for the chance of success: the plan whose procedure most often ends well under given errors."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

from anatomy.base.records import frozen_record
from anatomy.lung import Lung
from lungaccess.planning.coupled.atlas import Atlas, build_atlas, require_same
from lungaccess.planning.coupled.planner import Clock, ProgressEvent, atlas_event
from lungaccess.planning.procedure import Procedure, ProcedureReport, load_procedure
from lungaccess.planning.success.estimate import ChanceEstimator, chance_of
from lungaccess.planning.success.search import Contender, SuccessSearch
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import System, require_own_name
from lungaccess.problem.target import Target
from lungaccess.problem.task import Task, objective_of
from lungaccess.uncertainty.risk import ErrorModel, RiskReport, Share, load_errors

METHOD = "success"
"""What the method of such plans is called."""


@frozen_record
class PlannedSuccess:
    """A plan with its chance of success.

    Parameters
    ----------
    plan : Plan
        Proved as every plan; its costs are those of the default objective.
    estimate : RiskReport or ProcedureReport
        How many procedures succeed of draws that no search has seen, and what fails; few draws of a plan
        that may soon be surpassed, and which comes again with all draws if it is not.  What is counted the
        plan states as its `chance`.
    """

    plan: Plan
    estimate: RiskReport | ProcedureReport

    @property
    def succeeds(self) -> Share:
        """How many procedures succeed."""
        return self.estimate.succeeds


def plan_for_success(
    lung: Lung,
    system: System,
    target: Target,
    *,
    errors: ErrorModel | None = None,
    procedure: Procedure | None = None,
    radius_mm: float | None = None,
    seed: int = 0,
    iterations: int | None = None,
    time_s: float | None = None,
    atlas: Atlas | None = None,
    counterfactuals: bool = True,
    on_progress: Callable[[ProgressEvent], None] | None = None,
) -> Iterator[PlannedSuccess]:
    """Plan all stages so that the procedure most often succeeds; yield each plan that is better.

    All deployments of the atlas with a clear direct arc are ranked by how errors spread along them to first
    order.  The best of them and the plan of least cost are compared by successive halving with common random
    numbers: all have the same luck, and fewer and fewer get more and more draws.  Then the best is varied.
    What a plan states was counted on draws that decided nothing.

    Parameters
    ----------
    errors : ErrorModel, optional
        The preset `breath-hold` if None.
    procedure : Procedure, optional
        What is measured and planned again on the way; the preset `open-loop` if None.
    radius_mm : float, optional
        Radius of the goal; see `lungaccess.uncertainty.risk.RiskAssessor`.
    seed : int
        The same seed and `iterations` give the same plans.
    iterations : int, optional
        Stop after so many variations of the best plan.
    time_s : float, optional
        Stop after so many seconds of planning, but not before the first plan.  With neither limit the caller
        stops the iterator.
    atlas, counterfactuals, on_progress
        As for `lungaccess.plan`.

    Raises
    ------
    NoPlan
        If there is no plan at all; counts the reasons.
    SettingsError
        If the system has no needle, or the atlas belongs to another lung or system.
    TargetError
        If the target lies outside the lung or inside an obstacle.
    """
    system.require_needle("Planning for the chance of success")
    require_own_name(system)
    tell = on_progress or (lambda _event: None)
    if atlas is not None:
        require_same(atlas, lung, system)
    atlas = atlas or build_atlas(lung, system, progress=lambda share: tell(atlas_event(share)))
    task = Task(
        lung=lung, system=system, target=target, objective=objective_of(lung), method=METHOD,
        seed=seed,
    )  # fmt: skip
    model, followed = errors or load_errors(), procedure or load_procedure()
    estimator = ChanceEstimator(task, model, followed, radius_mm=radius_mm)
    search = SuccessSearch(task, atlas, estimator, counterfactuals=counterfactuals)
    return _run(search, estimator, iterations, math.inf if time_s is None else time_s, tell)


def _run(
    search: SuccessSearch,
    estimator: ChanceEstimator,
    iterations: int | None,
    time_s: float,
    tell: Callable[[ProgressEvent], None],
) -> Iterator[PlannedSuccess]:
    """Drive a search within its budget; what it ends with is estimated with all draws, even after it."""
    clock, best, few = Clock(), None, False

    def planned(contender: Contender, tried: int, samples: int) -> PlannedSuccess:
        whole = search.finished(contender, tried, clock.elapsed_s)
        found = estimator.fresh(whole, samples)
        return PlannedSuccess(plan=replace(whole, chance=chance_of(found)), estimate=found)

    for contender, tried in search.steps():
        if iterations is not None and tried > iterations:
            break
        if best is None or contender.plan is not best.plan:
            few, best = contender.samples < estimator.halving.samples[-1], contender
            yield planned(contender, tried, estimator.halving.samples[0] if few else estimator.halving.fresh)
        if clock.elapsed_s > time_s:
            break
        if clock.due():
            tell(
                ProgressEvent(
                    iteration=tried, elapsed_s=clock.elapsed_s, best_cost=None, phase=METHOD,
                    message=f"succeeds in {contender.share:.0%} of the draws",
                )
            )  # fmt: skip
    if best is not None and few:
        yield planned(best, 0, estimator.halving.fresh)
