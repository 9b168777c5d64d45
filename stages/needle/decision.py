"""Decides a query: a path, or a proof that there is none, whichever comes first."""

from __future__ import annotations

import math

from stages.needle.certificate import NoPathProof
from stages.needle.kernels.limits import MAX_ANGLE
from stages.needle.objective import SHORTEST, Objective
from stages.needle.optimal import OptimalSearch
from stages.needle.path import ArcPath
from stages.needle.searches import Query
from stages.needle.space import NeedleSpace

FIRST_ITERATIONS = 20_000
"""Tried before the proof is begun: a path that is easy to find is found by then."""


class Decision:
    """Looks for a path and for a proof that there is none in turns; see `stages.needle.searches.Search`.

    Parameters
    ----------
    space : NeedleSpace
    query : Query
    seed : int
    objective : Objective

    Attributes
    ----------
    outcome : str
        "running", "path", "no path" (proved) or "undecided" (the proof has come to its end without a
        result; the search for a path can go on).
    """

    def __init__(
        self, space: NeedleSpace, query: Query, *, seed: int = 1, objective: Objective = SHORTEST
    ) -> None:
        self.search = OptimalSearch(space, query, seed=seed, objective=objective)
        self.proof: NoPathProof | None = None
        self.path: ArcPath | None = None
        self.cost = math.inf
        self.finished = False
        self.outcome = "running"
        # The proof holds only for needles that never turn back.
        self._provable = bool(space.limits[MAX_ANGLE] <= 0.5 * math.pi) and query.reference is None
        self._space = space
        self._query = query

    def advance(self, iterations: int) -> bool:
        """Search for so many iterations and, from some number on without a path, prove one step a slice."""
        if self.finished:
            return False
        if self._provable and self.path is None and self.search.iterations >= FIRST_ITERATIONS:
            if self.proof is None:
                self.proof = NoPathProof(self._space, self._query)
            if self.proof.advance():
                self.outcome = self.proof.outcome
                self.finished = self.outcome == "no path"
        if self.finished or not self.search.advance(iterations):
            return False
        self.path, self.cost, self.outcome = self.search.path, self.search.cost, "path"
        return True
