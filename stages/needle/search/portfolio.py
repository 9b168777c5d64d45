"""A portfolio of optimal searches, each with its own path between the obstacles, under successive halving."""

import math
from collections.abc import Callable, Generator, Iterator
from itertools import count
from operator import attrgetter
from typing import TypeVar, Union

import numpy as np

from stages.needle.environment import NeedleEnvironment
from stages.needle.objective import SHORTEST, Objective
from stages.needle.path import ArcPath, Query
from stages.needle.search.guide_paths import GuidePathFinder, Work
from stages.needle.search.optimal import OptimalSearch

FIRST_SIZE, LARGEST_SIZE = 4, 64
"""Searches in the first round of halving; each round has twice as many as the one before, up to the largest.
Powers of two, so that halving ends with one."""
FIRST_ITERATIONS = 500
"""Iterations of a search on the first rung: a few times as many as most searches take to find a path."""
SLICE = 100
"""A search without a path goes on in slices of so many iterations, and stops when it has a path."""
GUIDED_SHARE = 2 / 3
"""Share of the iterations, once there is a path, for rounds of guided searches, if there are guide paths: on
cost maps they find most cheap paths, but in narrow passages a lattice may have none
(docs/explanation/needle.md)."""

FREE, GUIDED = 0, 1


class PortfolioSearch:
    """Finds a path as `OptimalSearch` does, and cheaper ones far from it; a `Search`.

    A path is varied until it is the cheapest near it, and the tree seldom finds a path elsewhere that is at
    once cheaper than a path made so cheap.  So further searches begin anew with random numbers of their own,
    and are refined too before they are compared, in rounds of successive halving [Jamieson2016].
    The best path so far takes part in every round.

    Where more than length counts, such rounds alternate with rounds of guided searches: these begin with
    guide paths on state lattices, and those that go on take the cheapest guide path near their own, see
    `search.guide_paths`.  Where no lattice has a guide path, the free rounds have all the time.

    Args:
        seed: Of the first search; it is alone until it has found a path.
    """

    def __init__(
        self, environment: NeedleEnvironment, query: Query, seed: int = 1, objective: Objective = SHORTEST
    ) -> None:
        self.path: ArcPath | None = None
        self.cost = math.inf
        self.finished = False
        self.iterations = 0
        """Iterations spent so far, by all searches."""
        self._environment, self._query, self._seed, self._objective = environment, query, seed, objective
        self._adopted: tuple[ArcPath, float] | None = None
        self._made = [0, 0]
        self._patience = 0
        self._free = _Turns(self._free_turns())
        self._guided: tuple[GuidePathFinder, _Turns] | None = None

    def advance(self, iterations: int) -> bool:
        """Go on with the search whose turn it is; see `stages.needle.search.base.Search`."""
        left = iterations
        while left > 0:
            worker, used, found = self._next().advance(left)
            self.iterations += used
            left -= used
            if found and worker.cost < self.cost:
                self.path, self.cost = worker.path, worker.cost
                return True
            if used == 0 and not found:
                return False
        return False

    def adopt(self, path: ArcPath, cost: float) -> None:
        """Go on from a path that another search found for the same query and objective."""
        self.path, self.cost = path, cost
        self._adopted = path, cost

    def _next(self) -> "_Turns":
        """Return the turns that have had less than their share, guided ones only if there are guide paths."""
        if self._guided is None:
            # Of pure length, trees and refinement find the least as fast.
            if self.path is None or self._objective.is_length:
                return self._free
            self._patience = self._free.spent
            self._free.spent = 0
            finder = GuidePathFinder(self._environment, self._query, self._seed, self._objective)
            self._guided = finder, _Turns(self._guided_turns(finder))
        finder, guided = self._guided
        is_behind = (1.0 - GUIDED_SHARE) * guided.spent <= GUIDED_SHARE * self._free.spent
        return guided if is_behind and finder.has_guide_paths else self._free

    def _new(self, kind: int) -> OptimalSearch:
        """Return another search, FREE or GUIDED, with random numbers of its own."""
        seed = self._seed
        if kind == GUIDED or self._made[kind]:
            numbers = [self._seed, self._made[kind], *([GUIDED] if kind == GUIDED else [])]
            seed = int(np.random.SeedSequence(numbers).generate_state(1, np.uint64)[0])
        self._made[kind] += 1
        return OptimalSearch(self._environment, self._query, seed=seed, objective=self._objective)

    def _free_turns(self) -> "Iterator[Turn]":
        """Yield whose turn it is and for how many iterations, for ever."""
        best, size = self._new(FREE), FIRST_SIZE
        while self.path is None:
            yield best, SLICE
        patience = best.iterations
        while True:
            if self._adopted and self._adopted[1] < best.cost:
                best.adopt(*self._adopted)
            best = yield from self._round([best, *(self._new(FREE) for _ in range(size - 1))], patience)
            size = min(2 * size, LARGEST_SIZE)

    def _guided_turns(self, finder: GuidePathFinder) -> "Iterator[Turn]":
        best, size = self._new(GUIDED), FIRST_SIZE
        while True:
            if self.path is not None and self.cost < best.cost:
                best.adopt(self.path, self.cost)
            searches = [best, *(self._new(GUIDED) for _ in range(size - 1))]
            best = yield from self._round(searches, self._patience, finder)
            size = min(2 * size, LARGEST_SIZE)

    def _round(
        self, searches: list[OptimalSearch], patience: int, finder: GuidePathFinder | None = None
    ) -> "Generator[Turn, None, OptimalSearch]":
        """Yield the turns of a round of halving, guided if a finder is given; return the best.  A search
        takes `patience` iterations at least to find its first path."""
        rung = searches
        halves = successive_halving(
            searches, attrgetter("cost"), work=FIRST_ITERATIONS, survivors=lambda size, _finite: size // 2
        )
        for rung, work in halves:
            if finder is not None and rung is not searches:
                for search in rung:
                    yield from _done(search, finder.improve(search, self.cost))
            for search in rung:
                if finder is not None and search.path is None:
                    yield from _done(search, finder.begin(search, self.cost))
                yield from _found_and_refined(search, work, patience)
        return rung[0]


