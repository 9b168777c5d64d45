"""Which of many points the needle reaches from many start poses, how well, and an index of such poses."""

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int, UInt8, UInt64
from stages.needle.environment import NeedleEnvironment
from stages.needle.kernels import reach_arcs, reach_search, tree
from stages.needle.kernels import start_trial as kernel
from stages.needle.objective import Objective
from stages.needle.search.base import RANDOM_SHARE

DIRECTION_CELLS = 8
"""Cells along an edge of a cube on whose faces directions are sorted."""


@frozen_record
class Reached:
    """What became of N points.

    Args:
        kinds ((N,) uint8): `DIRECT`: a single arc is proved clear.  `SEARCHED`: a path of several arcs is.
            `UNREACHED`: no single arc is, and the search, if there was one, found nothing.  `NO_CLEARANCE`:
            no needle can end at the point: an obstacle that is no airway is nearer than the axis may be.
        cost ((N,) float64): Estimated integral of 1 / clearance of the path found; 0 where there is none.
        clearance_mm ((N,) float64): Lower bound of its clearance beyond the exempt length; else 0.
        entries ((N,) int64): Its start pose; -1 where there is none.
        window_share ((N,) float64 or None): Share of the breath in which it is proved, if that is asked for.
    """

    kinds: UInt8
    cost: Float
    clearance_mm: Float
    entries: Int
    window_share: Float | None = None


DEFAULT_ARCS = 4
BLOCK_MM = 12.0
"""Side of the cubes whose points share their start poses: larger ones share fewer."""
RRT_ITERATIONS = 200
"""Iterations of a tree: those that succeed do so early, see `RESTART_ITERATIONS`."""
ORDER_SEED = 1


class ReachScan:
    """Many start poses in one needle environment, to be asked about any number of points, by several threads.

    It may be used by several threads at once.  Raises SettingsError if `arcs` is below 1 or `trees` below 0.

    Args:
        positions, tangents ((E, 3) float64, LPS mm): Start poses; neighbours in the list should be alike.
        branches ((E,) int64): Branch whose wall each has pierced; -1 for none.
        arcs: Clear arcs of which the cheapest is improved.
        trees: RRTs for each point that no single arc reaches; 0 for no search at all.
    """

    def __init__(
        self,
        environment: NeedleEnvironment,
        positions: ArrayLike,
        tangents: ArrayLike,
        branches: ArrayLike,
        *,
        arcs: int = DEFAULT_ARCS,
        trees: int = 0,
    ) -> None:
        if arcs < 1 or trees < 0:
            raise SettingsError(
                f"Arcs and trees of a reachability scan are {arcs} and {trees}",
                expected="at least 1 arc and 0 trees",
            )
        self.environment = environment
        self.trees = trees
        self._arcs = arcs
        self._starts = np.ascontiguousarray(np.hstack([np.asarray(positions), np.asarray(tangents)]), float)
        self._starts = self._starts.reshape(-1, 6)
        self._branches = np.array(branches, dtype=np.int64)
        # One order for all points: what is reached does not depend on how the points are shared out.
        self._order = np.random.Generator(np.random.PCG64(ORDER_SEED)).permutation(len(self._branches))
        self._mixed = np.ascontiguousarray(self._starts[self._order].T)
        self._objective = environment.objective_arrays(Objective(length=0.0, inverse_clearance=1.0))

    def reach(self, points: ArrayLike, seeds: UInt64, near: Int | None = None) -> Reached:
        """Try all points `(N, 3)` LPS mm, cube by cube: what neighbours have in common is found once.

        `seeds` `(N,)` are those of the search to each point; `near` `(N, K)` are indices of points near each,
        -1 for none, by default the one before.
        """
        places = np.array(points, dtype=np.float64, order="C").reshape(-1, 3)
        kinds, found = np.zeros(len(places), dtype=np.int64), np.zeros((len(places), 2))
        environment, entries = self.environment, np.full(len(places), -1, dtype=np.int64)
        before = np.arange(len(places))[:, None] - 1 if near is None else near
        reach_arcs.reach_by_arcs(
            environment.obstacles, environment.limits, self._starts, self._branches, self._order, self._mixed,
            places, *_cubes(places), np.array(before, dtype=np.int64, order="C"), self._arcs,
            np.zeros(len(self._starts)), kinds, found, entries,
        )  # fmt: skip
        if self.trees:
            rows = RRT_ITERATIONS * tree.ROWS_PER_STEP
            reach_search.reach_by_search(
                environment.obstacles, environment.limits, self._objective, self._starts, self._branches,
                self._order, places, self.trees, RRT_ITERATIONS, RANDOM_SHARE,
                np.array(seeds, dtype=np.uint64), np.zeros((rows, tree.NODE_COLUMNS)),
                np.zeros(rows, dtype=np.int64), np.zeros(self.trees, dtype=np.int64), kinds, found, entries,
            )  # fmt: skip
        return Reached(
            kinds=kinds.astype(np.uint8),
            cost=found[:, reach_arcs.COST],
            clearance_mm=found[:, reach_arcs.CLEARANCE],
            entries=entries,
        )


