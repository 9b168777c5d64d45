"""What leads searches to cheap ways: lattices over all of the space, and finer ones around a way."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import product
from operator import itemgetter

import numpy as np

from anatomy.typed import Float
from stages.needle.objective import Objective
from stages.needle.search.base import Query
from stages.needle.search.optimal import OptimalSearch
from stages.needle.search.state_lattice import SKEWS, Lattices, via_points
from stages.needle.space import NeedleSpace

ARCS_PER_ITERATION = 8
"""Arcs of a lattice take as long as one iteration of a search."""
LAYERS = (12, 14, 16)
"""Of lattices: over all of the space one after the other, around a path one of them drawn.

No more of those are used of which there are too many states.
"""
CELLS = (1 / 3, 1 / 6)
"""Of lattices around a way, one after the other, as shares of what the greatest curvature allows."""
LEAST_GAIN = 0.01
"""A way is made cheaper again and again as long as it gains this share of its cost each time."""
LOOK_ARCS = 1 << 16
"""Before each search but the first, lattices are looked at until so many arcs were tried."""
MOST_COST = 2.0
"""A way that costs more than so many times the best path is made cheaper only once."""
SPARE_COST = 1.5
"""By so much more than its path, a way near a path may cost first: it is not quite that path."""

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
        self._layers: tuple[int, ...] = LAYERS
        self._unseen = list(product(range(SKEWS), LAYERS)) if self._lattices.is_possible else []
        self._seen = 0
        self._ways: list[tuple[float, Float]] = []
        self._begun: list[tuple[float, Float]] = []
        self.has_ways = bool(self._unseen)
        """Whether lattices over all of the space may have ways; no longer once the first ones had none."""

    def begin(self, search: OptimalSearch, best: float) -> Iterator[Work]:
        """Lead a search that has no path to a way, if there is one, and make it cheaper.

        It is the cheapest of those found so far with which no search began, and the cheapest of all once
        there is no other.  `best` is the cost of the best path.
        """
        yield from self._look_everywhere()
        if not self._ways:
            self._ways, self._begun = self._begun, []
        if not self._ways:
            return
        self._ways.sort(key=itemgetter(0))
        cost, controls = self._ways[0]
        self._begun.append(self._ways.pop(0))
        search.follow(via_points(controls))
        yield from self._climb(search, controls, cost * (1.0 + ROUNDING), best)

    def improve(self, search: OptimalSearch, best: float) -> Iterator[Work]:
        """Lead a search to the cheapest way near its path; `best` is the cost of the best path."""
        if search.path is None or not self.has_ways or not self._layers:
            return
        layers = self._layers[int(self._random.integers(len(self._layers)))]
        controls = self._lattices.controls_of(search.path, layers)
        if controls is not None:
            yield from self._climb(search, controls, SPARE_COST * search.cost, best)

    def _look_everywhere(self) -> Iterator[Work]:
        """Find the cheapest ways of some more lattices; only a first one if no search has begun."""
        tried = 0
        while self._unseen and (tried < LOOK_ARCS if self._begun else not self._ways):
            skew, layers = self._unseen.pop(0)
            way = self._lattices.everywhere(layers, skew=skew)
            tried += way.arcs
            if way.controls is not None:
                self._ways.append((way.cost, way.controls))
            if not way.is_whole:
                self._layers = tuple(each for each in self._layers if each < layers)
                self._unseen = [each for each in self._unseen if each[1] in self._layers]
            self._seen += 1
            if self._seen >= len(LAYERS) and not self._ways and not self._begun:
                self._unseen.clear()
            self.has_ways = bool(self._unseen or self._ways or self._begun)
            yield _iterations(way.arcs), False

    def _climb(self, search: OptimalSearch, controls: Float, bound: float, best: float) -> Iterator[Work]:
        """Go to the cheapest way around the last one, as long as that makes it cheaper."""
        while True:
            before = bound
            for cells in CELLS:
                turn = float(self._random.uniform(0.0, math.pi / 3.0))
                way = self._lattices.around(controls, cells, turn, bound)
                found = False
                if way.controls is not None:
                    controls, bound = way.controls, way.cost * (1.0 + ROUNDING)
                    found = search.follow(via_points(controls))
                yield _iterations(way.arcs), found
            if bound > (1.0 - LEAST_GAIN) * before or bound > MOST_COST * best:
                return


def _iterations(arcs: int) -> int:
    return 1 + arcs // ARCS_PER_ITERATION
