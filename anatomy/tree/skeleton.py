"""From a mask to a pruned spanning tree of its skeleton voxels."""

import heapq
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float, Int
from anatomy.tree.bridge import face_paths

LOOP_EDGES = 12
"""A ring of fewer skeleton voxels is roughness of the mask, not two airways that touch."""


SPUR_VOXELS = 1.5
"""A branch this far beyond the surface of its parent's sphere, or less, is roughness of the mask."""
SPUR_RADII = 0.5
"""The same as a share of the sphere's radius: wide airways have larger bumps."""
SPUR_MAX_MM = 3.0
"""Even the thinnest airways that a CT shows are longer than this."""


@frozen_record
class SkeletonTree:
    """An unrooted tree of N nodes: voxels `ijk` and `mm` (the same times the spacing), `(N, 3)`.

    `depth_mm` `(N,)` is the distance to the border of the lumen; nodes that were taken off have no
    neighbours.
    """

    ijk: Int
    mm: Float
    depth_mm: Float
    neighbours: list[list[int]]

    def step_mm(self, a: int, b: int) -> float:
        """Length between two nodes."""
        return float(np.linalg.norm(self.mm[a] - self.mm[b]))

    def ends(self) -> list[int]:
        """List the nodes with one neighbour."""
        return [n for n, near in enumerate(self.neighbours) if len(near) == 1]

    def chain(self, start: int, following: int) -> list[int]:
        """Walk from `start` over `following` to the next branching node or end, both included."""
        nodes = [start, following]
        while len(self.neighbours[nodes[-1]]) == 2:
            a, b = self.neighbours[nodes[-1]]
            nodes.append(b if a == nodes[-2] else a)
        return nodes

    def length_mm(self, nodes: list[int]) -> float:
        """Length along consecutive nodes."""
        return float(np.linalg.norm(np.diff(self.mm[nodes], axis=0), axis=1).sum())


def thin(solid: Bool) -> Int:
    """Return the skeleton voxels `(M, 3)` of a mask (thinning that keeps its topology)."""
    from skimage.morphology import skeletonize

    return np.argwhere(skeletonize(np.ascontiguousarray(solid)))


def spanning_tree(
    ijk: Int, lumen: Bool, depth_mm: Float, spacing_mm: Float
) -> tuple[SkeletonTree, list[tuple[int, int, float]]]:
    """Span skeleton voxels `(M, 3)`, each a neighbour of the 26 around it; see `span`.

    Voxels of the lumen that touch by an edge or corner alone are joined only where nothing else joins
    them.
    """
    from scipy.spatial import KDTree

    pairs = KDTree(ijk).query_pairs(1.8, output_type="ndarray").astype(np.int64).reshape(-1, 2)
    pairs = np.sort(pairs, axis=1)
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    width = np.maximum(depth_mm, float(spacing_mm.min()) / 4)
    passable = _walkable(ijk[pairs[:, 0]], ijk[pairs[:, 1]], lumen)
    # A step across a mere contact counts as this many steps in the lumen: it is taken only where nothing
    # else joins.
    tree, rings = span(ijk * spacing_mm, width, pairs, np.where(passable, 1.0, 100.0))
    return replace(tree, ijk=ijk, depth_mm=depth_mm), rings


def _walkable(begin: Int, end: Int, lumen: Bool) -> Bool:
    """Tell which steps between neighbouring voxels can be walked by faces inside the lumen."""
    step = end - begin
    walkable = np.zeros(len(step), dtype=bool)
    for kind in np.unique(step, axis=0):
        of_kind = np.flatnonzero((step == kind).all(axis=1))
        for path in face_paths(kind):
            open_way = np.ones(len(of_kind), dtype=bool)
            for offset in path:
                open_way &= lumen[tuple((begin[of_kind] + offset).T)]
            walkable[of_kind] |= open_way
    return walkable


