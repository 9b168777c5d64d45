"""The searches of the needle stage by name."""

from __future__ import annotations

from typing import Protocol

from stages.needle.objective import SHORTEST, Objective
from stages.needle.search.base import Query, RestartingRRT, Search
from stages.needle.search.decision import Decision
from stages.needle.search.portfolio import PortfolioSearch
from stages.needle.search.resolution import ResolutionSearch
from stages.needle.space import NeedleSpace


class MakeSearch(Protocol):
    """Makes a search."""

    def __call__(
        self, space: NeedleSpace, query: Query, seed: int, objective: Objective = SHORTEST
    ) -> Search:
        """Return a search for paths of low cost; the same seed repeats it."""


def _rrt(space: NeedleSpace, query: Query, seed: int, objective: Objective = SHORTEST) -> Search:
    return RestartingRRT(space, query, seed=seed, objective=objective)


def _optimal(space: NeedleSpace, query: Query, seed: int, objective: Objective = SHORTEST) -> Search:
    return PortfolioSearch(space, query, seed=seed, objective=objective)


def _resolution(space: NeedleSpace, query: Query, seed: int, objective: Objective = SHORTEST) -> Search:
    # Nothing in it is random.
    return ResolutionSearch(space, query, objective=objective)


def _decide(space: NeedleSpace, query: Query, seed: int, objective: Objective = SHORTEST) -> Search:
    return Decision(space, query, seed=seed, objective=objective)


PLANNERS: dict[str, MakeSearch] = {
    "rrt": _rrt,
    "optimal": _optimal,
    "resolution": _resolution,
    "decide": _decide,
}
"""See docs/needle.md."""
