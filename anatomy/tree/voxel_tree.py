"""Lay a smooth, centred voxel tree through the lumen that never leaves it."""

from dataclasses import replace
from typing import Any

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float, Float32, Int
from anatomy.tree.branches import children_of, line_from
from anatomy.tree.bridge import face_paths
from anatomy.tree.depth import segments_inside
from anatomy.tree.lumen import PreparedLumen
from anatomy.tree.skeleton import SkeletonTree

ROUNDS = 30
"""Rounds of centring and smoothing; together they reach about 4 voxels and smooth over about 2 mm."""


@frozen_record
class VoxelTree:
    """A rooted tree of M positions `ijk` in voxels of the prepared box, parents (-1: none) before children.

    The step from the parent to a position `across_gap` leaves the lumen; the trachea divides at
    `trunk_end`.
    """

    ijk: Float
    parent: Int
    across_gap: Bool
    trunk_end: int


def rooted_voxel_tree(tree: SkeletonTree, root: int, trunk_end: int, prepared: PreparedLumen) -> VoxelTree:
    """Hang the skeleton on its root and walk every diagonal step by faces inside the lumen."""
    ijk: list[Int] = [tree.ijk[root]]
    parent, last_of_trunk = [-1], 0
    stack = [(root, -1, 0)]
    while stack:
        node, came_from, at = stack.pop()
        for other in tree.neighbours[node]:
            if other == came_from:
                continue
            last = at
            for voxel in [*_between(tree.ijk[node], tree.ijk[other], prepared), tree.ijk[other]]:
                ijk.append(voxel)
                parent.append(last)
                last = len(ijk) - 1
            if other == trunk_end:
                last_of_trunk = last
            stack.append((other, node, last))
    return voxel_tree_of(np.array(ijk, dtype=np.float64), np.array(parent), last_of_trunk, prepared.lumen)


def voxel_tree_of(ijk: Float, parent: Int, trunk_end: int, lumen: Bool) -> VoxelTree:
    """Make a voxel tree and mark the steps that leave the lumen."""
    across = np.zeros(len(ijk), dtype=bool)
    across[1:] = ~segments_inside(lumen, ijk[parent[1:]], ijk[1:])
    return VoxelTree(ijk=ijk, parent=parent, across_gap=across, trunk_end=trunk_end)


def _between(begin: Int, end: Int, prepared: PreparedLumen) -> list[Int]:
    """Find the deepest way by faces between two neighbouring voxels, as voxels in between."""
    for mask in (prepared.lumen, prepared.solid):
        ways = [[begin + offset for offset in path] for path in face_paths(end - begin)]
        open_ways = [way for way in ways if all(mask[tuple(v)] for v in way)]
        if open_ways:
            return max(open_ways, key=lambda way: sum(float(prepared.depth_mm[tuple(v)]) for v in way))
    return []


def centred(voxel_tree: VoxelTree, prepared: PreparedLumen, rounds: int) -> VoxelTree:
    """Move all positions but root, tips and gaps to the middle of the lumen, and smooth them, inside it."""
    fixed = voxel_tree.across_gap.copy()
    fixed[voxel_tree.parent[voxel_tree.across_gap]] = True
    fixed[0] = True
    fixed |= np.bincount(voxel_tree.parent[1:], minlength=len(fixed)) == 0
    spacing = prepared.grid.spacing_mm
    average = _neighbour_average(voxel_tree.parent)
    mm = voxel_tree.ijk * spacing
    base = mm.copy()
    for _ in range(rounds):
        mm += _centring_step(mm, voxel_tree.parent, prepared.depth_mm, spacing) * ~fixed[:, None]
        # Each point moves half-way to the mean of its neighbours: more would let a line swing to and fro.
        mm += 0.5 * (average @ mm - mm) * ~fixed[:, None]
    return _kept_inside(voxel_tree, base / spacing, mm / spacing, prepared.lumen)


def _neighbour_average(parent: Int) -> Any:
    """Return the matrix that averages each position's parent and (mean) child."""
    from scipy.sparse import coo_array

    n = len(parent)
    child = np.arange(1, n)
    rows = np.concatenate((child, parent[1:]))
    columns = np.concatenate((parent[1:], child))
    children = np.maximum(np.bincount(parent[1:], minlength=n), 1)
    weights = np.concatenate((np.ones(n - 1), 1.0 / children[parent[1:]]))
    matrix = coo_array((weights, (rows, columns)), shape=(n, n)).tocsr()
    total = np.asarray(matrix.sum(axis=1)).ravel()
    return matrix.multiply(1.0 / np.where(total > 0, total, 1.0)[:, None]).tocsr()


