"""What leads searches to cheap ways: lattices over all of the space, and finer ones around a way."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from anatomy.grid import Float
from stages.needle.lattice import Lattices, Ways, via_points
from stages.needle.objective import Objective
from stages.needle.optimal import OptimalSearch
from stages.needle.searches import Query
from stages.needle.space import NeedleSpace

STATES_PER_ITERATION = 8
"""States of a lattice take as long as one iteration of a search."""
LAYERS = (12, 14, 16)
"""Of lattices: over all of the space one after the other, around a path one of them drawn."""
CELLS = (1 / 3, 1 / 6, 1 / 3, 1 / 6)
"""Of lattices around a way, one after the other, as shares of what the greatest curvature allows."""
SKEWS = 6
"""Lattices are turned in so many ways."""
MOST_COST = 2.0
"""A way that costs more than so many times the best path is left when it was made cheaper twice."""
SPARE_COST = 1.5
"""By so much more than its path, a way near a path may cost first: straight pieces and arcs differ."""

ROUNDING = 1e-9

Work = tuple[int, bool]
"""What was done for a search: the iterations that it took, and whether it found a cheaper path."""


class WayFinder:
    """Finds ways for the searches of a race.

    Parameters
    ----------
    space : NeedleSpace
    query : Query
    seed : int
        Of how lattices are turned.
    objective : Objective
    """

    def __init__(self, space: NeedleSpace, query: Query, *, seed: int, objective: Objective) -> None:
        self._lattices = Lattices(space, query, objective)
        self._random = np.random.default_rng(seed)
        self._layers = list(LAYERS) if self._lattices.is_possible else []
        self._tried = 0
        self.has_ways = bool(self._layers)
        """Whether lattices over all of the space may have ways; no longer once none of them had any."""
        self._found_any = False

    def begin(self, search: OptimalSearch, best: float) -> Iterator[Work]:
        """Lead a search that has no path to the next way, if there is one, and make it cheaper.

        `best` is the cost of the best path.
        """
        if not self.has_ways:
            return
        ways = self._look_everywhere()
        yield _iterations(ways.states), False
        if len(ways.controls):
            search.follow(via_points(ways.controls[0]))
            yield from self._climb(search, ways.controls[0], float(ways.costs[0]) * (1.0 + ROUNDING), best)

    def improve(self, search: OptimalSearch, best: float) -> Iterator[Work]:
        """Lead a search to the cheapest way near its path; `best` is the cost of the best path."""
        if search.path is None or not self._lattices.is_possible:
            return
        layers = LAYERS[int(self._random.integers(len(LAYERS)))]
        controls = self._lattices.controls_of(search.path, layers)
        if controls is not None:
            yield from self._climb(search, controls, SPARE_COST * search.cost, best)

    def _look_everywhere(self) -> Ways:
        """Return the cheapest way of the next lattice; the next time it is another one."""
        layers = self._layers[self._tried % len(self._layers)]
        ways = self._lattices.everywhere(layers, skew=int(self._random.integers(SKEWS)))
        self._tried += 1
        if not ways.is_whole:
            self._layers = [each for each in self._layers if each < layers]
        self._found_any = self._found_any or len(ways.controls) > 0
        self.has_ways = bool(self._layers) and (self._found_any or self._tried < len(LAYERS))
        return ways

    def _climb(self, search: OptimalSearch, controls: Float, bound: float, best: float) -> Iterator[Work]:
        """Go to the cheapest way around the last one, again and again."""
        for n, cells in enumerate(CELLS):
            if 2 * n >= len(CELLS) and bound > MOST_COST * best:
                return
            turn = float(self._random.uniform(0.0, math.pi / 3.0))
            ways = self._lattices.around(controls, cells, turn, bound)
            found = False
            if len(ways.controls):
                controls, bound = ways.controls[0], float(ways.costs[0]) * (1.0 + ROUNDING)
                found = search.follow(via_points(controls))
            yield _iterations(ways.states), found


def _iterations(states: int) -> int:
    return 1 + states // STATES_PER_ITERATION
