"""Space the points of every branch evenly and measure their radius."""

import numpy as np

from anatomy.base.typed import Float
from anatomy.tree.branches import NodeBranch, Strand, divide
from anatomy.tree.depth import exact_depth_mm, segments_inside
from anatomy.tree.lumen import PreparedLumen
from anatomy.tree.voxel_tree import VoxelTree


def strands_along(voxel_tree: VoxelTree, prepared: PreparedLumen, spacing_mm: float) -> list[Strand]:
    """Resample the branches of a voxel tree and measure their radius."""
    voxel_mm = prepared.grid.spacing_mm
    mm = voxel_tree.ijk * voxel_mm
    depth = exact_depth_mm(prepared.lumen, voxel_mm, voxel_tree.ijk)
    branches = divide(mm, voxel_tree.parent, depth, voxel_tree.trunk_end)
    _drop_cap(branches, mm, depth)
    marks = {b.attach for b in branches} | set(np.flatnonzero(voxel_tree.across_gap).tolist())
    marks |= set(voxel_tree.parent[voxel_tree.across_gap].tolist())
    index = {id(branch): b for b, branch in enumerate(branches)}
    lines = [_resample(branch, voxel_tree, prepared, marks, spacing_mm) for branch in branches]
    ends = np.cumsum([len(points) for points, _ in lines])
    radius = np.split(
        exact_depth_mm(prepared.lumen, voxel_mm, np.concatenate([points for points, _ in lines])), ends[:-1]
    )
    return [
        Strand(
            points_lps=prepared.grid.lps(lines[b][0]),
            radius_mm=radius[b],
            parent=-1 if branch.parent is None else index[id(branch.parent)],
            attach=-1 if branch.parent is None else lines[index[id(branch.parent)]][1][branch.attach],
        )
        for b, branch in enumerate(branches)
    ]


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

    Returns:
        - ijk ((n, 3) float64) - Without the point of the parent branch.
        - index - Index in `ijk` of each node that was kept.
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
