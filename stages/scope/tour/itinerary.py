"""The order of visits for chosen exits, and how often each stretch is passed."""

from collections.abc import Sequence

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Int
from anatomy.grid import read_only
from stages.scope.tour.exits import Exit
from stages.scope.tour.subtree import Subtree


@frozen_record
class Itinerary:
    """A tour through the airway that takes every lesion at one exit; K stretches of its `Subtree`.

    Args:
        chosen: The exit of each lesion, an index into `subtree.exits`.
        order: Lesions in the order of visits.
        closed: Whether the tour returns to the root.
        passes ((K,) int64): How often the stretch to each vertex is passed, in either direction: at most
            twice.
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
    """Return the shortest tour over chosen exits.

    It passes each stretch twice, an open one only once where it leads to the last exit, which is the
    deepest.  Of the branches at a fork, the one with the last exit comes last, the others in the order of
    their lesions.

    Args:
        chosen: For each lesion, the index of one of its exits.
        closed: Whether to return to the root.

    Raises:
        SettingsError: If an exit belongs to another lesion.
    """
    if [subtree.exits[x].lesion for x in chosen] != list(range(subtree.n_lesions)):
        raise SettingsError("The chosen exits do not belong to the lesions", expected="one exit for each")
    vertex = subtree.exit_vertex[list(chosen)]
    loops = np.zeros(subtree.n_vertices, dtype=np.int64)
    for v in vertex.tolist():
        while v >= 0:
            loops[v] += 1
            v = int(subtree.parent[v])
    passes = np.where(loops > 0, 2, 0)
    passes[0] = 0
    last = int(np.argmax(subtree.depth_mm[vertex]))
    on_last = np.zeros(subtree.n_vertices, dtype=bool)
    v = int(vertex[last])
    while v >= 0:
        on_last[v] = True
        v = int(subtree.parent[v])
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
    """Return the length of a tour in which the scope returns to the root between any two lesions.

    Args:
        closed: Whether it also returns after the last, the farthest one.
    """
    depth = subtree.depth_mm[subtree.exit_vertex[list(chosen)]]
    return float(2.0 * depth.sum() - (0.0 if closed else depth.max()))


def _order(subtree: Subtree, vertex: Int, last: int, on_last: Bool) -> tuple[int, ...]:
    """Walk depth first and list the lesions as they are met; the last one last, also at its own vertex."""
    lesions_at: dict[int, list[int]] = {}
    for lesion, v in enumerate(vertex.tolist()):
        lesions_at.setdefault(v, []).append(lesion)
    first = np.full(subtree.n_vertices, len(vertex), dtype=np.int64)
    for lesion, v in enumerate(vertex.tolist()):
        while v >= 0:
            first[v] = min(first[v], lesion)
            v = int(subtree.parent[v])
    order: list[int] = []
    stack = [0]
    while stack:
        v = stack.pop()
        here = lesions_at.get(v, [])
        order += sorted(here, key=lambda lesion: lesion == last)
        below = [int(c) for c in np.flatnonzero(subtree.parent == v) if first[c] < len(vertex)]
        stack += sorted(below, key=lambda c: (not on_last[c], -first[c]))
    return tuple(order)


def _between(parent: Int, a: int, b: int) -> list[int]:
    """Return the vertices on the path from `a` to `b`, without `a`."""
    up_a, up_b = _to_root(parent, a), _to_root(parent, b)
    common = set(up_b)
    rise = []
    for v in up_a:
        rise.append(v)
        if v in common:
            break
    fall = up_b[: up_b.index(rise[-1])]
    return rise[1:] + fall[::-1]


def _to_root(parent: Int, v: int) -> list[int]:
    path = [v]
    while parent[path[-1]] >= 0:
        path.append(int(parent[path[-1]]))
    return path
