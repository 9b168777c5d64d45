"""Make an `AirwayTree` from a lumen mask or from a centreline graph."""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from anatomy.airway_tree import AirwayTree, GapBridged, LoopOpened, SpurPruned, TreeReport
from anatomy.base.errors import AnatomyError
from anatomy.base.typed import Float, Int
from anatomy.grid import Volume
from anatomy.morphology import window
from anatomy.tree.branches import NodeBranch, Strand, assemble, divide, strands_of
from anatomy.tree.depth import exact_depth_mm, inside, segments_inside
from anatomy.tree.lumen import PreparedLumen, complete, prepare_lumen, require_at_most, tunnels
from anatomy.tree.skeleton import SkeletonTree, find_trachea, prune, span, spanning_tree, thin
from anatomy.tree.voxel_tree import (
    ROUNDS,
    VoxelTree,
    centred,
    rooted_voxel_tree,
    unite_parallel,
    voxel_tree_of,
)

MOST_LUMEN_ML = 1000.0
"""A lumen of more millilitres is no airway: those of adults have 20 to 200, and lungs have litres.  To find
middle lines of lungs takes many minutes; the check of masks comes later and refuses from 500 ml on."""


def tree_from_mask(lumen: Volume) -> AirwayTree:
    """Make the airway tree of a mask of the lumen, trachea included [Lee1994].

    Every point and every step between neighbouring points lies in the lumen, except across the gaps in
    `report.gaps_bridged`.  See `docs/explanation/airway_tree.md`.  Raises AnatomyError if the mask is empty,
    has no trachea, is noise, or is larger than any airway.
    """
    volume_ml = np.count_nonzero(lumen.array) * lumen.grid.voxel_volume_mm3 / 1000.0
    if volume_ml > MOST_LUMEN_ML:
        raise AnatomyError(
            f"The airway lumen has {volume_ml:.0f} ml",
            expected=f"an airway, at most {MOST_LUMEN_ML:.0f} ml",
            remedy="Check the voxel size in the header, and whether the mask is that of the lungs",
        )
    prepared = prepare_lumen(lumen, max_gap_mm=5.0)
    grid = prepared.grid
    thinned = thin(prepared.solid)
    if len(thinned):
        # Airways never meet again: a tunnel is a fault of the mask, and a CT shows some hundred branches.
        # Middle lines of airways have some thousand voxels; among so many of noise are tunnels enough.
        require_at_most(tunnels(thinned[:50_000]), 500, "tunnels, where airways meet again")
    ijk = complete(thinned, prepared)
    depth = prepared.solid_depth_mm[tuple(ijk.T)].astype(np.float64)
    skeleton, rings = spanning_tree(ijk, prepared.lumen, depth, grid.spacing_mm)
    spurs = prune(skeleton, grid.spacing_mm)
    trunk = find_trachea(skeleton, grid.lps_from_ijk[:3, :3] / grid.spacing_mm)
    voxel_tree = rooted_voxel_tree(skeleton, trunk.nodes[0], trunk.nodes[-1], prepared)
    voxel_tree = unite_parallel(_around_cavities(voxel_tree, prepared), prepared.lumen)
    # Lines that centring has drawn together are one line too.
    voxel_tree = unite_parallel(centred(voxel_tree, prepared, ROUNDS), prepared.lumen)
    voxel_tree = centred(voxel_tree, prepared, ROUNDS // 3)
    report = replace(
        prepared.report,
        gaps_bridged=prepared.report.gaps_bridged + _contacts(voxel_tree, prepared),
        spurs_pruned=tuple(
            SpurPruned(position_lps=grid.lps(ijk[end]), length_mm=length) for end, length in spurs
        ),
        loops_opened=tuple(
            LoopOpened(position_lps=grid.lps((ijk[a] + ijk[b]) / 2), length_mm=length)
            for a, b, length in rings
        ),
    )
    return _tree_of(_strands_along(voxel_tree, prepared, spacing_mm=0.75), report)


def tree_from_graph(points_lps: ArrayLike, radius_mm: ArrayLike, edges: ArrayLike) -> AirwayTree:
    """Make the airway tree of a centreline graph with a radius at every point.

    The points are kept as they are.  Points that coincide to 0.001 mm become one.  Of several
    separate pieces the one with most points is kept; a ring is opened where it is narrowest.  Raises
    AnatomyError if the arrays are empty, do not fit together, hold no finite numbers or no trachea.

    Args:
        points_lps ((N, 3) float64): LPS mm.
        radius_mm: (N,) float64.
        edges ((E, 2) int64): Pairs of points that are neighbours along a branch.
    """
    skeleton, report = _spanned_graph(points_lps, radius_mm, edges)
    trunk = find_trachea(skeleton, np.eye(3))
    # Nodes with parents first, and the position of each one's parent among them.
    order, above, came_from = [trunk.nodes[0]], [-1], [-1]
    for at, node in enumerate(order):
        for other in skeleton.neighbours[node]:
            if other != came_from[at]:
                order.append(other)
                above.append(at)
                came_from.append(node)
    parent = np.array(above)
    mm, radius = skeleton.mm[order], skeleton.depth_mm[order]
    branches = divide(mm, parent, radius, order.index(trunk.nodes[-1]))
    lines = [(mm[each.nodes], {node: at for at, node in enumerate(each.nodes)}) for each in branches]
    return _tree_of(strands_of(branches, lines, [radius[each.nodes] for each in branches]), report)


def _tree_of(strands: list[Strand], report: TreeReport) -> AirwayTree:
    tree = assemble(strands, report)
    return replace(tree, report=replace(report, warnings=_warnings_of(tree)))


def _contacts(voxel_tree: VoxelTree, prepared: PreparedLumen) -> tuple[GapBridged, ...]:
    """List the steps between voxels of the lumen that touch by an edge or corner alone."""
    step = np.flatnonzero(voxel_tree.across_gap)
    begin, end = voxel_tree.ijk[voxel_tree.parent[step]], voxel_tree.ijk[step]
    at = np.rint(np.stack((begin, end))).astype(np.int64)
    in_lumen = prepared.lumen[at[..., 0], at[..., 1], at[..., 2]].all(axis=0)
    return tuple(
        GapBridged(position_lps=prepared.grid.lps((a + b) / 2), length_mm=0.0, voxels_joined=0)
        for a, b in zip(begin[in_lumen], end[in_lumen], strict=True)
    )


ADULT_TRACHEA_MM = (5.0, 14.0)
"""Radii between which the trachea of an adult lies, wide disease included."""


def _warnings_of(tree: AirwayTree) -> tuple[str, ...]:
    """List what is unusual about a tree, one sentence each."""
    found = []
    radius = float(np.median(tree.radius_mm[tree.branch_points(0)]))
    length = float(tree.branch_length_mm[0])
    if not ADULT_TRACHEA_MM[0] <= radius <= ADULT_TRACHEA_MM[1]:
        low, high = ADULT_TRACHEA_MM
        found.append(f"The trachea has the radius {radius:.1f} mm; in adults it is {low:g} to {high:g} mm.")
    # A trachea is about twelve radii long; below half of that it is taken for cut.
    if length < 6.0 * radius:
        found.append(f"Only {length:.0f} mm of the trachea are in the mask.")
    if _looks_mirrored(tree):
        found.append(
            "The main bronchus on the patient's left is the shorter one; it is the right one in nearly "
            "everybody. Check that the mask is not mirrored."
        )
    return tuple(found)


def _looks_mirrored(tree: AirwayTree) -> bool:
    """Tell whether the first division has its shorter branch on the left (LPS +x)."""
    main = [b for b in tree.children(0) if tree.parent_point[tree.branch_start[b]] == tree.carina_point]
    if len(main) != 2 or any(len(tree.children(b)) == 0 for b in main):
        return False
    ends = tree.points_lps[[tree.branch_start[b + 1] - 1 for b in main]]
    left, right = main[int(np.argmax(ends[:, 0]))], main[int(np.argmin(ends[:, 0]))]
    # The left main bronchus is about twice as long as the right one; less than this share of it means a
    # mirrored image.
    return bool(tree.branch_length_mm[left] < 0.8 * tree.branch_length_mm[right])


VoxelPath = list[tuple[int, ...]]

MARGIN_VOXELS = 6
"""A path around a cavity is sought in the box of its ends and this many voxels more, wider than cavities
are."""


def _around_cavities(voxel_tree: VoxelTree, prepared: PreparedLumen) -> VoxelTree:
    """Replace the positions that lie in cavities by paths through the lumen beside them.

    Positions in bridges stay.  A twig that ends in a cavity ends before it.
    """
    voxel = np.rint(voxel_tree.ijk).astype(np.int64)
    in_cavity = ~inside(prepared.lumen, voxel_tree.ijk) & ~prepared.bridges[tuple(voxel.T)]
    if not in_cavity.any():
        return voxel_tree
    ijk: list[tuple[int, ...]] = []
    parent: list[int] = []
    new_index = np.full(len(voxel), -1)
    detours: dict[int, list[int]] = {}
    for node in range(len(voxel)):
        if in_cavity[node]:
            continue
        before = int(voxel_tree.parent[node])
        while before >= 0 and in_cavity[before]:
            before = int(voxel_tree.parent[before])
        last = int(new_index[before]) if before >= 0 else -1
        if before >= 0 and before != voxel_tree.parent[node]:
            known = detours.setdefault(last, [last])
            path = _path(prepared, [ijk[n] for n in known], tuple(voxel[node].tolist()))
            if path:
                last = known[[ijk[n] for n in known].index(path[0])]
            for step in path[1:-1]:
                ijk.append(step)
                parent.append(last)
                last = len(ijk) - 1
                known.append(last)
        ijk.append(tuple(voxel[node].tolist()))
        parent.append(last)
        new_index[node] = len(ijk) - 1
    trunk_end = voxel_tree.trunk_end
    while in_cavity[trunk_end]:
        trunk_end = int(voxel_tree.parent[trunk_end])
    return voxel_tree_of(
        np.array(ijk, dtype=np.float64), np.array(parent), int(new_index[trunk_end]), prepared.lumen
    )


def _path(prepared: PreparedLumen, begins: VoxelPath, end: tuple[int, ...]) -> VoxelPath:
    """Find the path by faces through the middle of the lumen from any of `begins` to `end`."""
    from skimage.graph import MCP_Geometric

    corners = np.array([*begins, end])
    low = np.maximum(corners.min(axis=0) - MARGIN_VOXELS, 0)
    high = corners.max(axis=0) + MARGIN_VOXELS + 1
    box = window(low, high)
    depth = prepared.depth_mm[box].astype(np.float64)
    cost = np.where(prepared.lumen[box], 1.0 / np.maximum(depth, 1e-3) ** 2, -1.0)
    search = MCP_Geometric(cost, fully_connected=False, sampling=tuple(prepared.grid.spacing_mm))
    target = tuple((np.array(end) - low).tolist())
    total, _ = search.find_costs([tuple((np.array(b) - low).tolist()) for b in begins], [target])
    if not np.isfinite(total[target]):
        return []
    return [tuple((np.array(step) + low).tolist()) for step in search.traceback(target)]


def _spanned_graph(
    points_lps: ArrayLike, radius_mm: ArrayLike, edges: ArrayLike
) -> tuple[SkeletonTree, TreeReport]:
    """Check the arrays of a graph, unite equal points, keep the largest piece and open its rings."""
    points, radius, pairs = _checked(points_lps, radius_mm, edges)
    points, radius, pairs = _united(points, radius, pairs)
    points, radius, pairs, dropped, left_out = _largest_piece(points, radius, pairs)
    tree, rings = span(points, radius, pairs)
    report = TreeReport(
        loops_opened=tuple(
            LoopOpened(position_lps=(points[a] + points[b]) / 2, length_mm=length) for a, b, length in rings
        ),
        components_dropped=dropped,
        voxels_dropped=left_out,
    )
    return tree, report


def _checked(points_lps: ArrayLike, radius_mm: ArrayLike, edges: ArrayLike) -> tuple[Float, Float, Int]:
    points = np.asarray(points_lps, dtype=np.float64)
    radius = np.asarray(radius_mm, dtype=np.float64)
    pairs = np.asarray(edges, dtype=np.int64)
    problem = ""
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 2:
        problem = f"the points have the shape {points.shape}"
    elif radius.shape != (len(points),):
        problem = f"{len(points)} points have radii of the shape {radius.shape}"
    elif pairs.ndim != 2 or pairs.shape[1] != 2 or len(pairs) == 0:
        problem = f"the edges have the shape {pairs.shape}"
    elif not np.isfinite(points).all() or not np.isfinite(radius).all() or (radius < 0).any():
        problem = "a coordinate or radius is not finite, or a radius is negative"
    elif radius.max() > 100.0:
        problem = f"a radius is {radius.max():.3g} mm"
    elif pairs.min() < 0 or pairs.max() >= len(points):
        problem = f"an edge names the point {pairs.max()} of {len(points)}, or a negative one"
    if problem:
        raise AnatomyError(
            f"A centreline graph is unusable: {problem}",
            expected="points (N, 3) and radii (N,) in mm, edges (E, 2) between them",
            remedy="Check the centreline file",
        )
    return points, radius, pairs


def _united(points: Float, radius: Float, pairs: Int) -> tuple[Float, Float, Int]:
    """Unite points that coincide and drop edges that then lead nowhere or twice to the same point."""
    from scipy.spatial import KDTree

    # Files store points in single precision; true neighbours are a hundred times farther apart.
    label = _piece_of_points(len(points), KDTree(points).query_pairs(1e-3, output_type="ndarray"))
    _, first, index = np.unique(label, return_index=True, return_inverse=True)
    # Numbered by first occurrence, so that the order of the file is kept.
    order = np.argsort(first)
    mapped = np.sort(np.argsort(order)[index][pairs], axis=1)
    mapped = np.unique(mapped[mapped[:, 0] != mapped[:, 1]], axis=0)
    return points[first[order]], radius[first[order]], mapped


def _piece_of_points(count: int, pairs: Int) -> Int:
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1])


