"""Decides a query: a path, or a proof that there is none, whichever comes first."""

from __future__ import annotations

import math

from stages.needle.environment import NeedleEnvironment
from stages.needle.infeasibility.certificate import NoPathProof
from stages.needle.objective import SHORTEST, Objective
from stages.needle.path import ArcPath
from stages.needle.query import Query
from stages.needle.search.base import Search
from stages.needle.search.optimal import OptimalSearch
from stages.needle.search.resolution import ResolutionSearch

FIRST_ITERATIONS = 10_000
"""Tried before the proof is begun: a path that is easy to find is found by then."""
STATES_PER_ITERATION = 400
"""States on a plane of the proof for one iteration of the searches: most of the time goes into the proof."""


class Decision:
    """Looks for a path and for a proof that there is none in turns; see `stages.needle.search.base.Search`.

    The resolution search finds narrow passages soonest; the optimal search goes on where that has ended.

    Attributes
    ----------
    outcome : str
        "running", "path", "no path" (proved) or "undecided" (the proof has come to its end without a
        result; the search for a path can go on).
    """

    def __init__(
        self, environment: NeedleEnvironment, query: Query, *, seed: int = 1, objective: Objective = SHORTEST
    ) -> None:
        self.search = OptimalSearch(environment, query, seed=seed, objective=objective)
        self.resolution = ResolutionSearch(environment, query, objective=objective)
        self.proof = NoPathProof(environment, query)
        self.path: ArcPath | None = None
        self.cost = math.inf
        self.finished = False
        self.outcome = "running"
        self.iterations = 0
        self._owed = FIRST_ITERATIONS

    def advance(self, iterations: int) -> bool:
        """Search for so many iterations; without a path, take a step of the proof when it is its turn."""
        if self.finished:
            return False
        if self.path is None and self._owed <= 0 and self.proof.outcome == "running":
            self._owed = self.proof.states // STATES_PER_ITERATION
            if self.proof.advance():
                self.outcome = self.proof.outcome
                self.finished = self.outcome == "no path"
        if self.finished:
            return False
        self.iterations += iterations
        self._owed -= iterations
        searches: list[Search] = [s for s in (self.resolution, self.search) if not s.finished]
        share = math.ceil(iterations / len(searches))
        better = [self._went_on(search, share) for search in searches]
        return any(better)

    def _went_on(self, search: Search, iterations: int) -> bool:
        """Advance one search; tell whether its path is cheaper than all before, and let the other know."""
        if not search.advance(iterations) or search.path is None or not search.cost < self.cost:
            return False
        self.path, self.cost, self.outcome = search.path, search.cost, "path"
        if search is self.resolution:
            self.search.adopt(self.path, self.cost)
        else:
            self.resolution.cost = self.cost
        return True
