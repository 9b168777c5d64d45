"""Decides a query: a path, or a proof that there is none, whichever comes first."""

import math
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor

from stages.needle.environment import NeedleEnvironment
from stages.needle.infeasibility.certificate import NoPathProof
from stages.needle.infeasibility.passage import Passage
from stages.needle.objective import SHORTEST, Objective
from stages.needle.path import ArcPath, Query
from stages.needle.search.base import Search
from stages.needle.search.portfolio import PortfolioSearch
from stages.needle.search.resolution import ResolutionSearch

ENDS_FROM = 100
"""Iterations before start and target are looked at, which takes a tenth as long."""
PIECE = 200
"""Iterations between two steps of the proof, a few tenths of a millisecond."""
BETTER_SHARE = 1 / 3
"""The same with a path: the portfolio has the rest, as each refined path ends at the cheapest near it."""
CUBES, MORE_CUBES = 2, 300
"""Cubes that the proof fills for an iteration, before and afterwards; an iteration takes as long as ten."""


class Decision:
    """Looks for a path, and for a proof that there is none.

    It is a `stages.needle.search.base.Search`.  The tree begins; then the resolution search, which finds
    narrow passages soonest, has most of the iterations, and the tree the rest.  The portfolio that the tree
    belongs to improves on what either has found.  The proof takes turns with the searches: start and target
    are looked at early, cubes are filled a few at a time and, once most paths are found, many at a time.
    Planes come last; as a single one may take a second, they have a thread of their own.

    What path is found after how many iterations does not depend on the thread, since there is no path where
    the proof succeeds.  A proof by planes may come sooner on a faster machine; the searches wait for a plane
    that has taken as many iterations as it should, so that the proof goes on where there is only one core.

    Attributes:
        outcome: "running", "path", "no path" (proved) or "undecided" (the proof has come to its end without a
            result; the search for a path can go on).
    """

    def __init__(
        self, environment: NeedleEnvironment, query: Query, seed: int = 1, objective: Objective = SHORTEST
    ) -> None:
        self._asked = (environment, query, objective)
        self.search = PortfolioSearch(environment, query, seed=seed, objective=objective)
        self._resolution: ResolutionSearch | None = None
        self._proof: NoPathProof | None = None
        self._planes: _PlanesInThread | None = None
        self._looked = 0
        self._turns = self._take_turns()
        self._turn: tuple[Search, int] = (self.search, 0)
        self.path: ArcPath | None = None
        self.cost = math.inf
        self.finished = False
        self.outcome = "running"
        self.iterations = 0

    def advance(self, iterations: int) -> bool:
        """Search for so many iterations; without a path, go on with the proof too."""
        while iterations > 0 and not self.finished:
            search, left = self._turn
            spent = min(left, iterations)
            self._turn = (search, left - spent)
            iterations -= spent
            self.iterations += spent
            if spent and self._went_on(search, spent):
                return True
            if left == spent:
                self._turn = next(self._turns)
        return False

    @property
    def resolution(self) -> ResolutionSearch:
        """The resolution search; it is made when it is needed."""
        if self._resolution is None:
            environment, query, objective = self._asked
            self._resolution = ResolutionSearch(environment, query, objective=objective)
            self._resolution.cost = self.cost
        return self._resolution

    @property
    def passage(self) -> Passage | None:
        """The narrowest place that the proof left open; None with a path, and before the proof has looked."""
        return None if self.path is not None or self._proof is None else self._proof.passage

    def _take_turns(self) -> Iterator[tuple[Search, int]]:
        """Yield which search goes on for how many iterations; let the proof go on in between."""
        yield self.search, ENDS_FROM
        if self.path is None:
            self._prove()
        # The tree goes first: nearly all paths that it finds before the resolution search are found by then.
        yield self.search, 400 - ENDS_FROM
        while True:
            # In narrow passages it nearly always finds the first path, at most a fifth later than alone.
            share = (5 / 6) if self.path is None else BETTER_SHARE
            words = 0 if self.resolution.finished else round(share * PIECE)
            yield self.resolution, words
            yield self.search, PIECE - words
            if self.path is None:
                self._prove()

    def _went_on(self, search: Search, iterations: int) -> bool:
        """Advance one search; tell whether its path is cheaper than all before, and let the other know."""
        if not search.advance(iterations) or search.path is None or not search.cost < self.cost:
            return False
        self.path, self.cost, self.outcome = search.path, search.cost, "path"
        if search is not self.search:
            self.search.adopt(self.path, self.cost)
        elif self._resolution is not None:
            self._resolution.cost = self.cost
        return True

    def _prove(self) -> None:
        if self._proof is None:
            environment, query, _objective = self._asked
            self._proof = NoPathProof(environment, query)
        # Iterations before the proof goes on with planes.
        if self._proof.states > 0 and self.iterations < 3000:
            return
        # With fewer on a plane, a step takes about a millisecond, and so no thread.
        if self._proof.states < 1000:
            spent, self._looked = self.iterations - self._looked, self.iterations
            # Iterations in which nearly all paths are found.  Until then the proof has about a sixth of the
            # time, and afterwards most of it while it fills cubes.
            self._proof.advance(spent * (CUBES if self.iterations < 1600 else MORE_CUBES))
            self.outcome = self._proof.outcome
        else:
            self._planes = self._planes or _PlanesInThread(self._proof)
            self.outcome = self._planes.outcome_after(self.iterations)
        self.finished = self.outcome == "no path"


class _PlanesInThread:
    """A proof that takes its steps in a thread, and stops where nobody looks at it."""

    def __init__(self, proof: NoPathProof) -> None:
        self._proof = proof
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="no-path-proof")
        self._step: Future[bool] | None = None
        self._due = 0

    def outcome_after(self, iterations: int) -> str:
        """Return the proof's outcome once the searches have spent so many iterations; begin its next step."""
        if self._step is not None and (self._step.done() or iterations >= self._due):
            self._step.result()
            self._step = None
        if self._step is not None or self._proof.outcome != "running":
            return self._proof.outcome if self._step is None else "running"
        # Iterations for a step of the proof, and one more for so many states on a plane; these take a third
        # of the time of so many iterations: the searches wait only where the proof has no core of its own.
        self._due = iterations + 300 + self._proof.states // 100
        self._step = self._pool.submit(self._proof.advance)
        return "running"
