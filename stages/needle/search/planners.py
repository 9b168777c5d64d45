"""The searches of the needle stage by name."""

from __future__ import annotations

from typing import Protocol

from stages.needle.environment import NeedleEnvironment
from stages.needle.objective import SHORTEST, Objective
from stages.needle.planner_names import OUR_PLANNERS
from stages.needle.query import Query
from stages.needle.search.base import RestartingRRT, Search
from stages.needle.search.decision import Decision
from stages.needle.search.optimal import OptimalSearch
from stages.needle.search.portfolio import PortfolioSearch
from stages.needle.search.resolution import ResolutionSearch


class MakeSearch(Protocol):
    """Makes a search."""

    def __call__(
        self, environment: NeedleEnvironment, query: Query, seed: int, objective: Objective = SHORTEST
    ) -> Search:
        """Return a search for paths of low cost; the same seed repeats it."""


def _rrt(environment: NeedleEnvironment, query: Query, seed: int, objective: Objective = SHORTEST) -> Search:
    return RestartingRRT(environment, query, seed=seed, objective=objective)


def _ao_rrt(
    environment: NeedleEnvironment, query: Query, seed: int, objective: Objective = SHORTEST
) -> Search:
    return OptimalSearch(environment, query, seed=seed, objective=objective)


def _optimal(
    environment: NeedleEnvironment, query: Query, seed: int, objective: Objective = SHORTEST
) -> Search:
    return PortfolioSearch(environment, query, seed=seed, objective=objective)


def _resolution(
    environment: NeedleEnvironment, query: Query, seed: int, objective: Objective = SHORTEST
) -> Search:
    # Nothing in it is random.
    return ResolutionSearch(environment, query, objective=objective)


def _decide(
    environment: NeedleEnvironment, query: Query, seed: int, objective: Objective = SHORTEST
) -> Search:
    return Decision(environment, query, seed=seed, objective=objective)


PLANNERS: dict[str, MakeSearch] = dict(
    zip(OUR_PLANNERS, (_rrt, _ao_rrt, _optimal, _resolution, _decide), strict=True)
)
"""See docs/explanation/needle.md."""