_Worker = Union[OptimalSearch, "_Done"]
Turn = tuple[_Worker, int]
"""What takes turns, a search or work that is done, and for how many iterations."""


class _Turns:
    """Turns that are taken one after the other, and the iterations spent."""

    def __init__(self, turns: Iterator[Turn]) -> None:
        self.spent = 0
        self._turns = turns
        self._worker: _Worker
        self._worker, self._left = next(turns)

    def advance(self, iterations: int) -> tuple[_Worker, int, bool]:
        """Go on with a turn, not beyond it; return whose it is, iterations spent, and what it returned."""
        if self._left <= 0:
            self._worker, self._left = next(self._turns)
        before = self._worker.iterations
        found = self._worker.advance(min(iterations, self._left))
        used = self._worker.iterations - before
        self._left -= used
        self.spent += used
        return self._worker, used, found


class _Done:
    """Work that was done for a search, of which the iterations that it took are still to be counted."""

    def __init__(self, search: OptimalSearch, found: bool) -> None:
        self.path, self.cost = search.path, search.cost
        self.iterations = 0
        self._found = found

    def advance(self, iterations: int) -> bool:
        """Count iterations; tell once whether a better path was found."""
        self.iterations += iterations
        found, self._found = self._found, False
        return found


def _done(search: OptimalSearch, work: Iterator[Work]) -> Iterator[Turn]:
    """Do work for a search piece by piece."""
    for iterations, found in work:
        yield _Done(search, found), iterations


def _found_and_refined(search: OptimalSearch, iterations: int, patience: int) -> Iterator[Turn]:
    """Let a search find its first path, no longer than `patience` or a rung lasts, and refine it."""
    spent = 0
    while search.path is None and spent < max(patience, iterations):
        yield search, SLICE
        spent += SLICE
    if search.path is not None:
        yield search, iterations


C = TypeVar("C")


def successive_halving(
    candidates: list[C],
    cost: Callable[[C], float],
    *,
    work: int,
    survivors: Callable[[int, int], int],
    rungs: int | None = None,
) -> Iterator[tuple[list[C], int]]:
    """Yield the candidates of each rung, and how much work each of them is to get on it.

    The caller does the work before it asks for the next rung.  The cheapest candidates go on to that, the
    cheapest first, for twice the work each; those of infinite cost go no further.  `survivors` returns how
    many go on, given how many a rung had and how many of them have a finite cost.  By default the last rung
    is the first that has no more than one candidate.
    """
    for rung in count() if rungs is None else range(rungs):
        yield candidates, work << rung
        if rungs is None and len(candidates) <= 1:
            return
        finite = sorted((each for each in candidates if math.isfinite(cost(each))), key=cost)
        candidates = finite[: survivors(len(candidates), len(finite))]
