"""Decides a query: a path, or a proof that there is none, whichever comes first."""

from __future__ import annotations

import math
import time
from concurrent.futures import Future, ThreadPoolExecutor

from stages.needle.environment import NeedleEnvironment
from stages.needle.infeasibility.certificate import NoPathProof
from stages.needle.infeasibility.passage import Passage
from stages.needle.objective import SHORTEST, Objective
from stages.needle.path import ArcPath
from stages.needle.query import Query
from stages.needle.search.base import Search
from stages.needle.search.optimal import OptimalSearch
from stages.needle.search.resolution import ResolutionSearch

FIRST_ITERATIONS = 200
"""Of the tree alone: half of the paths are found by then, before the other search is made."""
PROOF_FROM = 400
"""Iterations before the proof is made: it takes as long to begin as the resolution search takes for a path
that is not narrow."""
PIECE = 200
"""Iterations between two looks at the proof, a few tenths of a millisecond."""
RESOLUTION_SHARE = 5 / 6
"""Share of the iterations without a path: in narrow passages it is nearly always the first, and so it is at
most a fifth later than alone."""
STATES_PER_ITERATION = 100
"""States on a plane of the proof for one iteration of the searches; these take a third of the time of so many
iterations, so that the searches wait only where the proof has no core of its own."""
STEP_ITERATIONS = 1000
"""Iterations for a step of the proof on top."""
UNLOOKED_S = 0.001
"""How long the proof goes on before it is looked at: some pieces of the searches."""


class Decision:
    """Looks for a path and, in a thread of its own, for a proof that there is none.

    It is a `stages.needle.search.base.Search`.  The tree begins; then the resolution search, which finds
    narrow passages soonest, has most of the iterations, and the tree the rest.  The optimal search improves
    on what either has found.

    What path is found after how many iterations does not depend on the thread, since there is none where
    the proof succeeds.  A proof may come sooner on a faster machine; the searches wait for a step of it that
    has taken as many iterations as it should, so that it goes on where there is only one core.

    Attributes
    ----------
    outcome : str
        "running", "path", "no path" (proved) or "undecided" (the proof has come to its end without a
        result; the search for a path can go on).
    """

    def __init__(
        self, environment: NeedleEnvironment, query: Query, *, seed: int = 1, objective: Objective = SHORTEST
    ) -> None:
        self._asked = (environment, query, objective)
        self.search = OptimalSearch(environment, query, seed=seed, objective=objective)
        self._resolution: ResolutionSearch | None = None
        self._proof: _ProofInThread | None = None
        self.path: ArcPath | None = None
        self.cost = math.inf
        self.finished = False
        self.outcome = "running"
        self.iterations = 0

    def advance(self, iterations: int) -> bool:
        """Search for so many iterations; without a path, go on with the proof beside it."""
        better, left = False, iterations
        while left > 0 and not better and not self.finished:
            piece = left if self.path is not None else min(PIECE, left)
            left -= piece
            better = self._search(piece)
            if self.path is None and self.iterations >= PROOF_FROM:
                self._prove()
        return better

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

    def _search(self, iterations: int) -> bool:
        """Spend iterations on the searches; return whether there is a better path."""
        begins = self.iterations < FIRST_ITERATIONS
        self.iterations += iterations
        if begins or self.resolution.finished:
            return self._went_on(self.search, iterations)
        share = 0.5 if self.path is not None else RESOLUTION_SHARE
        first = self._went_on(self.resolution, math.ceil(share * iterations))
        return self._went_on(self.search, math.ceil((1.0 - share) * iterations)) or first

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
        """Take over what the proof has found meanwhile, and let it go on."""
        if self._proof is None:
            environment, query, _objective = self._asked
            proof = NoPathProof(environment, query)
            proof.advance()  # A tenth of a millisecond, which decides what is out of reach.
            self._proof = _ProofInThread(proof)
        self.outcome = self._proof.outcome_after(self.iterations)
        self.finished = self.outcome == "no path"


class _ProofInThread:
    """A proof that takes its steps in a thread, and stops where nobody looks at it."""

    def __init__(self, proof: NoPathProof) -> None:
        self._proof = proof
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="no-path-proof")
        self._step: Future[None] | None = None
        self._due = 0

    def outcome_after(self, iterations: int) -> str:
        """Return the proof's outcome once the searches have spent so many iterations; begin its next step."""
        if self._step is not None and (self._step.done() or iterations >= self._due):
            self._step.result()
            self._step = None
        if self._step is not None or self._proof.outcome != "running":
            return self._proof.outcome if self._step is None else "running"
        self._due = iterations + STEP_ITERATIONS + self._proof.states // STATES_PER_ITERATION
        self._step = self._pool.submit(self._take_steps)
        return "running"

    @property
    def passage(self) -> Passage | None:
        """What the last finished level of the proof left."""
        return self._proof.passage

    def _take_steps(self) -> None:
        """Take a step, and more of them while nobody would look."""
        began = time.perf_counter()
        while not self._proof.advance() and time.perf_counter() - began < UNLOOKED_S:
            pass
