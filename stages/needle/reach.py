"""Which of many points the needle reaches from many start poses, and how well."""

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int, UInt8, UInt64
from stages.needle.environment import NeedleEnvironment
from stages.needle.kernels import reach_arcs, reach_search, tree
from stages.needle.objective import Objective
from stages.needle.search.base import RANDOM_SHARE

DIRECT, SEARCHED, UNREACHED, NO_CLEARANCE = (
    reach_arcs.DIRECT,
    reach_arcs.SEARCHED,
    reach_arcs.UNREACHED,
    reach_arcs.NO_CLEARANCE,
)


@frozen_record
class Reached:
    """What became of N points.

    Parameters
    ----------
    kinds : (N,) uint8
        `DIRECT`: a single arc is proved clear.  `SEARCHED`: a path of several arcs is.  `UNREACHED`: no
        single arc is, and the search, if there was one, found nothing.  `NO_CLEARANCE`: no needle can end at
        the point, because an obstacle that is no airway is nearer than the axis may be.
    cost : (N,) float64
        Estimated integral of 1 / clearance of the path found; 0 where there is none.
    clearance_mm : (N,) float64
        Lower bound of its clearance beyond the exempt length; 0 where there is none.
    entries : (N,) int64
        Its start pose; -1 where there is none.
    window_share : (N,) float64 or None
        Share of the breath in which it is proved, where phases of the breath are asked for.
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
    """Many start poses in one needle environment, to be asked about any number of points.

    It may be used by several threads at once.

    Parameters
    ----------
    positions, tangents : (E, 3) float64, LPS mm
        Start poses; neighbours in the list should be alike.
    branches : (E,) int64
        Branch whose wall each has pierced; -1 for none.
    arcs : int
        Clear arcs of which the cheapest is improved.
    trees : int
        RRTs for each point that no single arc reaches; 0 for no search at all.

    Raises
    ------
    SettingsError
        If `arcs` is below 1 or `trees` below 0.
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
        """Try all points, cube by cube of `BLOCK_MM`: what neighbours have in common is found once.

        Parameters
        ----------
        points : (N, 3) float64, LPS mm
        seeds : (N,) uint64
            Seed of the search to each point.
        near : (N, K) int64, optional
            Indices of points near each, -1 for none; by default the one before.
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
