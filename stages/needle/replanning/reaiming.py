"""Paths from the tip of a needle to its target: along what is left of a plan, directly, or by a search."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import field, replace
from enum import StrEnum

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.kernels.arcs import arc_to_point, pose_on_arc
from stages.needle.environment import NeedleEnvironment
from stages.needle.kernels import proof as index
from stages.needle.kernels import tree
from stages.needle.kernels.cost import ObjectiveArrays
from stages.needle.objective import Objective
from stages.needle.path import LENGTH, ArcPath, Query, arc_transform, as_point, path_from_tree
from stages.needle.search.base import RestartingRRT, root_of

LEAST_GAIN = 0.1
"""A path is given up for another one only if that is cheaper by this share: a needle that changes its mind
at every measurement wears out the tissue."""

Ahead = tuple[float, Float]
"""How far ahead on the plan a point lies (mm), and the point."""

Bend = tuple[float, ...]


class Source(StrEnum):
    """What a path was made of."""

    REST = "rest of the plan"
    DIRECT = "direct arc"
    REJOIN = "back to the plan"
    LEGS = "arc and straight"
    SEARCH = "search"
    NEAREST = "nearest approach"
    ARRIVED = "arrived"


Waypoints = tuple[list[Float], Source]
"""Points to pass, and where they come from."""


@frozen_record
class Root:
    """A pose to plan from, and the arcs `(A, 3)` that led to it from the tip, see `ArcPath`."""

    query: Query
    arcs: Float = field(default_factory=lambda: np.zeros((0, 3)))
    cost: float = 0.0

    @property
    def away_mm(self) -> float:
        """Length of the arcs."""
        return float(self.arcs[:, LENGTH].sum())


def root_after(query: Query, path: ArcPath, cost: float) -> Root:
    """Return the end of a path from a query's start as a root."""
    end = replace(
        query,
        lps_from_start=path.frames()[-1],
        inserted_mm=query.inserted_mm + path.length_mm,
        turned_rad=query.turned_rad + path.accumulated_turn_rad,
    )
    return Root(query=end, arcs=path.arcs, cost=cost)


def plan_ahead(plan: ArcPath, begin_mm: float) -> tuple[float, list[Ahead], list[Ahead]]:
    """Return what a plan says from the length `begin_mm` on.

    Returned are the turn of the part behind, rad; and, as pairs of length and point `(3,)`, the ends of arcs
    beyond it but for the last, where the target was, and the points at the look-aheads.
    """
    turned, at = 0.0, 0.0
    corners, meetings = [], []
    for frame, (length, roll, curvature) in zip(plan.frames(), plan.arcs, strict=False):
        turned += curvature * min(max(begin_mm - at, 0.0), length)
        # How far ahead the plan that is being followed is met again.
        for away in (5.0, 10.0, 20.0, 40.0):
            if at < begin_mm + away < at + length:
                meetings.append((away, (frame @ arc_transform(begin_mm + away - at, roll, curvature))[:3, 3]))
        at += length
        if at > begin_mm + index.MIN_ARC_MM:
            corners.append((at - begin_mm, (frame @ arc_transform(length, roll, curvature))[:3, 3]))
    return turned, corners[:-1], meetings


def waypoints_ahead(corners: list[Ahead], meetings: list[Ahead]) -> Iterator[Waypoints]:
    """Yield what to pass on the way to the target, the rest of the plan first."""
    if corners:
        yield [point for _away, point in corners], Source.REST
    yield [], Source.DIRECT
    for meeting, point in meetings:
        yield [point, *(corner for away, corner in corners if away > meeting)], Source.REJOIN
    for first in range(1, len(corners)):
        yield [point for _away, point in corners[first:]], Source.REST


class Attempts:
    """Paths that were tried from one root, of at most `most_points` points to pass; the cheapest is kept.

    `path` is proved clear and within all limits; `cost` is its cost, as estimated within the searches,
    infinite without one.
    """

    def __init__(
        self, environment: NeedleEnvironment, objective: ObjectiveArrays, root: Root, most_points: int = 0
    ) -> None:
        rows = 2 * most_points + 3
        self._environment = environment
        self._nodes, self._parents = np.zeros((rows, tree.NODE_COLUMNS)), np.zeros(rows, np.int64)
        self._nodes[0] = root_of(root.query)
        # What the kernels of the tree begin with.
        branch, nodes, parents = root.query.branch, self._nodes, self._parents
        self._tree = environment.obstacles, environment.limits, objective, branch, nodes, parents
        self._state = np.array([1], dtype=np.uint64)
        self.root = root
        self.path: ArcPath | None = None
        self.cost = math.inf
        self.source = Source.REST

    @property
    def total(self) -> float:
        """Cost from the tip."""
        return self.root.cost + self.cost

    @property
    def wanted(self) -> float:
        """What another path must cost less than."""
        return self.cost * (1.0 - LEAST_GAIN)

    def through(self, points: Sequence[Float], source: Source) -> None:
        """Try single arcs from point to point, and arc and straight where one arc bends too much."""
        count = 1
        for point in points:
            count = self._towards(count, as_point(point))
            if count == 0:
                return
        goal = self.root.query.goal
        rows = tree.add_goal(*self._tree, count, count - 1, goal, self.wanted, self._state)
        self._keep(count, rows, source)

    def by_legs(self) -> None:
        """Try the shortest path in free space."""
        self._keep(1, self._legs(1, self.root.query.goal), Source.LEGS)

    def by_arc(self, bend: Bend, length: float, source: Source) -> None:
        """Try one arc whose own end counts as the goal."""
        end = pose_on_arc(tree.pose_of(self._nodes[0]), bend, length)[:3]
        self._keep(1, 1 + self._arc(1, bend, length, end), source)

    def search(self, iterations: int, seed: int, objective: Objective) -> int:
        """Let the RRT look for cheaper paths; return the iterations spent."""
        rrt = RestartingRRT(self._environment, self.root.query, seed=seed, objective=objective)
        rrt.cost = self.wanted
        spent = 0
        while spent < iterations:
            before = rrt.iterations
            better = rrt.advance(iterations - spent)
            # A path that took no iteration counts as one: this must end.
            spent += max(rrt.iterations - before, 1)
            if better:
                self.path, self.cost, self.source = rrt.path, rrt.cost, Source.SEARCH
            elif rrt.iterations == before:
                break
        return spent

    def _towards(self, count: int, point: tuple[float, float, float]) -> int:
        """Go on from the last row to a point; return the new count, 0 if there is no path."""
        length, bend, _turn = arc_to_point(tree.pose_of(self._nodes[count - 1]), point)
        if length < index.MIN_ARC_MM:
            return count
        if bend[0] <= self._environment.limits.kappa and self._arc(count, bend, length, self.root.query.goal):
            return count + 1
        rows = self._legs(count, point)
        return rows if rows > count else 0

    def _arc(self, count: int, bend: Bend, length: float, goal: tuple[float, float, float]) -> bool:
        return bool(tree.add_arc(*self._tree, count, count - 1, bend, float(length), goal, self.wanted))

    def _legs(self, count: int, point: tuple[float, float, float]) -> int:
        return int(tree.add_legs(*self._tree, count, count - 1, point, self.root.query.goal, self.wanted))

    def _keep(self, count: int, rows: int, source: Source) -> None:
        if rows > count and self._nodes[rows - 1, tree.PATH_COST] < self.wanted:
            self.path = path_from_tree(self.root.query.lps_from_start, self._nodes, self._parents, rows - 1)
            self.cost = float(self._nodes[rows - 1, tree.PATH_COST])
            self.source = source
