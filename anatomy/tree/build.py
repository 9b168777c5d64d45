"""Make an `AirwayTree` from a lumen mask or from a centreline graph."""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from anatomy.airway_tree import AirwayTree
from anatomy.base.typed import Int
from anatomy.grid import Volume
from anatomy.tree.branches import Strand, assemble, divide
from anatomy.tree.coverage import complete
from anatomy.tree.depth import inside
from anatomy.tree.lumen import PreparedLumen, prepare_lumen
from anatomy.tree.noise import require_few_tunnels
from anatomy.tree.parallel import unite_parallel
from anatomy.tree.resample import strands_along
from anatomy.tree.skeleton import prune, spanning_tree, thin
from anatomy.tree.trachea import find_trachea
from anatomy.tree.voxel_tree import ROUNDS, VoxelTree, centred, rooted_voxel_tree, voxel_tree_of
from anatomy.tree_report import GapBridged, LoopOpened, SpurPruned, TreeReport


def tree_from_mask(lumen: Volume) -> AirwayTree:
    """Make the airway tree of a lumen mask.

    Args:
        lumen: Mask of the airway lumen, trachea included; non-zero is lumen.

    Returns:
        Every point and every step between neighbouring points lies in the lumen, except across the gaps in
        `report.gaps_bridged`.

    Raises:
        AnatomyError: If the mask is empty, has no trachea, or is noise.

    References:
        [Lee1994] for the thinning; `docs/explanation/airway_tree.md` for the rest.
    """
    prepared = prepare_lumen(lumen, max_gap_mm=5.0)
    grid = prepared.grid
    thinned = thin(prepared.solid)
    require_few_tunnels(thinned)
    ijk = complete(thinned, prepared)
    depth = prepared.solid_depth_mm[tuple(ijk.T)].astype(np.float64)
    skeleton, rings = spanning_tree(ijk, prepared.lumen, depth, grid.spacing_mm)
    spurs = prune(skeleton, grid.spacing_mm)
    trunk = find_trachea(skeleton, grid.lps_from_ijk[:3, :3] / grid.spacing_mm)
    voxel_tree = rooted_voxel_tree(skeleton, trunk.nodes[0], trunk.nodes[-1], prepared)
    voxel_tree = unite_parallel(around_cavities(voxel_tree, prepared), prepared.lumen)
    # Lines that centring has drawn together are one line too.
    voxel_tree = unite_parallel(centred(voxel_tree, prepared, ROUNDS), prepared.lumen)
    voxel_tree = centred(voxel_tree, prepared, ROUNDS // 3)
    report = TreeReport(
        gaps_bridged=prepared.gaps + _contacts(voxel_tree, prepared),
        spurs_pruned=tuple(
            SpurPruned(position_lps=grid.lps(ijk[end]), length_mm=length) for end, length in spurs
        ),
        loops_opened=tuple(
            LoopOpened(position_lps=grid.lps((ijk[a] + ijk[b]) / 2), length_mm=length)
            for a, b, length in rings
        ),
        pieces_left_out=prepared.left_out,
        components_dropped=prepared.components_dropped,
        voxels_dropped=prepared.voxels_dropped,
        cavity_voxels=prepared.cavity_voxels,
    )
    tree = assemble(strands_along(voxel_tree, prepared, spacing_mm=0.75), report)
    return replace(tree, report=replace(report, warnings=warnings_of(tree)))


def tree_from_graph(points_lps: ArrayLike, radius_mm: ArrayLike, edges: ArrayLike) -> AirwayTree:
    """Make the airway tree of a centreline graph with a radius at every point.

    The points are kept as they are.  Points that coincide to 0.001 mm become one.  Of several
    separate pieces the one with most points is kept; a ring is opened where it is narrowest.

    Args:
        points_lps ((N, 3) float64): LPS mm.
        radius_mm: (N,) float64.
        edges ((E, 2) int64): Pairs of points that are neighbours along a branch.

    Raises:
        AnatomyError: If the arrays are empty, do not fit together, hold no finite numbers or no trachea.
    """
    from anatomy.tree.graph import spanned_graph

    skeleton, report = spanned_graph(points_lps, radius_mm, edges)
    trunk = find_trachea(skeleton, np.eye(3))
    order, parent = _rooted(skeleton.neighbours, trunk.nodes[0])
    mm, radius = skeleton.mm[order], skeleton.depth_mm[order]
    branches = divide(mm, parent, radius, order.index(trunk.nodes[-1]))
    index = {id(branch): b for b, branch in enumerate(branches)}
    strands = [
        Strand(
            points_lps=mm[branch.nodes],
            radius_mm=radius[branch.nodes],
            parent=-1 if branch.parent is None else index[id(branch.parent)],
            attach=-1 if branch.parent is None else branch.parent.nodes.index(branch.attach),
        )
        for branch in branches
    ]
    tree = assemble(strands, report)
    return replace(tree, report=replace(report, warnings=warnings_of(tree)))


def _rooted(neighbours: list[list[int]], root: int) -> tuple[list[int], Int]:
    """List the nodes with parents first, and the position of each one's parent in this list."""
    order, parent, came_from = [root], [-1], [-1]
    for at, node in enumerate(order):
        for other in neighbours[node]:
            if other != came_from[at]:
                order.append(other)
                parent.append(at)
                came_from.append(node)
    return order, np.array(parent)


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


def warnings_of(tree: AirwayTree) -> tuple[str, ...]:
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
    left = main[int(np.argmax(ends[:, 0]))]
    right = main[int(np.argmin(ends[:, 0]))]
    # The left main bronchus is about twice as long as the right one; less than this share of it means a
    # mirrored image.
    return bool(tree.branch_length_mm[left] < 0.8 * tree.branch_length_mm[right])


VoxelPath = list[tuple[int, ...]]

MARGIN_VOXELS = 6
"""A path around a cavity is sought in the box of its ends and this many voxels more, wider than cavities
are."""


def around_cavities(voxel_tree: VoxelTree, prepared: PreparedLumen) -> VoxelTree:
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
    window = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    depth = prepared.depth_mm[window].astype(np.float64)
    cost = np.where(prepared.lumen[window], 1.0 / np.maximum(depth, 1e-3) ** 2, -1.0)
    search = MCP_Geometric(cost, fully_connected=False, sampling=tuple(prepared.grid.spacing_mm))
    target = tuple((np.array(end) - low).tolist())
    total, _ = search.find_costs([tuple((np.array(b) - low).tolist()) for b in begins], [target])
    if not np.isfinite(total[target]):
        return []
    return [tuple((np.array(step) + low).tolist()) for step in search.traceback(target)]