def span(
    mm: Float, depth_mm: Float, pairs: Int, factor: ArrayLike = 1.0
) -> tuple[SkeletonTree, list[tuple[int, int, float]]]:
    """Span a graph by the tree that keeps to the widest path.

    An edge costs its length over the squared depth, so that a ring is cut where it is thinnest.

    Args:
        mm: (M, 3) float64.
        depth_mm: (M,) float64.
        pairs ((E, 2) int64): The edges, sorted, the smaller index first.
        factor ((E,) float64): Multiplies the cost of each edge.

    Returns:
        - tree
        - loops (list of (node, node, length_mm)) - The cuts of rings of at least `LOOP_EDGES` edges, and the
          length once around.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import minimum_spanning_tree

    a, b = pairs.T
    length = np.linalg.norm(mm[a] - mm[b], axis=1)
    cost = length / np.maximum(np.minimum(depth_mm[a], depth_mm[b]), 1e-3) ** 2 * factor
    # The spanning tree leaves out edges that cost nothing, as it does those that are not there.
    cost = np.clip(cost, 1e-300, 1e300)
    # Older versions of scipy (1.13 to 1.16) span graphs with indices of 32 bits only.
    edges = a.astype(np.int32), b.astype(np.int32)
    graph = coo_array((cost, edges), shape=(len(mm), len(mm))).tocsr()
    spanned = minimum_spanning_tree(graph).tocoo()
    neighbours: list[list[int]] = [[] for _ in range(len(mm))]
    chosen = set()
    for p, q in sorted(zip(spanned.row.tolist(), spanned.col.tolist(), strict=True)):
        neighbours[p].append(q)
        neighbours[q].append(p)
        chosen.add((min(p, q), max(p, q)))
    tree = SkeletonTree(ijk=np.zeros((len(mm), 3), np.int64), mm=mm, depth_mm=depth_mm, neighbours=neighbours)
    left_out = [(p, q) for p, q in pairs.tolist() if (p, q) not in chosen]
    return tree, _rings(tree, left_out)


def _rings(tree: SkeletonTree, left_out: list[tuple[int, int]]) -> list[tuple[int, int, float]]:
    """Measure the rings that the edges left out would close; one for each place."""
    if not left_out:
        return []
    parent, level = _hang(tree.neighbours, left_out[0][0])
    rings: list[tuple[int, int, float]] = []
    begins = np.zeros((len(left_out), 3))
    for p, q in left_out:
        around, a, b = [p], p, q
        back = [q]
        while a != b:
            if level[a] >= level[b]:
                a = parent[a]
                around.append(a)
            else:
                b = parent[b]
                back.append(b)
        nodes = around + back[::-1]
        if len(nodes) < LOOP_EDGES:
            continue
        others = begins[: len(rings)]
        # Rings that begin nearer to each other are one: a wide contact of two airways closes many.
        if not (np.linalg.norm(others - tree.mm[p], axis=1) < 3.0).any():
            begins[len(rings)] = tree.mm[p]
            rings.append((p, q, tree.length_mm([*nodes, p])))
    return rings


def _hang(neighbours: list[list[int]], root: int) -> tuple[list[int], list[int]]:
    """Return parent and level of every node of the tree that holds `root`."""
    parent, level = [-1] * len(neighbours), [0] * len(neighbours)
    stack = [root]
    while stack:
        node = stack.pop()
        for other in neighbours[node]:
            if other != parent[node]:
                parent[other], level[other] = node, level[node] + 1
                stack.append(other)
    return parent, level


def prune(tree: SkeletonTree, spacing_mm: Float) -> list[tuple[int, float]]:
    """Take the spurs off `tree` in place, least first; return tip and length in mm of each.

    A branch is a spur if its tip leaves the spheres inscribed along the rest of the tree by less than
    `SPUR_VOXELS` voxels or `SPUR_RADII` radii of the sphere, whichever is more.  A cut only makes the
    rest smaller, so that what is kept never becomes a spur by a later cut.
    """
    voxel = float(spacing_mm.max())
    reach = np.maximum(tree.depth_mm + SPUR_VOXELS * voxel, tree.depth_mm * (1.0 + SPUR_RADII))
    alive = np.array([bool(near) for near in tree.neighbours])
    queue = [(_protrusion(tree, end, reach, alive), end) for end in tree.ends()]
    heapq.heapify(queue)
    spurs = []
    while queue:
        known, end = heapq.heappop(queue)
        now = _protrusion(tree, end, reach, alive)
        if now > known:
            heapq.heappush(queue, (now, end))
        elif now < 0:
            nodes = tree.chain(end, tree.neighbours[end][0])
            spurs.append((end, tree.length_mm(nodes)))
            tree.neighbours[nodes[-1]].remove(nodes[-2])
            alive[nodes[:-1]] = False
            for node in nodes[:-1]:
                tree.neighbours[node].clear()
    return spurs


def _protrusion(tree: SkeletonTree, end: int, reach_mm: Float, alive: Bool) -> float:
    """Return by how far a tip leaves the reach of the rest of the tree, mm; negative for a spur."""
    nodes = tree.chain(end, tree.neighbours[end][0])
    root = nodes[-1]
    # A branch longer than this many radii of its parent and `SPUR_MAX_MM` is no spur, wherever its tip lies.
    longest = 3.0 * float(tree.depth_mm[root]) + SPUR_MAX_MM
    if len(tree.neighbours[root]) < 3 or tree.length_mm(nodes) > longest:
        return float("inf")
    rest = alive.copy()
    rest[nodes[:-1]] = False
    distance = np.linalg.norm(tree.mm[rest] - tree.mm[end], axis=1)
    return float((distance - reach_mm[rest]).min())
