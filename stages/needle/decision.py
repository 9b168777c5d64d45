"""Decides a query: a path, or a proof that there is none, whichever comes first."""

from __future__ import annotations

from stages.needle.certificate import NoPathProof
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
        self._make_proof = lambda: NoPathProof(space, query)
        self.proof: NoPathProof | None = None

    @property
    def path(self) -> ArcPath | None:
        """The best path so far."""
        return self.search.path

    @property
    def cost(self) -> float:
        """Its cost."""
        return self.search.cost

    @property
    def outcome(self) -> str:
        """See the class."""
        if self.search.path is not None:
            return "path"
        return "running" if self.proof is None else self.proof.outcome

    @property
    def finished(self) -> bool:
        """Whether there is a proof that there is no path."""
        return self.outcome == "no path"

    def advance(self, iterations: int) -> bool:
        """Search for so many iterations and, from some number on without a path, prove one step a slice."""
        if self.finished:
            return False
        if self.search.path is None and self.search.iterations >= FIRST_ITERATIONS:
            if self.proof is None:
                self.proof = self._make_proof()
            if self.proof.advance() and self.finished:
                return False
        return self.search.advance(iterations)
