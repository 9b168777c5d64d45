"""Optimal searches that race: each finds its own way between the obstacles, and the better half goes on."""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator
from typing import Protocol

import numpy as np

from stages.needle.objective import SHORTEST, Objective
from stages.needle.path import ArcPath
from stages.needle.search.base import Query
from stages.needle.search.guide_paths import WayFinder, Work
from stages.needle.search.optimal import OptimalSearch
from stages.needle.space import NeedleSpace

FIRST_RACE, LARGEST_RACE = 4, 64
"""Searches in the first race; each race has twice as many as the one before, up to the largest."""
FIRST_HEAT = 500
"""Iterations of a search in the first heat of a race; twice as many in each heat that follows."""
LOOK = 100
"""A search without a path is looked at after so many iterations."""
LED_SHARE = 2 / 3
"""Share of the iterations, once there is a path, for races of searches that are led, if there are ways."""

FREE, LED = 0, 1


class RacingSearch:
    """Finds a path as `OptimalSearch` does, and cheaper ones among other ways; a `Search`.

    A path is varied until it is the cheapest near it, and the tree seldom finds another way that is at once
    cheaper than a path made so cheap.  So further searches begin anew with numbers of their own, and are made
    cheaper too before they are compared.  The best path so far takes part in every race.

    Where more than length counts, such races take turns with others, whose searches are led: they begin with
    ways on lattices, and those that go on take the cheapest way near their own, see `search.guide_paths`.
    Where no lattice has a way, the races without them have all the time.

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
        self._made = [0, 0]
        self._patience = 0
        self._free = _Turns(self._races())
        self._led: _Turns | None = None
        self._finder: WayFinder

    def advance(self, iterations: int) -> bool:
        """Go on with the search whose turn it is; see `stages.needle.search.base.Search`."""
        left = iterations
        while left > 0:
            turns = self._next()
            runner, used, found = turns.advance(left)
            self.iterations += used
            left -= used
            if found and runner.cost < self.cost:
                self.path, self.cost = runner.path, runner.cost
                return True
            if used == 0 and not found:
                return False
        return False

    def _next(self) -> _Turns:
        """Return the races that have had less than their share, those that are led only if there are ways."""
        if self._led is None:
            # Of pure length, trees and refinement find the least as fast.
            if self.path is None or self._objective.is_length:
                return self._free
            self._patience = self._free.spent
            self._free.spent = 0
            self._finder = WayFinder(self._space, self._query, seed=self._seed, objective=self._objective)
            self._led = _Turns(self._led_races())
        is_behind = (1.0 - LED_SHARE) * self._led.spent <= LED_SHARE * self._free.spent
        return self._led if is_behind and self._finder.has_ways else self._free

    def _new(self, kind: int) -> OptimalSearch:
        """Return another search, FREE or LED, with random numbers of its own."""
        seed = self._seed
        if kind == LED or self._made[kind]:
            numbers = [self._seed, self._made[kind], *([LED] if kind == LED else [])]
            seed = int(np.random.SeedSequence(numbers).generate_state(1, np.uint64)[0])
        self._made[kind] += 1
        return OptimalSearch(self._space, self._query, seed=seed, objective=self._objective)

    def _races(self) -> Iterator[Turn]:
        """Yield whose turn it is and for how many iterations, for ever."""
        best, size = self._new(FREE), FIRST_RACE
        while best.path is None:
            yield best, LOOK
        patience = best.iterations
        while True:
            runners = [best, *(self._new(FREE) for _ in range(size - 1))]
            best = yield from self._race(runners, patience)
            size = min(2 * size, LARGEST_RACE)

    def _led_races(self) -> Iterator[Turn]:
        """Yield turns of searches that are led."""
        best, size = self._new(LED), FIRST_RACE
        while True:
            if self.path is not None and self.cost < best.cost:
                best.adopt(self.path, self.cost)
            runners = [best, *(self._new(LED) for _ in range(size - 1))]
            best = yield from self._race(runners, self._patience, self._finder)
            size = min(2 * size, LARGEST_RACE)

    def _race(
        self, runners: list[OptimalSearch], patience: int, finder: WayFinder | None = None
    ) -> Generator[Turn, None, OptimalSearch]:
        """Yield the turns of a race, whose searches a finder leads if there is one; return the winner."""
        heat = FIRST_HEAT
        while len(runners) > 1:
            for runner in runners:
                if finder is not None and runner.path is None:
                    yield from _done(runner, finder.begin(runner, self.cost))
                yield from _heat(runner, heat, patience)
            runners, heat = _better_half(runners), 2 * heat
            if finder is not None:
                for runner in runners:
                    yield from _done(runner, finder.improve(runner, self.cost))
        yield runners[0], heat
        return runners[0]


class _Runner(Protocol):
    """What takes turns: a search, or work that is done."""

    iterations: int

    @property
    def path(self) -> ArcPath | None: ...

    @property
    def cost(self) -> float: ...

    def advance(self, iterations: int) -> bool: ...


Turn = tuple[_Runner, int]


class _Turns:
    """Turns that are taken one after the other, and the iterations spent."""

    def __init__(self, turns: Iterator[Turn]) -> None:
        self.spent = 0
        self._turns = turns
        self._runner: _Runner
        self._runner, self._left = next(turns)

    def advance(self, iterations: int) -> tuple[_Runner, int, bool]:
        """Go on with a turn, not beyond it; return whose it is, iterations spent, and what it returned."""
        if self._left <= 0:
            self._runner, self._left = next(self._turns)
        before = self._runner.iterations
        found = self._runner.advance(min(iterations, self._left))
        used = self._runner.iterations - before
        self._left -= used
        self.spent += used
        return self._runner, used, found


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


def _better_half(runners: list[OptimalSearch]) -> list[OptimalSearch]:
    arrived = sorted((each for each in runners if each.path is not None), key=lambda search: search.cost)
    return arrived[: len(runners) // 2]


def _heat(runner: OptimalSearch, iterations: int, patience: int) -> Iterator[Turn]:
    """Let a search find its first path, no longer than the first one took or a heat lasts, and refine it."""
    looked = 0
    while runner.path is None and looked < max(patience, iterations):
        yield runner, LOOK
        looked += LOOK
    if runner.path is not None:
        yield runner, iterations
