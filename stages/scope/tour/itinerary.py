"""The shortest tour: which exits it takes, the order of visits, and how often each stretch is passed."""

from collections.abc import Sequence

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Int
from anatomy.grid import read_only
from stages.scope.tour.subtree import Exit, Subtree


@frozen_record
class Itinerary:
    """A tour through the airway that takes every lesion at one exit; K stretches of its `Subtree`.

    Args:
        chosen: The exit of each lesion, an index into `subtree.exits`.
        order: Lesions in the order of visits.
        closed: Whether the tour returns to the root.
        passes ((K,) int64): How often the stretch to each vertex is passed, either way: at most twice.
        loops ((K,) int64): How many lesions lie beyond each stretch: what the paper's Table I counts.
        length_mm: Length of the tour.
        cost_mm: Length of the tour and the costs of its exits.
    """

    subtree: Subtree
    chosen: tuple[int, ...]
    order: tuple[int, ...]
    closed: bool
    passes: Int
    loops: Int
    length_mm: float
    cost_mm: float

    @property
    def visits(self) -> tuple[Exit, ...]:
        """The exits in the order of visits."""
        return tuple(self.subtree.exits[self.chosen[lesion]] for lesion in self.order)

    def vertices(self) -> list[int]:
        """Return the vertices in the order in which the tour comes to them, from the root on."""
        parent, walk = self.subtree.parent, [0]
        for lesion in self.order:
            walk += _between(parent, walk[-1], int(self.subtree.exit_vertex[self.chosen[lesion]]))
        return walk + _between(parent, walk[-1], 0) if self.closed else walk

    def seconds(self, speed_mm_per_s: float, per_lesion_s: float) -> float:
        """Return how long the tour takes at a constant speed, with a time for each lesion."""
        return self.length_mm / speed_mm_per_s + per_lesion_s * len(self.order)


def plan_itinerary(subtree: Subtree, chosen: Sequence[int], *, closed: bool = False) -> Itinerary:
    """Return the shortest tour over chosen exits, one index for each lesion; a closed one comes back.

    It passes each stretch twice, an open one only once where it leads to the last exit, which is the deepest.
    Of the branches at a fork, the one with the last exit comes last, the others in the order of their
    lesions.  Raises SettingsError if an exit belongs to another lesion.
    """
    if [subtree.exits[x].lesion for x in chosen] != list(range(subtree.n_lesions)):
        raise SettingsError("The chosen exits do not belong to the lesions", expected="one exit for each")
    vertex = subtree.exit_vertex[list(chosen)]
    loops = np.zeros(subtree.n_vertices, dtype=np.int64)
    for v in vertex.tolist():
        loops[_to_root(subtree.parent, v)] += 1
    passes = np.where(loops > 0, 2, 0)
    passes[0] = 0
    last = int(np.argmax(subtree.depth_mm[vertex]))
    on_last = np.zeros(subtree.n_vertices, dtype=bool)
    on_last[_to_root(subtree.parent, int(vertex[last]))] = True
    if not closed:
        passes[on_last & (passes > 0)] = 1
    length = float((passes * subtree.length_mm).sum())
    return Itinerary(
        subtree=subtree,
        chosen=tuple(int(x) for x in chosen),
        order=_order(subtree, vertex, last, on_last),
        closed=closed,
        passes=read_only(passes),
        loops=read_only(loops),
        length_mm=length,
        cost_mm=length + float(subtree.exit_cost_mm[list(chosen)].sum()),
    )


def one_by_one_mm(subtree: Subtree, chosen: Sequence[int], *, closed: bool = False) -> float:
    """Return the length of a tour that returns to the root between lesions, if closed after the last too."""
    depth = subtree.depth_mm[subtree.exit_vertex[list(chosen)]]
    return float(2.0 * depth.sum() - (0.0 if closed else depth.max()))