def _largest_piece(points: Float, radius: Float, pairs: Int) -> tuple[Float, Float, Int, int, int]:
    label = _piece_of_points(len(points), pairs)
    keep = label == np.argmax(np.bincount(label))
    new = np.cumsum(keep) - 1
    inner = pairs[keep[pairs[:, 0]]] if len(pairs) else pairs
    return points[keep], radius[keep], new[inner], int(label.max()), int(len(points) - keep.sum())


def _strands_along(voxel_tree: VoxelTree, prepared: PreparedLumen, spacing_mm: float) -> list[Strand]:
    """Resample the branches of a voxel tree and measure their radius."""
    voxel_mm = prepared.grid.spacing_mm
    mm = voxel_tree.ijk * voxel_mm
    depth = exact_depth_mm(prepared.lumen, voxel_mm, voxel_tree.ijk)
    branches = divide(mm, voxel_tree.parent, depth, voxel_tree.trunk_end)
    _drop_cap(branches, mm, depth)
    marks = {b.attach for b in branches} | set(np.flatnonzero(voxel_tree.across_gap).tolist())
    marks |= set(voxel_tree.parent[voxel_tree.across_gap].tolist())
    lines = [_resample(branch, voxel_tree, prepared, marks, spacing_mm) for branch in branches]
    ends = np.cumsum([len(points) for points, _ in lines])
    along = exact_depth_mm(prepared.lumen, voxel_mm, np.concatenate([points for points, _ in lines]))
    lines = [(prepared.grid.lps(points), index) for points, index in lines]
    return strands_of(branches, lines, np.split(along, ends[:-1]))


