"""A needle planner by its name in the coupled search: ours, or one of OMPL; driven by OMPL if it is there."""

from __future__ import annotations

import math
from functools import cached_property
from typing import TYPE_CHECKING

from anatomy.base.typed import Float
from lungaccess.plans.evaluator import CandidateEvaluator
from stages.needle import OMPL_PLANNERS, ArcPath, first_path, has_ompl, searches
from stages.tube import Deployment

if TYPE_CHECKING:
    from stages.needle.ompl import NeedleProblem


class NamedNeedlePlanner:
    """Searches the needle's paths of one task with the planner that the task names.

    Parameters
    ----------
    default : str
        The planner where the task names none.

    Raises
    ------
    SettingsError
        If it is a planner of OMPL and OMPL has been used in this process: it can be seeded once.
    """

    def __init__(self, evaluator: CandidateEvaluator, default: str) -> None:
        self._evaluator = evaluator
        self._name = evaluator.task.needle_planner or default
        if self._name in OMPL_PLANNERS:
            from stages.needle.ompl import seed_ompl

            seed_ompl(evaluator.task.seed + 1)

    def path(
        self,
        deployment: Deployment,
        end: Float | None = None,
        *,
        seed: int,
        iterations: int,
        cost_limit: float = math.inf,
    ) -> ArcPath | None:
        """Return a path from the tip of the tubes that costs less than a limit, None if none is found.

        The planners of OMPL look at no objective and at no seed; what they find may cost more.
        """
        query = self._evaluator.query(deployment, end)
        if self._name not in OMPL_PLANNERS and not has_ompl():
            search = searches()[self._name](
                self._evaluator.environment, query, seed, self._evaluator.objective
            )
            return first_path(search, iterations, cost_limit)
        return self._problem.plan(
            query, seed=seed, iterations=iterations, method=self._name, cost_limit=cost_limit
        )

    @cached_property
    def _problem(self) -> NeedleProblem:
        from stages.needle.ompl import NeedleProblem  # Here: many searches end before they need it.

        return NeedleProblem(self._evaluator.environment, objective=self._evaluator.objective)