def _cubes(points: Float) -> tuple[Int, Int]:
    """Return an order (N,) that puts the points of a cube in a row, and where in it each begins (B + 1,)."""
    if not len(points):
        return np.zeros(0, dtype=np.int64), np.zeros(1, dtype=np.int64)
    cubes = np.floor((points - points.min(axis=0)) / BLOCK_MM + 1e-9).astype(np.int64)
    order = np.lexsort(cubes.T)
    in_order = cubes[order]
    begins = np.flatnonzero((in_order[1:] != in_order[:-1]).any(axis=1)) + 1
    return order, np.concatenate([[0], begins, [len(points)]])


class StartIndex:
    """Start poses, points `(E, 3)` LPS mm and unit tangents, in bundles of like ones, for all needles."""

    def __init__(self, positions: ArrayLike, tangents: ArrayLike) -> None:
        places = np.asarray(positions, dtype=np.float64).reshape(-1, 3)
        directions = np.asarray(tangents, dtype=np.float64).reshape(-1, 3)
        keys = _keys(places, directions)
        order = np.argsort(keys, kind="stable")
        changes = np.flatnonzero(np.diff(keys[order])) + 1
        self._order: Int = order
        self._begins = np.concatenate([[0], changes, [len(keys)]]).astype(np.int64)
        self._positions = np.ascontiguousarray(places[order])
        self._tangents = np.ascontiguousarray(directions[order])
        self._bounds = np.zeros((len(self._begins) - 1 if len(keys) else 0, kernel.N_BOUNDS))
        numbers = np.arange(len(order))
        kernel.bound_bundles(self._positions, self._tangents, numbers, self._begins, self._bounds)

    @property
    def count(self) -> int:
        """Number of poses, E."""
        return len(self._order)

    def holding(self, environment: NeedleEnvironment, target: ArrayLike) -> tuple[Int, Float]:
        """Return the poses with a target `(3,)`, LPS mm, in their workspace, nearest first, and path lengths.

        The same as finite entries of `stages.needle.environment.workspace_lengths`, mm; poses at the same
        length come in their own order.
        """
        found, lengths = np.zeros(self.count, dtype=np.int64), np.zeros(self.count)
        count = kernel.workspace_query(
            self._bounds, self._begins, self._order, self._positions, self._tangents,
            np.asarray(target, dtype=np.float64), environment.limits, found, lengths,
        )  # fmt: skip
        nearest = np.lexsort((found[:count], lengths[:count]))
        return found[:count][nearest], lengths[:count][nearest]


def _keys(positions: Float, directions: Float) -> Int:
    """Return the number of each pose's cell, in place and on the cube of directions."""
    # Poses of one bundle lie in one such cube.
    cell = np.floor((positions - positions.min(axis=0, initial=0.0)) / 5.0).astype(np.int64)
    key = np.zeros(len(cell), dtype=np.int64)
    for axis in range(3):
        key = key * (cell[:, axis].max(initial=0) + 1) + cell[:, axis]
    axis = np.argmax(np.abs(directions), axis=1)
    rows = np.arange(len(axis))
    top = directions[rows, axis]
    key = key * 6 + axis + 3 * (top < 0.0)
    for other in (1, 2):
        share = 0.5 * (directions[rows, (axis + other) % 3] / np.abs(top) + 1.0)
        place = (share * DIRECTION_CELLS).astype(np.int64)
        key = key * DIRECTION_CELLS + np.clip(place, 0, DIRECTION_CELLS - 1)
    return np.asarray(key, dtype=np.int64)
