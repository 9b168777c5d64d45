"""Make an `AirwayTree` from a lumen mask or from a centreline graph."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from anatomy.airway_tree import AirwayTree
from anatomy.base.typed import Int
from anatomy.grid import Volume
from anatomy.tree.branches import Strand, assemble, divide
from anatomy.tree.cavities import around_cavities
from anatomy.tree.coverage import complete
from anatomy.tree.lumen import PreparedLumen, prepare_lumen
from anatomy.tree.noise import require_few_tunnels
from anatomy.tree.parallel import unite_parallel
from anatomy.tree.resample import strands_along
from anatomy.tree.skeleton import prune, spanning_tree, thin
from anatomy.tree.trachea import find_trachea
from anatomy.tree.voxel_tree import ROUNDS, VoxelTree, centred, rooted_voxel_tree
from anatomy.tree.warn import warnings_of
from anatomy.tree_report import GapBridged, LoopOpened, SpurPruned, TreeReport


def tree_from_mask(lumen: Volume, *, max_gap_mm: float = 5.0, spacing_mm: float = 0.75) -> AirwayTree:
    """Make the airway tree of a lumen mask.

    Parameters
    ----------
    lumen : Volume
        Mask of the airway lumen, trachea included; non-zero is lumen.
    max_gap_mm : float
        Longest break of the lumen that is bridged.
    spacing_mm : float
        Distance between points along a branch (about; at least one point a branch).

    Returns
    -------
    AirwayTree
        Every point and every step between neighbouring points lies in the lumen, except across the
        gaps in `report.gaps_bridged`.

    Raises
    ------
    AnatomyError
        If the mask is empty, has no trachea, or is noise.

    References
    ----------
    [Lee1994] for the thinning; `docs/explanation/airway_tree.md` for the rest.
    """
    prepared = prepare_lumen(lumen, max_gap_mm)
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
        components_dropped=prepared.components_dropped,
        voxels_dropped=prepared.voxels_dropped,
        cavity_voxels=prepared.cavity_voxels,
    )
    tree = assemble(strands_along(voxel_tree, prepared, spacing_mm), report)
    return replace(tree, report=replace(report, warnings=warnings_of(tree)))


def tree_from_graph(points_lps: ArrayLike, radius_mm: ArrayLike, edges: ArrayLike) -> AirwayTree:
    """Make the airway tree of a centreline graph with a radius at every point.

    The points are kept as they are.  Points that coincide to 0.001 mm become one.  Of several
    separate pieces the one with most points is kept; a ring is opened where it is narrowest.

    Parameters
    ----------
    points_lps : (N, 3) float64
        LPS mm.
    radius_mm : (N,) float64
    edges : (E, 2) int64
        Pairs of points that are neighbours along a branch.

    Raises
    ------
    AnatomyError
        If the arrays are empty, do not fit together, hold no finite numbers or no trachea.
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
