"""An asymptotically optimal search: trees in state and cost, and refinement of the best path."""

import numpy as np

from anatomy.base.typed import Float
from stages.needle.environment import NeedleEnvironment
from stages.needle.kernels import proof as index
from stages.needle.kernels import tree
from stages.needle.objective import SHORTEST, Objective
from stages.needle.path import ArcPath, Query, path_from_tree
from stages.needle.search.base import RestartingRRT
from stages.needle.search.kernels import optimal

MAX_VIAS = 64
"""A path of more arcs is not varied: none that is worth it has so many."""
IMPROVEMENT = 1e-6
"""A path counts as better if its cost is less by this share."""


class OptimalSearch(RestartingRRT):
    """Finds a path as the RRT does and makes it cheaper and cheaper.

    Two things take turns.  Trees grow in the space of states and costs, towards samples from the nodes that
    reach them cheapest or at a drawn cost [HauserZhou2016]; every tree is one of many, and every sequence of
    arcs has a chance in each, so the best path is found in the limit.  And the best path is varied: its via
    points are moved, dropped and added, and the path laid anew through them, each leg by the single arc or by
    the shortest path of greatest curvature.
    """

    def __init__(
        self, environment: NeedleEnvironment, query: Query, seed: int = 1, objective: Objective = SHORTEST
    ) -> None:
        super().__init__(environment, query, seed, objective)
        self._vias = np.zeros((MAX_VIAS, optimal.VIA_COLUMNS))
        self._via_count = 0
        self._scratch = np.zeros((2 * MAX_VIAS + 2, tree.NODE_COLUMNS))
        self._scratch[0] = self.nodes[0]
        self._scratch_parents = np.zeros(2 * MAX_VIAS + 2, dtype=np.int64)

    def advance(self, iterations: int) -> bool:
        """Find a path as the RRT does; then grow trees, and refine.  See `search.base.Search`."""
        if self.path is None:
            found = super().advance(iterations)
        else:
            # Share of the iterations, once there is a path, that vary it instead of growing trees.
            tries = round(0.7 * iterations)
            better = self._refine(tries)
            found = super().advance(iterations - tries)
            if not found:
                return better
        if found:
            self._read_vias(self.count - 1)
        return found

    def adopt(self, path: ArcPath, cost: float) -> None:
        """Go on from a path that another search found for the same query and objective."""
        self.path, self.cost = path, cost
        self._take_vias(path.frames()[1:, :3, 3])

    def follow(self, points: Float) -> bool:
        """Go on from a path through via points if there is one that is cheaper; return whether there is.

        `points` `(V, 3)` LPS mm are the ends of its arcs; the last lies within the goal tolerance, or nothing
        is followed.
        """
        missing = float(np.linalg.norm(points[-1] - self.query.target))
        if len(points) > MAX_VIAS or missing > self.environment.limits.goal_tolerance_mm + index.TINY:
            return False
        vias = np.zeros_like(self._vias)
        vias[: len(points), :3] = points
        last = self._build(vias, len(points), self.cost)
        if last == 0 or not self._scratch[last, tree.PATH_COST] < self.cost * (1.0 - IMPROVEMENT):
            return False
        self._keep(last)
        self._take_vias(points)
        return True

    def grow(self, iterations: int) -> tuple[int, int, bool]:
        """Grow by the RRT up to the first path, then in state and cost."""
        if self.path is None:
            return super().grow(iterations)
        return optimal.grow_optimal(  # type: ignore[no-any-return]
            *self._asked, self.nodes, self.parents, self.count, iterations, self.state, self.cost
        )

    def _read_vias(self, last: int) -> None:
        """Take the ends of a path's arcs as its via points."""
        rows = []
        while last != 0:
            rows.append(last)
            last = int(self.parents[last])
        self._take_vias(self.nodes[rows[::-1], :3])

    def _take_vias(self, points: Float) -> None:
        """Take the ends of arcs as via points; too many are not varied."""
        self._via_count = len(points)
        if len(points) <= MAX_VIAS:
            self._vias[: len(points), :3] = points
            self._vias[: len(points), 3] = optimal.ARC

    def _refine(self, tries: int) -> bool:
        if not 0 < self._via_count <= MAX_VIAS:
            return False
        count, scratch = self._via_count, (self._scratch, self._scratch_parents)
        self._via_count, cost, improved = optimal.refine(
            *self._asked, *scratch, self._vias, count, tries, self.state, self.cost
        )
        self.iterations += tries
        if not improved:
            return False
        before = self.cost
        self._keep(self._build(self._vias, self._via_count, np.inf))
        return bool(cost < before * (1.0 - IMPROVEMENT))

    def _build(self, vias: Float, count: int, best: float) -> int:
        """Lay the path through via points into the scratch rows; return the last one, 0 if there is none."""
        return int(optimal.build(*self._asked, self._scratch, self._scratch_parents, vias, count, best))

    def _keep(self, last: int) -> None:
        """Keep the path in the scratch rows as the best."""
        self.path = path_from_tree(self.query.lps_from_start, self._scratch, self._scratch_parents, last)
        self.cost = float(self._scratch[last, tree.PATH_COST])
