"""A diverse plan set for the chance of success: the likeliest plans that are separated; their trade-off."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from anatomy.base.typed import Float, Int
from anatomy.lung import Lung
from lungaccess.planning.coupled import COUNT, SEPARATION_MM, Alternative, separated_plans, with_front
from lungaccess.planning.coupled.atlas import Atlas, build_atlas, require_same
from lungaccess.planning.coupled.search.direct_arcs import DirectArcs
from lungaccess.planning.procedure import Procedure, load_procedure
from lungaccess.planning.procedure.spread import Spread
from lungaccess.planning.success.estimate import ChanceEstimator, chance_of
from lungaccess.problem.system import System
from lungaccess.problem.target import Target
from lungaccess.problem.task import Task, objective_of
from lungaccess.uncertainty.risk import ErrorModel, load_errors

METHOD = "success, alternatives"
"""What the method of such plans is called."""


class LikelyArcs(DirectArcs):
    """Direct arcs whose cost is their chance of failure to first order."""

    def __init__(self, task: Task, atlas: Atlas, estimator: ChanceEstimator) -> None:
        super().__init__(task, atlas)
        self._estimator = estimator

    def evaluate(self, chosen: Int, slack: float, best: float = math.inf) -> tuple[Int, Float, float]:
        """Return what blocks the arcs from deployments, and how likely each fails; see `DirectArcs`."""
        blockers, costs, _best = super().evaluate(chosen, slack, best)
        clear = chosen[blockers == 0]
        deployments = self.atlas.deployments.only(clear)
        spread = Spread(
            self.task.lung, self.task.system, self.atlas.motions.tips[deployments.site], deployments,
            self.task.target.lps_mm, self._estimator.errors, self._estimator.procedure,
            self._estimator.radius_mm,
        )  # fmt: skip
        costs[blockers == 0] = 1.0 - spread.chances
        return blockers, costs, float(costs.min(initial=best))


def alternatives_for_success(
    lung: Lung,
    system: System,
    target: Target,
    *,
    errors: ErrorModel | None = None,
    procedure: Procedure | None = None,
    radius_mm: float | None = None,
    seed: int = 0,
    count: int = COUNT,
    separation_mm: float = SEPARATION_MM,
    atlas: Atlas | None = None,
    counterfactuals: bool = True,
    progress: Callable[[float], None] | None = None,
) -> tuple[Alternative, ...]:
    """Return a diverse plan set whose plans state their chance of success, and its Pareto front.

    As `lungaccess.alternatives`, but the plan that most likely succeeds to first order comes first of each
    branch, then the others by that.  Then all are simulated with the same luck; on the front are those that
    no other beats in success, length in tissue and clearance together.

    Parameters
    ----------
    errors, procedure, radius_mm, seed
        See `plan_for_success`.
    count, separation_mm, atlas, counterfactuals
        See `lungaccess.alternatives`.
    progress : callable, optional
        Told the share of the plans that is simulated.

    Raises
    ------
    NoPlan
        If no plan was found.
    SettingsError
        If the system has no needle, a number is not above 0, or the atlas belongs to another lung or system.
    TargetError
        If the target lies outside the lung or inside an obstacle.
    """
    system.require_needle("A diverse plan set for the chance of success")
    if atlas is not None:
        require_same(atlas, lung, system)
    objective = objective_of(lung)
    task = Task(lung=lung, system=system, target=target, objective=objective, method=METHOD, seed=seed)
    estimator = ChanceEstimator(
        task, errors or load_errors(), procedure or load_procedure(), radius_mm=radius_mm
    )
    arcs = LikelyArcs(task, atlas or build_atlas(lung, system), estimator)
    plans, stated = separated_plans(arcs, count, separation_mm, counterfactuals=counterfactuals), []
    for number, plan in enumerate(plans, start=1):
        found = estimator.fresh(plan, estimator.halving.fresh)
        stated.append(replace(plan, chance=chance_of(found)))
        if progress is not None:
            progress(number / len(plans))
    return with_front(stated, [each.chance for each in stated])