def _drop_cap(branches: list[NodeBranch], mm: Float, depth_mm: Float) -> None:
    """Take off the beginning of the trachea, where the end of the mask cuts the inscribed sphere."""
    nodes = branches[0].nodes
    median = float(np.median(depth_mm[nodes]))
    hooks = {b.attach for b in branches}
    first = 0
    # The trachea begins where the inscribed sphere reaches this fraction of the trachea's radius.
    while (
        depth_mm[nodes[first]] < 0.8 * median
        and float(np.linalg.norm(mm[nodes[first]] - mm[nodes[0]])) < 2 * median
        and nodes[first] not in hooks
    ):
        first += 1
    branches[0].nodes = nodes[first:]


def _resample(
    branch: NodeBranch, voxel_tree: VoxelTree, prepared: PreparedLumen, marks: set[int], spacing_mm: float
) -> tuple[Float, dict[int, int]]:
    """Space the points of a branch evenly between the nodes in `marks`, which are kept.

    Returned are the points in voxels `(n, 3)`, without that of the parent branch, and the index of each node
    that was kept.
    """
    line = branch.nodes if branch.attach < 0 else [branch.attach, *branch.nodes]
    keep = [n for n in range(len(line)) if n in (0, len(line) - 1) or line[n] in marks]
    pieces, index, count = [voxel_tree.ijk[line[:1]]], {line[0]: 0}, 1
    for a, b in zip(keep[:-1], keep[1:], strict=True):
        fine = voxel_tree.ijk[line[a : b + 1]]
        across = b == a + 1 and voxel_tree.across_gap[line[b]]
        points = fine[1:] if across else _even(fine, prepared, spacing_mm)[1:]
        pieces.append(points)
        count += len(points)
        index[line[b]] = count - 1
    ijk = np.concatenate(pieces)
    if branch.attach < 0:
        return ijk, index
    return ijk[1:], {node: at - 1 for node, at in index.items()}


def _even(fine: Float, prepared: PreparedLumen, spacing_mm: float) -> Float:
    """Space points evenly along a polyline; where a chord would leave the lumen, keep the polyline."""
    steps = np.linalg.norm(np.diff(fine, axis=0) * prepared.grid.spacing_mm, axis=1)
    along = np.concatenate(([0.0], np.cumsum(steps)))
    station = np.linspace(0.0, along[-1], max(1, round(float(along[-1]) / spacing_mm)) + 1)
    points = np.stack([np.interp(station, along, x) for x in fine.T], axis=1)
    bad = np.flatnonzero(~segments_inside(prepared.lumen, points[:-1], points[1:]))
    if len(bad) == 0:
        return points
    inner = [(along > station[k] + 1e-9) & (along < station[k + 1] - 1e-9) for k in bad]
    extra = np.flatnonzero(np.any(inner, axis=0))
    order = np.argsort(np.concatenate((station, along[extra])), kind="stable")
    return np.concatenate((points, fine[extra]))[order]
