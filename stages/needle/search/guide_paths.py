"""Guide paths for searches: from state lattices over all of the space, and from finer ones around a path."""

import math
from collections.abc import Iterator
from itertools import product
from operator import itemgetter

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from stages.needle.environment import NeedleEnvironment, workspace_lengths
from stages.needle.kernels import proof as index
from stages.needle.objective import Objective
from stages.needle.path import ArcPath, Query
from stages.needle.search.kernels import state_lattice as kernel
from stages.needle.search.optimal import OptimalSearch

ARCS_PER_ITERATION = 8
"""Arcs of a lattice take as long as one iteration of a search."""
LAYERS = (12, 14, 16)
"""Numbers of layers of the lattices over all of the space, which are searched one after the other; those
around a path have one of them, drawn.  A number is given up when its lattices have too many states."""
CELLS = (1 / 3, 1 / 6)
"""Cells of lattices around a guide path, one after the other, as shares of the largest for its curvature."""
LEAST_GAIN = 0.01
"""A guide path is refined again and again as long as it gains this share of its cost each time."""
ARCS_PER_BEGINNING = 1 << 16
"""Before each search but the first, lattices are searched until so many arcs were tried.  That takes less
time than to refine the guide path, and cheap guide paths lead to cheaper ones."""
ROUNDING = 1e-9
"""The cost of a guide path may be so much greater, as a share, when the same one is found again."""

Work = tuple[int, bool]
"""What was done for a search: the iterations that it took, and whether it found a cheaper path."""


class GuidePathFinder:
    """Finds guide paths for the searches of a portfolio; the seed is that of how lattices are turned."""

    def __init__(self, environment: NeedleEnvironment, query: Query, seed: int, objective: Objective) -> None:
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
            # A guide path near a path may at first cost so many times as much: it is not quite that path.
            yield from self._refine(search, controls, 1.5 * search.cost, best)

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
            # A guide path that costs more than so many times the best path is refined only once.
            if bound > (1.0 - LEAST_GAIN) * before or bound > 2.0 * best:
                return


def _iterations(arcs: int) -> int:
    return 1 + arcs // ARCS_PER_ITERATION


MOST_STATES = 1 << 15
"""States of a lattice, in 2 MB; so many are searched in 0.1 s."""
CURVATURE_SHARE = 0.97
"""Share of the greatest curvature that guide paths take; arcs laid along them bend a little more."""
SKEWS = 6
"""Number of turns of a lattice about the line to the target."""


@frozen_record
class GuidePath:
    """The cheapest path through a state lattice of L layers, if there is one.

    Args:
        controls ((L + 2, 3) float64): Start, control points of a quadratic spline, target; None for no path.
        cost: Cost of the arcs along it, infinite without a path.
        arcs: Arcs that were tried, a measure of the work.
        is_whole: False if the lattice had too many states: then there is no path.
    """

    controls: Float | None
    cost: float
    arcs: int
    is_whole: bool