def _centring_step(mm: Float, parent: Int, depth_mm: Float32, spacing_mm: Float) -> Float:
    """Return a small step up the depth, perpendicular to the voxel tree."""
    from scipy.ndimage import map_coordinates

    voxel = float(spacing_mm.min())
    gradient = np.zeros_like(mm)
    for axis in range(3):
        offset = np.zeros(3)
        offset[axis] = voxel / 2
        both = np.concatenate((mm + offset, mm - offset)) / spacing_mm
        value = map_coordinates(depth_mm, both.T, order=1, mode="nearest")
        gradient[:, axis] = (value[: len(mm)] - value[len(mm) :]) / voxel
    along = mm - mm[np.maximum(parent, 0)]
    np.add.at(along, parent[1:], along[1:].copy())
    along /= np.maximum(np.linalg.norm(along, axis=1), 1e-12)[:, None]
    gradient -= np.einsum("ij,ij->i", gradient, along)[:, None] * along
    # Steps so short cannot jump across the middle of the lumen.
    return gradient * (0.25 * voxel)


def _kept_inside(voxel_tree: VoxelTree, base: Float, wanted: Float, lumen: Bool) -> VoxelTree:
    """Draw positions back towards the skeleton until every step that can be inside is inside."""
    share = np.ones(len(base))
    child = np.flatnonzero(~voxel_tree.across_gap & (voxel_tree.parent >= 0))
    parent = voxel_tree.parent[child]
    while True:
        ijk = base + share[:, None] * (wanted - base)
        bad = ~segments_inside(lumen, ijk[parent], ijk[child])
        bad &= (share[parent] > 0) | (share[child] > 0)
        if not bad.any():
            return replace(voxel_tree, ijk=ijk)
        share[np.unique(np.concatenate((parent[bad], child[bad])))] /= 2
        # A step that leaves the lumen is halved so often before it is given up: a sixteenth of it is nothing.
        share[share < 0.5**4] = 0.0


def unite_parallel(voxel_tree: VoxelTree, lumen: Bool) -> VoxelTree:
    """Let the children of a node share their path as long as they run through neighbouring voxels."""
    parent = voxel_tree.parent.tolist()
    children = children_of(parent)
    on_trunk = set()
    at = voxel_tree.trunk_end
    while at >= 0:
        on_trunk.add(at)
        at = parent[at]
    gone: set[int] = set()
    farthest, trunk_end = -1, voxel_tree.trunk_end
    for node in range(len(parent)):
        if node in gone or len(children[node]) < 2:
            continue
        first, *others = sorted(children[node], key=lambda child: child not in on_trunk)
        kept = line_from(first, children)
        at_division = node == voxel_tree.trunk_end
        for other in others:
            line = line_from(other, children)
            hook, shared = _shared(voxel_tree, kept, line, lumen)
            if shared == 0:
                continue
            gone.update(line[:shared])
            children[node].remove(other)
            children[kept[hook]].append(line[shared])
            parent[line[shared]] = kept[hook]
            farthest = max(farthest, hook) if at_division else farthest
        if at_division and farthest >= 0:
            trunk_end = kept[farthest]
    return _without(voxel_tree, parent, gone, trunk_end, lumen)


def _shared(voxel_tree: VoxelTree, kept: list[int], line: list[int], lumen: Bool) -> tuple[int, int]:
    """Return where on `kept` a line leaves it, and how many of its nodes run beside it until there."""
    beside = (np.abs(voxel_tree.ijk[line][:, None] - voxel_tree.ijk[kept]).max(axis=2) <= 1.0).any(axis=1)
    most = len(line) - 1 if beside.all() else int(np.argmin(beside))
    for shared in range(min(most, len(line) - 1), 0, -1):
        if voxel_tree.across_gap[line[: shared + 1]].any():
            continue
        target = voxel_tree.ijk[line[shared]]
        distance = np.linalg.norm(voxel_tree.ijk[kept] - target, axis=1)
        for hook in np.argsort(distance, kind="stable")[:4].tolist():
            if segments_inside(lumen, voxel_tree.ijk[kept[hook]][None], target[None])[0]:
                return hook, shared
    return 0, 0


def _without(
    voxel_tree: VoxelTree, parent: list[int], gone: set[int], trunk_end: int, lumen: Bool
) -> VoxelTree:
    """Leave nodes out and sort the others so that parents come first."""
    children = children_of(parent)
    order, stack = [], [0]
    while stack:
        node = stack.pop()
        order.append(node)
        stack += [child for child in children[node][::-1] if child not in gone]
    index = {node: at for at, node in enumerate(order)}
    new_parent = np.array([-1] + [index[parent[node]] for node in order[1:]])
    return voxel_tree_of(voxel_tree.ijk[order], new_parent, index[trunk_end], lumen)
