"""Optimal searches that race: each finds its own way between the obstacles, and the better half goes on."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Protocol

import numpy as np

from stages.needle.objective import SHORTEST, Objective
from stages.needle.optimal import OptimalSearch
from stages.needle.path import ArcPath
from stages.needle.searches import Query
from stages.needle.space import NeedleSpace
from stages.needle.ways import WayFinder, Work

FIRST_RACE, LARGEST_RACE = 4, 64
"""Searches in the first race; each race has twice as many as the one before, up to the largest."""
FIRST_HEAT = 500
"""Iterations of a search in the first heat of a race; twice as many in each heat that follows."""
LOOK = 100
"""A search without a path is looked at after so many iterations."""
RANDOM_ONES = 4
"""Every so many-th search begins at random though there are ways on lattices."""


class RacingSearch:
    """Finds a path as `OptimalSearch` does, and cheaper ones among other ways; a `Search`.

    A path is varied until it is the cheapest near it, and the tree seldom finds another way that is at once
    cheaper than a path made so cheap.  So further searches begin anew with numbers of their own, and are made
    cheaper too before they are compared.  The best path so far takes part in every race.

    Where more than length counts, most of them begin with a way on a lattice, and each that goes on is led to
    the cheapest way near its own first, see `stages.needle.ways`.

    Parameters
    ----------
    space : NeedleSpace
    query : Query
    seed : int
        Of the first search; it is alone until it has found a path.
    objective : Objective
    """

    def __init__(
        self, space: NeedleSpace, query: Query, *, seed: int = 1, objective: Objective = SHORTEST
    ) -> None:
        self.path: ArcPath | None = None
        self.cost = math.inf
        self.finished = False
        self.iterations = 0
        """Iterations spent so far, by all searches."""
        self._space, self._query, self._seed, self._objective = space, query, seed, objective
        self._made = 0
        self._turns = self._races()
        self._runner: _Runner
        self._runner, self._left = next(self._turns)

    def advance(self, iterations: int) -> bool:
        """Go on with the search whose turn it is; see `stages.needle.searches.Search`."""
        left = iterations
        while left > 0:
            if self._left <= 0:
                self._runner, self._left = next(self._turns)
            runner, before = self._runner, self._runner.iterations
            found = runner.advance(min(left, self._left))
            used = runner.iterations - before
            self.iterations += used
            left -= used
            self._left -= used
            if found and runner.cost < self.cost:
                self.path, self.cost = runner.path, runner.cost
                return True
            if used == 0 and not found:
                return False
        return False

    def _new(self) -> OptimalSearch:
        """Return another search, with random numbers of its own."""
        seed = self._seed
        if self._made:
            seed = int(np.random.SeedSequence([self._seed, self._made]).generate_state(1, np.uint64)[0])
        self._made += 1
        return OptimalSearch(self._space, self._query, seed=seed, objective=self._objective)

    def _races(self) -> Iterator[Turn]:
        """Yield whose turn it is and for how many iterations, for ever."""
        best, size = self._new(), FIRST_RACE
        while best.path is None:
            yield best, LOOK
        patience = best.iterations
        finder = self._way_finder()
        while True:
            runners, heat = [best, *(self._new() for _ in range(size - 1))], FIRST_HEAT
            while len(runners) > 1:
                for n, runner in enumerate(runners):
                    if finder is not None and n % RANDOM_ONES != 0 and runner.path is None:
                        yield from _done(runner, finder.begin(runner, self.cost))
                    yield from _heat(runner, heat, patience)
                arrived = sorted((each for each in runners if each.path is not None), key=lambda s: s.cost)
                runners, heat = arrived[: len(runners) // 2], 2 * heat
                for runner in runners if finder is not None else ():
                    yield from _done(runner, finder.improve(runner, self.cost))
            best = runners[0]
            yield best, heat
            size = min(2 * size, LARGEST_RACE)

    def _way_finder(self) -> WayFinder | None:
        """Return what finds ways; of pure length, trees and refinement find the least as fast."""
        if self._objective.is_length:
            return None
        return WayFinder(self._space, self._query, seed=self._seed, objective=self._objective)


class _Runner(Protocol):
    """What takes turns: a search, or work that is done."""

    iterations: int

    @property
    def path(self) -> ArcPath | None: ...

    @property
    def cost(self) -> float: ...

    def advance(self, iterations: int) -> bool: ...


Turn = tuple[_Runner, int]


class _Done:
    """Work that was done for a search, of which the iterations that it took are still to be counted."""

    def __init__(self, runner: OptimalSearch, found: bool) -> None:
        self.path, self.cost = runner.path, runner.cost
        self.iterations = 0
        self._found = found

    def advance(self, iterations: int) -> bool:
        """Count iterations; tell once whether a better path was found."""
        self.iterations += iterations
        found, self._found = self._found, False
        return found


def _done(runner: OptimalSearch, work: Iterator[Work]) -> Iterator[Turn]:
    """Do work for a search piece by piece."""
    for iterations, found in work:
        yield _Done(runner, found), iterations


def _heat(runner: OptimalSearch, iterations: int, patience: int) -> Iterator[Turn]:
    """Let a search find its first path, no longer than the first one took or a heat lasts, and refine it."""
    looked = 0
    while runner.path is None and looked < max(patience, iterations):
        yield runner, LOOK
        looked += LOOK
    if runner.path is not None:
        yield runner, iterations