class StateLatticeSearch:
    """Finds guide paths on state lattices between a start pose and a target."""

    def __init__(self, environment: NeedleEnvironment, query: Query, objective: Objective) -> None:
        self._environment, self._query = environment, query
        self._objective = environment.objective_arrays(objective)
        self._kappa = CURVATURE_SHARE * environment.limits.kappa
        self._start, self._tangent = query.lps_from_start[:3, 3], query.lps_from_start[:3, 2]
        ahead = query.target - self._start
        self._distance = float(np.linalg.norm(ahead))
        self._axis = ahead / max(self._distance, index.MIN_ARC_MM)
        self._cosine = float(self._tangent @ self._axis)
        length = workspace_lengths(environment, self._start[None], self._tangent[None], query.target)[0]
        # The angle between start and line to the target has this cosine at least: from steeper starts, paths
        # may turn back across the layers.
        ahead_of_start = self._distance > index.MIN_ARC_MM and self._cosine > 0.3
        self.is_possible = bool(ahead_of_start and np.isfinite(length))
        """Whether there may be guide paths: the target is in the workspace, and the start not too steep."""
        self._states = np.zeros((MOST_STATES, kernel.STATE_COLUMNS), dtype=np.int64)
        self._before = np.zeros(MOST_STATES, dtype=np.int32)
        self._costs = np.zeros(MOST_STATES)
        self._order = np.zeros(MOST_STATES, dtype=np.int32)
        self._table = np.zeros(2 * MOST_STATES, dtype=np.int32)

    def everywhere(self, layers: int, *, skew: int = 0) -> GuidePath:
        """Return the cheapest guide path anywhere; `skew`, less than SKEWS, turns the lattice.

        More `layers` are finer, and take time by about the 7th power.
        """
        base, axes, goal_cells = self._straight(layers, skew)
        # No lattice over all of the space has as many cells.
        return self._explore(base, axes, goal_cells, 1 << 14, math.inf)

    def around(self, controls: Float, cells: float, turn_rad: float, bound: float = math.inf) -> GuidePath:
        """Return the cheapest guide path near the controls of another one, if it costs less than `bound`.

        `controls` `(L + 2, 3)` LPS mm are as those of `GuidePath`; `cells` is the size of a cell as a share
        of what the greatest curvature allows, and `turn_rad` turns the lattice about the line to the target.
        """
        axes = self._axes(cells * self._largest_cell(len(controls) - 2), _beside(self._axis), turn_rad)
        # How many cells from a guide path the lattice around it goes.
        return self._explore(controls, axes, np.zeros(2, dtype=np.int64), 9, bound)

    def controls_of(self, path: ArcPath, layers: int) -> Float | None:
        """Return a spline's controls `(L + 2, 3)` near a path; None if that does not always lead ahead."""
        # Distance of the points of a path between which its controls are interpolated.
        points, _ = path.sample(0.05)
        ahead = (points - self._start) @ self._axis
        if (np.diff(ahead) <= 0.0).any():
            return None
        slopes = np.gradient(points, ahead, axis=0)
        slopes[0] = self._tangent / self._cosine
        between = self._distance / layers
        planes = between * np.arange(layers + 1)
        p, t = (np.stack([np.interp(planes, ahead, each) for each in v.T], axis=1) for v in (points, slopes))
        inner = 0.5 * (p[:-1] + p[1:]) + 0.25 * between * (t[:-1] - t[1:])
        inner[0] = self._start + 0.5 * between * t[0]
        return np.concatenate([self._start[None], inner, self._query.target[None]])

    def _largest_cell(self, layers: int) -> float:
        return self._kappa * (self._distance / layers) ** 2

    def _straight(self, layers: int, skew: int) -> tuple[Float, Float, Float]:
        """Return what goes straight on from the start, and a lattice around it that meets the target.

        Steps of half a cell lead aside to the target, `skew` of them along the second axis; where it lies
        straight ahead, any turn will do.
        """
        pace = self._tangent * (self._distance / layers / self._cosine)
        end = self._start + layers * pace
        aside = self._query.target - end
        offset, largest = float(np.linalg.norm(aside)), self._largest_cell(layers)
        if offset < index.MIN_ARC_MM:
            turn = skew * math.pi / (3.0 * SKEWS)
            axes, goal_cells = self._axes(largest, _beside(self._axis), turn), (0, 0)
            end = self._query.target
        else:
            along = 0
            while largest * _norm(along, skew) < 2.0 * offset:
                along += 1
            turn = -math.atan2(math.sqrt(0.75) * skew, along + 0.5 * skew)
            axes, goal_cells = self._axes(2.0 * offset / _norm(along, skew), aside, turn), (along, skew)
        inner = self._start + (np.arange(layers)[:, None] + 0.5) * pace
        return np.concatenate([self._start[None], inner, end[None]]), axes, np.array(goal_cells)

    def _axes(self, cell: float, side: Float, turn_rad: float) -> Float:
        """Return the axes of a hexagonal lattice across the line to the target, from a direction on."""
        side = side / np.linalg.norm(side)
        up = np.cross(self._axis, side)
        angles = turn_rad, turn_rad + math.pi / 3
        return np.array([cell * (math.cos(a) * side + math.sin(a) * up) for a in angles])

    def _explore(self, base: Float, axes: Float, goal_cells: Float, reach: int, bound: float) -> GuidePath:
        self._table.fill(kernel.NONE)
        arrays = (np.zeros(len(base), dtype=np.int64), self._states, self._before, self._costs)
        query = self._query
        arcs, is_whole = kernel.explore(
            self._environment.obstacles, self._environment.limits, self._objective, query.branch, base, axes,
            goal_cells, self._kappa, reach, query.inserted_mm, bound, *arrays, self._table, self._order,
        )  # fmt: skip
        controls, cost = np.zeros_like(base), math.inf
        if is_whole:
            cost = float(kernel.cheapest_guide_path(base, axes, goal_cells, *arrays, controls))
        found = controls if cost < math.inf else None
        return GuidePath(controls=found, cost=cost, arcs=int(arcs), is_whole=bool(is_whole))


def via_points(controls: Float) -> Float:
    """Return the ends of the arcs `(L, 3)` along a guide path: the middles of its pieces, and the target."""
    return np.concatenate([0.5 * (controls[1:-2] + controls[2:-1]), controls[-1:]])


def _norm(a: int, b: int) -> float:
    """Return the length of a vector of a hexagonal lattice, in cells."""
    return math.sqrt(a * a + a * b + b * b)


def _beside(axis: Float) -> Float:
    """Return a direction across another."""
    return np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
