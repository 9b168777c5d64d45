"""Lead a voxel tree around the holes of a lumen mask, through which thinning had laid it."""

from __future__ import annotations

import numpy as np

from anatomy.tree.depth import inside
from anatomy.tree.lumen import PreparedLumen
from anatomy.tree.voxel_tree import VoxelTree, voxel_tree_of

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
