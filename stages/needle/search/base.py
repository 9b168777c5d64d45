"""Searches for a needle path, each advanced in slices by whoever has the clock."""

import math
from collections.abc import Callable, Iterator
from typing import Protocol

import numpy as np

from anatomy.base.typed import Float
from stages.needle.environment import NeedleEnvironment
from stages.needle.kernels import tree
from stages.needle.kernels.rrt import grow_rrt
from stages.needle.objective import SHORTEST, Objective
from stages.needle.path import ArcPath, Query, path_from_tree

MAX_NODES = 20_000
"""Rows of a tree, 2 MB; a tree that has more begins anew."""
RANDOM_SHARE = 0.5
"""Share of the iterations that extend a random node by a random arc; a free choice."""
RESTART_ITERATIONS = 200
"""Unit of the restart schedule: trees that are lucky are so early."""


class Search(Protocol):
    """What every search can do.

    Attributes:
        path: The best path so far, proved clear and within all limits.
        cost: Its cost under the objective, as estimated within the search.  Without a path it is what a path
            must cost less than: infinite unless the caller sets it before the first `advance`.
        finished: Nothing is left to be found.
    """

    path: ArcPath | None
    cost: float
    finished: bool

    def advance(self, iterations: int) -> bool:
        """Spend up to `iterations`; return whether a better path was found, with which the slice ends."""


def root_of(query: Query) -> Float:
    """Return the root `(NODE_COLUMNS,)` of a tree of arcs, see `stages.needle.kernels.tree`."""
    root = np.zeros(tree.NODE_COLUMNS)
    root[:3], root[3:6] = query.lps_from_start[:3, 3], query.lps_from_start[:3, 2]
    root[tree.PATH_LENGTH], root[tree.PATH_TURN] = query.inserted_mm, query.turned_rad
    if query.reference is not None:
        root[tree.BEND + 1 : tree.BEND + 4] = query.reference
    return root


def in_slices(
    search: Search, iterations: int, ended: Callable[[], bool] = lambda: False
) -> Iterator[tuple[int, ArcPath | None]]:
    """Advance a search; yield after each slice the iterations spent, and the path if it is a better one.

    At most `iterations` are spent, but one slice is begun in any case; before each, `ended` is asked whether
    that is enough.
    """
    used = 0
    while not (ended() or search.finished):
        # Iterations of a slice, a few milliseconds.
        portion = min(200, iterations - used)
        used += portion
        yield used, search.path if search.advance(portion) else None
        if used >= iterations:
            return


def first_path(search: Search, iterations: int, cost_limit: float = math.inf) -> ArcPath | None:
    """Return the first path that costs less than a limit, None if so many iterations find none."""
    search.cost = cost_limit
    return next((path for _used, path in in_slices(search, iterations) if path is not None), None)


class RestartingRRT:
    """The RRT of [Kuntz2015], begun anew as [Luby1993] and at each path, then for cheaper ones only."""

    def __init__(
        self, environment: NeedleEnvironment, query: Query, seed: int = 1, objective: Objective = SHORTEST
    ) -> None:
        self.environment, self.query = environment, query
        self.path: ArcPath | None = None
        self.cost = math.inf
        self.finished = False
        self.iterations = 0
        """Iterations spent so far."""
        self.objective = environment.objective_arrays(objective)
        self.state = np.array([seed], dtype=np.uint64)
        self.nodes, self.parents = np.zeros((MAX_NODES, tree.NODE_COLUMNS)), np.zeros(MAX_NODES, np.int64)
        self.nodes[0] = root_of(query)
        self.count = 1
        # What the kernels of all searches begin with.
        self._asked = environment.obstacles, environment.limits, self.objective, query.branch, query.goal
        self._restarts, self._left = 0, RESTART_ITERATIONS

    def take(self, last: int) -> None:
        """Keep the path from the root to the row `last` as the best."""
        self.path = path_from_tree(self.query.lps_from_start, self.nodes, self.parents, last)
        self.cost = float(self.nodes[last, tree.PATH_COST])

    def advance(self, iterations: int) -> bool:
        """Grow trees; see `Search`.  The tree that found a path is kept until the next call."""
        left = iterations
        while True:
            if self._left == 0 or self.count + tree.ROWS_PER_STEP > MAX_NODES:
                self._restarts += 1
                self._left = RESTART_ITERATIONS * luby(self._restarts + 1)
                self.count = 1
            self.count, used, solved = self.grow(min(left, self._left))
            left -= used
            self._left -= used
            self.iterations += used
            if solved:
                self.take(self.count - 1)
                self._left = 0
            if solved or left == 0 or used == 0:
                return bool(solved)

    def grow(self, iterations: int) -> tuple[int, int, bool]:
        """Grow the tree; return its rows, the iterations spent, and whether the last row is at the goal."""
        tree_of = self.nodes, self.parents, self.count
        return grow_rrt(  # type: ignore[no-any-return]
            *self._asked, *tree_of, iterations, RANDOM_SHARE, self.state, self.cost
        )


def luby(number: int) -> int:
    """Return an element of the sequence 1, 1, 2, 1, 1, 2, 4, ... of [Luby1993], counted from 1."""
    while number & (number + 1):
        number -= (1 << (number.bit_length() - 1)) - 1
    return (number + 1) // 2
