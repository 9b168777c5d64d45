"""Unite lines of a voxel tree that run side by side, so that a branching lies where they really part."""

import numpy as np

from anatomy.base.typed import Bool
from anatomy.tree.depth import segments_inside
from anatomy.tree.voxel_tree import VoxelTree, voxel_tree_of


def unite_parallel(voxel_tree: VoxelTree, lumen: Bool) -> VoxelTree:
    """Let the children of a node share their path as long as they run through neighbouring voxels."""
    parent = voxel_tree.parent.tolist()
    children: list[list[int]] = [[] for _ in parent]
    for node, above in enumerate(parent):
        if above >= 0:
            children[above].append(node)
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
        kept = _line(first, children)
        at_division = node == voxel_tree.trunk_end
        for other in others:
            line = _line(other, children)
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


def _line(start: int, children: list[list[int]]) -> list[int]:
    """Follow a line to the next node that is an end or divides, included."""
    nodes = [start]
    while len(children[nodes[-1]]) == 1:
        nodes.append(children[nodes[-1]][0])
    return nodes


def _shared(voxel_tree: VoxelTree, kept: list[int], line: list[int], lumen: Bool) -> tuple[int, int]:
    """Return where on `kept` a line leaves it, and how many of its nodes run beside it until there."""
    gap = np.abs(voxel_tree.ijk[line][:, None] - voxel_tree.ijk[kept]).max(axis=2)
    beside = (gap <= 1.0).any(axis=1)
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
    children: list[list[int]] = [[] for _ in parent]
    for node, above in enumerate(parent):
        if above >= 0 and node not in gone:
            children[above].append(node)
    order, stack = [], [0]
    while stack:
        node = stack.pop()
        order.append(node)
        stack += children[node][::-1]
    index = {node: at for at, node in enumerate(order)}
    new_parent = np.array([-1] + [index[parent[node]] for node in order[1:]])
    return voxel_tree_of(voxel_tree.ijk[order], new_parent, index[trunk_end], lumen)
