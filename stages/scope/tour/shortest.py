"""The shortest tour over all choices of exits: a group Steiner problem on a tree, solved exactly."""

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float, Int
from stages.scope.tour.itinerary import Itinerary, plan_itinerary
from stages.scope.tour.kernels.steiner import solve
from stages.scope.tour.subtree import Subtree

MOST_WORK = 3e7
"""Divisions of sets up to which the dynamic program is used: about a tenth of a second."""


def shortest_tour(subtree: Subtree, *, closed: bool = False) -> Itinerary:
    """Return the tour of least cost over all choices of one exit a lesion.

    A closed tour costs twice the length of the stretches that it uses; an open one may end at any exit and
    saves the return from there.  The costs of the chosen exits are added.

    The dynamic program is exact.  Its work grows with the number of lesions that have exits on both sides
    of a fork; where that is large, an integer program takes its place, which is exact too.

    Args:
        closed: Whether the tour returns to the root.
    """
    nodes = _binary(subtree)
    taken = _by_program(nodes, closed) if nodes.work <= MOST_WORK else _by_integers(subtree, closed)
    depth, lesion = subtree.depth_mm[subtree.exit_vertex], subtree.exit_lesion
    # Of two exits of a lesion that both lie on the tour at no cost, the deeper one may be its end.
    chosen = [
        max(np.flatnonzero(taken & (lesion == m)).tolist(), key=lambda x: float(depth[x]))
        for m in range(subtree.n_lesions)
    ]
    return plan_itinerary(subtree, chosen, closed=closed)


@frozen_record
class _Nodes:
    """The binary tree of the dynamic program, see `kernels.steiner`; T nodes."""

    left: Int
    right: Int
    lift: Float
    cost: Float
    below: Int
    open_sets: Int
    exit_of: Int
    work: float


def _binary(subtree: Subtree) -> _Nodes:
    """Make exits the leaves, and merge what meets at a vertex two by two."""
    left: list[int] = []
    right: list[int] = []
    lift: list[float] = []
    exit_of: list[int] = []

    def add(a: int, b: int, x: int) -> int:
        left.append(a)
        right.append(b)
        lift.append(0.0)
        exit_of.append(x)
        return len(left) - 1

    at: list[list[int]] = [[] for _ in range(subtree.n_vertices)]
    for x, v in enumerate(subtree.exit_vertex.tolist()):
        at[v].append(x)
    top: list[list[int]] = [[] for _ in range(subtree.n_vertices)]
    for v in range(subtree.n_vertices - 1, -1, -1):
        meeting = [add(-1, -1, x) for x in at[v]] + top[v]
        if not meeting:
            continue
        node = meeting[0]
        for other in meeting[1:]:
            node = add(node, other, -1)
        if v > 0:
            lift[node] += float(subtree.length_mm[v])
            top[int(subtree.parent[v])].append(node)
    return _with_sets(subtree, left, right, lift, exit_of)


def _with_sets(
    subtree: Subtree, left: list[int], right: list[int], lift: list[float], exit_of: list[int]
) -> _Nodes:
    """Add which lesions lie below each node, which of them are open, and how much work the program is."""
    lesion = subtree.exit_lesion.tolist()
    total = np.bincount(subtree.exit_lesion).tolist()
    below, open_sets, work = [0] * len(left), [0] * len(left), 0.0
    inside: list[dict[int, int]] = [{} for _ in left]
    for t in range(len(left)):
        if left[t] < 0:
            inside[t] = {lesion[exit_of[t]]: 1}
        else:
            a, b = left[t], right[t]
            inside[t] = dict(inside[a])
            for m, count in inside[b].items():
                inside[t][m] = inside[t].get(m, 0) + count
            shared = (open_sets[a] & open_sets[b]).bit_count()
            alone = (open_sets[a] ^ open_sets[b]).bit_count()
            work += 2.0**alone * 3.0**shared
        below[t] = sum(1 << m for m in inside[t])
        open_sets[t] = sum(1 << m for m, count in inside[t].items() if count < total[m])
    exits = np.array(exit_of, dtype=np.int64)
    leaf = exits >= 0
    return _Nodes(
        left=np.array(left, dtype=np.int64),
        right=np.array(right, dtype=np.int64),
        lift=np.array(lift),
        cost=np.where(leaf, subtree.exit_cost_mm[exits], 0.0),
        below=np.array(below, dtype=np.int64),
        open_sets=np.array(open_sets, dtype=np.int64),
        exit_of=exits,
        work=work,
    )


def _by_program(nodes: _Nodes, closed: bool) -> Bool:
    """Return which exits are taken, `(X,)`."""
    sizes = [1 << int(s).bit_count() for s in nodes.open_sets]
    offset = np.concatenate(((0,), np.cumsum(sizes)))
    chosen = np.zeros(len(nodes.left), dtype=np.bool_)
    solve(
        nodes.left,
        nodes.right,
        nodes.lift,
        nodes.cost,
        nodes.below,
        nodes.open_sets,
        offset,
        closed,
        np.zeros((2, int(offset[-1]))),
        np.zeros((2, int(offset[-1])), dtype=np.int64),
        chosen,
    )
    leaf = nodes.exit_of >= 0
    taken = np.zeros(int(leaf.sum()), dtype=np.bool_)
    taken[nodes.exit_of[leaf]] = chosen[leaf]
    return taken


def _by_integers(subtree: Subtree, closed: bool) -> Bool:
    """Return which exits are taken, by an integer program.

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
    return np.asarray(found.x[2 * n :] > 0.5)
