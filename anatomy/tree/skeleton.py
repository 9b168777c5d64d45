"""From a mask to a pruned spanning tree of its skeleton voxels."""

import heapq
from dataclasses import replace
from typing import NoReturn

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import AnatomyError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float, Int
from anatomy.base.words import percent
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
    graph = coo_array((cost, (a.astype(np.int32), b.astype(np.int32))), shape=(len(mm), len(mm))).tocsr()
    spanned = minimum_spanning_tree(graph).tocoo()
    neighbours: list[list[int]] = [[] for _ in range(len(mm))]
    chosen = set()
    for p, q in sorted(zip(spanned.row.tolist(), spanned.col.tolist(), strict=True)):
        neighbours[p].append(q)
        neighbours[q].append(p)
        chosen.add((min(p, q), max(p, q)))
    tree = SkeletonTree(ijk=np.zeros((len(mm), 3), np.int64), mm=mm, depth_mm=depth_mm, neighbours=neighbours)
    return tree, _rings(tree, [(p, q) for p, q in pairs.tolist() if (p, q) not in chosen])


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
        # Rings that begin nearer to each other are one: a wide contact of two airways closes many.
        if not (np.linalg.norm(begins[: len(rings)] - tree.mm[p], axis=1) < 3.0).any():
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
    return float((np.linalg.norm(tree.mm[rest] - tree.mm[end], axis=1) - reach_mm[rest]).min())


BEYOND_RADII = 3.0
"""The width of a branch is judged from 1 to this many radii beyond where it begins."""

MAX_TILT_COS = 0.5
"""The trachea runs within 60 degrees of the body axis."""


@frozen_record
class Trunk:
    """An end of the tree followed inwards over thin side branches to a fork or end, its radius a median."""

    nodes: list[int]
    radius_mm: float
    length_mm: float
    divides: bool


def find_trachea(tree: SkeletonTree, lps_from_mm: Float) -> Trunk:
    """Return the trachea of a tree that is pruned; its first node is the root.

    `lps_from_mm` (3, 3) turns the directions of the tree's own frame into LPS.  Raises AnatomyError if
    nothing is like a trachea: the message says what is there instead.
    """
    trunks = [_follow_trunk(tree, end) for end in tree.ends()]
    # A trachea is about twelve radii long; of one that the image cuts, a quarter is enough to know it by.
    long_ones = [t for t in trunks if t.divides and t.length_mm >= 3.0 * t.radius_mm]
    if not long_ones:
        _refuse(f"it has {len(trunks)} ends and none is a tube that is longer than wide and divides in two")
    trunk = max(long_ones, key=lambda t: t.radius_mm)
    radius, length = trunk.radius_mm, trunk.length_mm
    size = f"the widest tube that divides has the radius {radius:.1f} mm and the length {length:.0f} mm"
    # Half of the tracheal diameter of a newborn is 2 mm.
    if radius < 2.0:
        _refuse(f"{size}, too narrow for any trachea")
    # The least radius of an adult trachea; lobar bronchi are thinner, and must not pass for one by size.
    if radius < 5.0:
        # A trachea is about 12 radii long at any age; bronchi are 4 to 7 [Weibel1963].
        if length < 6.0 * radius:
            _refuse(f"{size}: too narrow for an adult's and too short for a child's trachea")
        share = _lesser_lung_share(tree, trunk)
        # Each main bronchus of a child must carry this share of the tree: a small vessel has a twig on one
        # side.
        if share < 0.15:
            _refuse(f"{size}, but all but {percent(share)} of the tree are on one side of its division")
    # The 95th percentile of the radius among nodes away from the trunk.
    away, end = np.array([bool(near) for near in tree.neighbours]), trunk.nodes[-1]
    away[trunk.nodes] = False
    away &= np.linalg.norm(tree.mm - tree.mm[end], axis=1) > tree.depth_mm[end]
    widest = float(np.percentile(tree.depth_mm[away], 95)) if away.any() else 0.0
    if widest > 1.25 * radius:
        _refuse(f"{size}, but other parts are wider ({widest:.1f} mm)")
    _require_upright(tree, trunk, lps_from_mm, size)
    return trunk


def _follow_trunk(tree: SkeletonTree, end: int) -> Trunk:
    """Follow the tree from an end to the first place where it divides into two wide branches."""
    nodes = tree.chain(end, tree.neighbours[end][0])
    while True:
        radius = float(np.median(tree.depth_mm[nodes]))
        onwards = [tree.chain(nodes[-1], n) for n in tree.neighbours[nodes[-1]] if n != nodes[-2]]
        # Both main bronchi are wider than this fraction of the trachea; a twig on its wall is thinner.
        wide = [c for c in onwards if not _is_bulge(tree, c) and _beyond(tree, c) >= 0.4 * radius]
        if len(wide) != 1:
            divides = len(wide) > 1
            return Trunk(nodes=nodes, radius_mm=radius, length_mm=tree.length_mm(nodes), divides=divides)
        nodes = nodes + wide[0][1:]


def _is_bulge(tree: SkeletonTree, nodes: list[int]) -> bool:
    """Tell whether a branch is a dead end so near its begin that it is a bulge, as of a pressed wall."""
    offset = float(np.linalg.norm(tree.mm[nodes[-1]] - tree.mm[nodes[0]]))
    return len(tree.neighbours[nodes[-1]]) == 1 and offset < BEYOND_RADII * tree.depth_mm[nodes[0]]


def _beyond(tree: SkeletonTree, nodes: list[int]) -> float:
    """Return the median depth of a branch just outside the sphere inscribed where it begins."""
    offset = np.linalg.norm(tree.mm[nodes] - tree.mm[nodes[0]], axis=1)
    radius = tree.depth_mm[nodes[0]]
    outside = np.array(nodes)[(offset > radius) & (offset < BEYOND_RADII * radius)]
    return float(np.median(tree.depth_mm[outside if len(outside) else nodes[-1:]]))


def _lesser_lung_share(tree: SkeletonTree, trunk: Trunk) -> float:
    """Return the share of the nodes beyond the trunk that hang on the second largest branch there."""
    end = trunk.nodes[-1]
    counts = []
    for first in tree.neighbours[end]:
        if first == trunk.nodes[-2]:
            continue
        stack, count = [(first, end)], 0
        while stack:
            node, came_from = stack.pop()
            count += 1
            stack += [(other, node) for other in tree.neighbours[node] if other != came_from]
        counts.append(count)
    return sorted(counts)[-2] / sum(counts)


def _require_upright(tree: SkeletonTree, trunk: Trunk, lps_from_mm: Float, size: str) -> None:
    """Refuse a trunk that does not come from above, or whose branches do not go down or sideways."""
    down = lps_from_mm @ (tree.mm[trunk.nodes[-1]] - tree.mm[trunk.nodes[0]])
    tilt_cos = -float(down[2]) / float(np.linalg.norm(down))
    if tilt_cos <= -MAX_TILT_COS:
        raise AnatomyError(
            f"The airway is upside down: {size} and leads upwards",
            expected="the trachea above the bronchi (LPS +z is superior)",
            remedy="Check the orientation in the header of the mask",
        )
    if tilt_cos < MAX_TILT_COS:
        _refuse(f"{size} and lies across the body axis ({np.degrees(np.arccos(tilt_cos)):.0f} degrees)")


def _refuse(found: str) -> NoReturn:
    raise AnatomyError(
        f"No trachea was found in the airway mask: {found}",
        expected="one connected lumen with the trachea at its superior end, dividing into two main bronchi",
        remedy="Give a mask of the airway lumen that includes the trachea down to the carina",
    )
