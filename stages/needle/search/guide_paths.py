"""Guide paths for searches: from state lattices over all of the space, and from finer ones around a path."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import product
from operator import itemgetter

import numpy as np

from anatomy.base.typed import Float
from stages.needle.environment import NeedleEnvironment
from stages.needle.objective import Objective
from stages.needle.query import Query
from stages.needle.search.optimal import OptimalSearch
from stages.needle.search.state_lattice import SKEWS, StateLatticeSearch, via_points

ARCS_PER_ITERATION = 8
"""Arcs of a lattice take as long as one iteration of a search."""
LAYERS = (12, 14, 16)
"""Numbers of layers of the lattices over all of the space, which are searched one after the other; those
around a path have one of them, drawn.  A number is given up when its lattices have too many states."""
CELLS = (1 / 3, 1 / 6)
"""Sizes of the cells of lattices around a guide path, one after the other, as shares of the largest cell that
curvature allows."""
LEAST_GAIN = 0.01
"""A guide path is refined again and again as long as it gains this share of its cost each time."""
ARCS_PER_BEGINNING = 1 << 16
"""Before each search but the first, lattices are searched until so many arcs were tried.  That takes less
time than to refine the guide path, and cheap guide paths lead to cheaper ones."""
MOST_COST = 2.0
"""A guide path that costs more than so many times the best path is refined only once."""
SPARE_COST = 1.5
"""A guide path near a path may at first cost so many times as much, since it is not quite that path."""
ROUNDING = 1e-9
"""The cost of a guide path may be so much greater, as a share, when the same one is found again."""

Work = tuple[int, bool]
"""What was done for a search: the iterations that it took, and whether it found a cheaper path."""


class GuidePathFinder:
    """Finds guide paths for the searches of a portfolio.

    Parameters
    ----------
    seed : int
        Of how lattices are turned.
    """

    def __init__(
        self, environment: NeedleEnvironment, query: Query, *, seed: int, objective: Objective
    ) -> None:
        self._lattices = StateLatticeSearch(environment, query, objective)
        self._random = np.random.default_rng(seed)
        self._layers: tuple[int, ...] = LAYERS
        self._unsearched = list(product(range(SKEWS), LAYERS)) if self._lattices.is_possible else []
        self._searched = 0
        self._unused: list[tuple[float, Float]] = []
        self._used: list[tuple[float, Float]] = []
        self.has_guide_paths = bool(self._unsearched)
        """Whether lattices over all of the space may have guide paths; False once the first ones had none."""

    def begin(self, search: OptimalSearch, best: float) -> Iterator[Work]:
        """Lead a search that has no path to a guide path, if there is one, and refine that.

        It is the cheapest of those found so far with which no search began, and the cheapest of all once
        there is no other.  `best` is the cost of the best path.
        """
        yield from self._search_everywhere()
        if not self._unused:
            self._unused, self._used = self._used, []
        if not self._unused:
            return
        self._unused.sort(key=itemgetter(0))
        cost, controls = self._unused[0]
        self._used.append(self._unused.pop(0))
        search.follow(via_points(controls))
        yield from self._refine(search, controls, cost * (1.0 + ROUNDING), best)

    def improve(self, search: OptimalSearch, best: float) -> Iterator[Work]:
        """Lead a search to the cheapest guide path near its path; `best` is the cost of the best path."""
        if search.path is None or not self.has_guide_paths or not self._layers:
            return
        layers = self._layers[int(self._random.integers(len(self._layers)))]
        controls = self._lattices.controls_of(search.path, layers)
        if controls is not None:
            yield from self._refine(search, controls, SPARE_COST * search.cost, best)

    def _search_everywhere(self) -> Iterator[Work]:
        """Find the cheapest guide paths of some more lattices; only a first one if no search has begun."""
        tried = 0
        while self._unsearched and (tried < ARCS_PER_BEGINNING if self._used else not self._unused):
            skew, layers = self._unsearched.pop(0)
            guide = self._lattices.everywhere(layers, skew=skew)
            tried += guide.arcs
            if guide.controls is not None:
                self._unused.append((guide.cost, guide.controls))
            if not guide.is_whole:
                self._layers = tuple(each for each in self._layers if each < layers)
                self._unsearched = [each for each in self._unsearched if each[1] in self._layers]
            self._searched += 1
            if self._searched >= len(LAYERS) and not self._unused and not self._used:
                self._unsearched.clear()
            self.has_guide_paths = bool(self._unsearched or self._unused or self._used)
            yield _iterations(guide.arcs), False

    def _refine(self, search: OptimalSearch, controls: Float, bound: float, best: float) -> Iterator[Work]:
        """Go to the cheapest guide path around the last one, as long as that gains enough."""
        while True:
            before = bound
            for cells in CELLS:
                turn = float(self._random.uniform(0.0, math.pi / 3.0))
                guide = self._lattices.around(controls, cells, turn, bound)
                found = False
                if guide.controls is not None:
                    controls, bound = guide.controls, guide.cost * (1.0 + ROUNDING)
                    found = search.follow(via_points(controls))
                yield _iterations(guide.arcs), found
            if bound > (1.0 - LEAST_GAIN) * before or bound > MOST_COST * best:
                return


def _iterations(arcs: int) -> int:
    return 1 + arcs // ARCS_PER_ITERATION
