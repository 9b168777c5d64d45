"""State lattices between a start pose and a target: the cheapest guide path anywhere, or around another."""

from __future__ import annotations

import math

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from stages.needle.environment import NeedleEnvironment, workspace_lengths
from stages.needle.kernels import limits as index
from stages.needle.objective import Objective
from stages.needle.path import ArcPath
from stages.needle.query import Query
from stages.needle.search.kernels import state_lattice as kernel

MOST_STATES = 1 << 15
"""States of a lattice, in 2 MB; so many are searched in 0.1 s."""
CURVATURE_SHARE = 0.97
"""Share of the greatest curvature that guide paths take; arcs laid along them bend a little more."""
LEAST_COSINE = 0.3
"""Least cosine of the angle between a start and the line to the target.  From steeper starts, paths may turn
back across the layers."""
SKEWS = 6
"""Number of turns of a lattice about the line to the target."""
REACH_CELLS = 9
"""How many cells from a guide path the lattice around it goes."""
ANYWHERE_CELLS = 1 << 14
"""More cells than any lattice over all of the space has."""
SAMPLE_MM = 0.05
"""Distance of the points of a path between which its controls are interpolated."""


@frozen_record
class GuidePath:
    """The cheapest path through a state lattice of L layers, if there is one.

    Parameters
    ----------
    controls : (L + 2, 3) float64, LPS mm
        Start, control points of a quadratic spline, and target; None if there is no path.
    cost : float
        Cost of the arcs along it, infinite without a path.
    arcs : int
        Arcs that were tried, a measure of the work.
    is_whole : bool
        False if the lattice had too many states: then there is no path.
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
        self.is_possible = bool(
            self._distance > index.MIN_ARC_MM and self._cosine > LEAST_COSINE and np.isfinite(length)
        )
        """Whether there may be guide paths: the target is in the workspace, and the start not too steep."""
        self._states = np.zeros((MOST_STATES, kernel.STATE_COLUMNS), dtype=np.int64)
        self._before = np.zeros(MOST_STATES, dtype=np.int32)
        self._costs = np.zeros(MOST_STATES)
        self._order = np.zeros(MOST_STATES, dtype=np.int32)
        self._table = np.zeros(2 * MOST_STATES, dtype=np.int32)

    def everywhere(self, layers: int, *, skew: int = 0) -> GuidePath:
        """Return the cheapest guide path anywhere.

        Parameters
        ----------
        layers : int
            More are finer, and take time by about the 7th power.
        skew : int
            Turns the lattice, less than SKEWS.
        """
        base, axes, goal_cells = self._straight(layers, skew)
        return self._explore(base, axes, goal_cells, ANYWHERE_CELLS, math.inf)

    def around(self, controls: Float, cells: float, turn_rad: float, bound: float = math.inf) -> GuidePath:
        """Return the cheapest guide path near another one, if it costs less than `bound`.

        Parameters
        ----------
        controls : (L + 2, 3) float64, LPS mm
            As those of `GuidePath`.
        cells : float
            Size of a cell, as a share of what the greatest curvature allows.
        turn_rad : float
            Of the lattice about the line to the target.
        """
        axes = self._axes(cells * self._largest_cell(len(controls) - 2), _beside(self._axis), turn_rad)
        return self._explore(controls, axes, np.zeros(2, dtype=np.int64), REACH_CELLS, bound)

    def controls_of(self, path: ArcPath, layers: int) -> Float | None:
        """Return controls `(L + 2, 3)` of a spline near a path; None if that does not always lead ahead.

        A control point is where the tangents at the two planes beside it meet.
        """
        points, _ = path.sample(SAMPLE_MM)
        ahead = (points - self._start) @ self._axis
        if (np.diff(ahead) <= 0.0).any():
            return None
        slopes = np.gradient(points, ahead, axis=0)
        slopes[0] = self._tangent / self._cosine
        between = self._distance / layers
        planes = between * np.arange(layers + 1)
        p, t = (
            np.stack([np.interp(planes, ahead, column) for column in values.T], axis=1)
            for values in (points, slopes)
        )
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
        return np.array(
            [cell * (math.cos(a) * side + math.sin(a) * up) for a in (turn_rad, turn_rad + math.pi / 3)]
        )

    def _explore(self, base: Float, axes: Float, goal_cells: Float, reach: int, bound: float) -> GuidePath:
        self._table.fill(kernel.NONE)
        begins = np.zeros(len(base), dtype=np.int64)
        arrays = (begins, self._states, self._before, self._costs)
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
