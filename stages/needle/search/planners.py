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


def _makes(
    cls: type[RestartingRRT] | type[PortfolioSearch] | type[ResolutionSearch] | type[Decision],
) -> MakeSearch:
    """Return what makes searches of a class; in the resolution search nothing is random."""

    def make(
        environment: NeedleEnvironment, query: Query, seed: int, objective: Objective = SHORTEST
    ) -> Search:
        if issubclass(cls, ResolutionSearch):
            return cls(environment, query, objective=objective)
        return cls(environment, query, seed=seed, objective=objective)

    return make


SEARCHES = (RestartingRRT, OptimalSearch, PortfolioSearch, ResolutionSearch, Decision)
PLANNERS: dict[str, MakeSearch] = {
    name: _makes(cls) for name, cls in zip(OUR_PLANNERS, SEARCHES, strict=True)
}
"""See docs/explanation/needle.md."""