def _order(subtree: Subtree, vertex: Int, last: int, on_last: Bool) -> tuple[int, ...]:
    """Walk depth first and list the lesions as they are met; the last one last, also at its own vertex."""
    # The first of the lesions beyond each vertex.
    first = np.full(subtree.n_vertices, len(vertex), dtype=np.int64)
    for lesion in range(len(vertex) - 1, -1, -1):
        first[_to_root(subtree.parent, int(vertex[lesion]))] = lesion
    order: list[int] = []
    stack = [0]
    while stack:
        v = stack.pop()
        order += sorted(np.flatnonzero(vertex == v).tolist(), key=lambda lesion: lesion == last)
        below = [int(c) for c in np.flatnonzero(subtree.parent == v) if first[c] < len(vertex)]
        stack += sorted(below, key=lambda c: (not on_last[c], -first[c]))
    return tuple(order)


def _between(parent: Int, a: int, b: int) -> list[int]:
    """Return the vertices on the path from `a` to `b`, without `a`."""
    up_a, up_b = _to_root(parent, a), _to_root(parent, b)
    shared = len(set(up_a) & set(up_b))
    return up_a[1 : len(up_a) - shared + 1] + up_b[: len(up_b) - shared][::-1]


def _to_root(parent: Int, v: int) -> list[int]:
    path = [v]
    while parent[path[-1]] >= 0:
        path.append(int(parent[path[-1]]))
    return path


def shortest_tour(subtree: Subtree, *, closed: bool = False) -> Itinerary:
    """Return the tour of least cost over all choices of one exit a lesion: a group Steiner problem on a tree.

    A closed tour costs twice the length of the stretches that it uses; an open one may end at any exit and
    saves the return from there.  The costs of the chosen exits are added.
    """
    taken, passed = _exits_taken(subtree, closed)
    depth, cost = subtree.depth_mm[subtree.exit_vertex], subtree.exit_cost_mm
    chosen = []
    for m in range(subtree.n_lesions):
        own = subtree.exit_lesion == m
        # Of exits of a lesion that lie on the tour at the same cost it is the deepest, which may be its end.
        same = passed & own & (cost == cost[taken & own].min())
        chosen.append(max(np.flatnonzero(same).tolist(), key=lambda x: float(depth[x])))
    return plan_itinerary(subtree, chosen, closed=closed)


def _exits_taken(subtree: Subtree, closed: bool) -> tuple[Bool, Bool]:
    """Return which exits `(X,)` are taken, and which lie on the tour, by an integer program, which is exact.

    x says which stretches are used, z which of them lead to the end of an open tour, y which exits are
    taken.  A stretch needs its parent, an exit its stretch, a lesion one exit.
    """
    from scipy.optimize import Bounds, LinearConstraint, milp
    from scipy.sparse import coo_array

    n, count = subtree.n_vertices, len(subtree.exits)
    rows: list[tuple[int, int, float]] = []
    low: list[float] = []

    def require(entries: list[tuple[int, float]], least: float) -> None:
        rows.extend((len(low), column, factor) for column, factor in entries)
        low.append(least)

    for v in range(1, n):
        if subtree.parent[v] > 0:
            require([(int(subtree.parent[v]), 1.0), (v, -1.0)], 0.0)
        require([(v, 1.0), (n + v, -1.0)], 0.0)
    for v in range(n):
        onward = [(n + int(c), -1.0) for c in np.flatnonzero(subtree.parent == v)]
        if onward:
            require([(n + v, 1.0), *onward], 0.0)
    for x, v in enumerate(subtree.exit_vertex.tolist()):
        require([(v, 1.0), (2 * n + x, -1.0)], 0.0)
    for m in range(subtree.n_lesions):
        require([(2 * n + int(x), 1.0) for x in np.flatnonzero(subtree.exit_lesion == m)], 1.0)
    row, column, factor = zip(*rows, strict=True)
    matrix = coo_array((factor, (row, column)), shape=(len(low), 2 * n + count))
    saved = np.zeros(n) if closed else -subtree.length_mm
    found = milp(
        np.concatenate((2.0 * subtree.length_mm, saved, subtree.exit_cost_mm)),
        constraints=LinearConstraint(matrix.tocsr(), lb=np.array(low)),
        bounds=Bounds(0, 1),
        integrality=np.ones(2 * n + count),
        options={"mip_rel_gap": 0.0},
    )
    return found.x[2 * n :] > 0.5, found.x[subtree.exit_vertex] > 0.5
