"""Small airway trees with exact answers, and tours by trying everything."""

from __future__ import annotations

import itertools

import numpy as np

from anatomy.airway_tree import AirwayTree, TreeReport
from anatomy.tree.branches import Strand, assemble
from stages.scope.tour.itinerary import plan_itinerary
from stages.scope.tour.subtree import Exit, Subtree


def straight_branches(ends: list[tuple[int, tuple[float, float, float]]], radius: float = 2.0) -> AirwayTree:
    """Make a tree from branches (parent, end point), points 1 mm apart; the first begins at the origin."""
    strands: list[Strand] = []
    for parent, end in ends:
        start = strands[parent].points_lps[-1] if parent >= 0 else np.zeros(3)
        count = max(round(float(np.linalg.norm(np.subtract(end, start)))), 1)
        share = np.linspace(0.0, 1.0, count + 1)[0 if parent < 0 else 1 :, None]
        points = start * (1.0 - share) + np.array(end, dtype=float) * share
        attach = len(strands[parent].points_lps) - 1 if parent >= 0 else -1
        strands.append(
            Strand(points_lps=points, radius_mm=np.full(len(points), radius), parent=parent, attach=attach)
        )
    return assemble(strands, TreeReport())


def figure_1() -> AirwayTree:
    """Fig. 1 of the paper, on the left side: A-B-C with D and E, and B-F with G and H.

    Branches: 0 trachea to A, 1 A-B, 2 B-C, 3 C-D, 4 C-E, 5 B-F, 6 F-G, 7 F-H, 8 the right main bronchus.
    """
    return straight_branches([
        (-1, (0.0, 0.0, -50.0)),
        (0, (20.0, 0.0, -60.0)),
        (1, (30.0, 0.0, -80.0)),
        (2, (25.0, 0.0, -95.0)),
        (2, (40.0, 0.0, -90.0)),
        (1, (40.0, 0.0, -50.0)),
        (5, (55.0, 0.0, -55.0)),
        (5, (50.0, 0.0, -35.0)),
        (0, (-20.0, 0.0, -60.0)),
    ])  # fmt: skip


def exit_at(lesion: int, tree_point: int) -> Exit:
    return Exit(
        lesion=lesion, tree_point=int(tree_point), roles=(), distance_mm=1.0, angle_rad=0.0, weighted=0.0
    )


def ends_of(tree: AirwayTree, branches: list[int]) -> list[int]:
    return [int(tree.branch_start[b + 1]) - 1 for b in branches]


def by_trying_everything(subtree: Subtree, *, closed: bool) -> float:
    """Return the least cost over all choices of exits."""
    of_lesion = [np.flatnonzero(subtree.exit_lesion == m) for m in range(subtree.n_lesions)]
    return min(plan_itinerary(subtree, c, closed=closed).cost_mm for c in itertools.product(*of_lesion))


def shortest_by_permutations(subtree: Subtree, chosen: tuple[int, ...], *, closed: bool) -> float:
    """Return the length of the best order of visits, by walking all of them."""
    vertex = [0, *(int(subtree.exit_vertex[x]) for x in chosen)]
    depth = subtree.depth_mm

    def distance(a: int, b: int) -> float:
        above = set()
        v = a
        while v >= 0:
            above.add(v)
            v = int(subtree.parent[v])
        v = b
        while v not in above:
            v = int(subtree.parent[v])
        return float(depth[a] + depth[b] - 2 * depth[v])

    best = np.inf
    for order in itertools.permutations(range(1, len(vertex))):
        stops = [0, *order, *([0] if closed else [])]
        best = min(best, sum(distance(vertex[a], vertex[b]) for a, b in itertools.pairwise(stops)))
    return float(best)
