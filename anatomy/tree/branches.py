"""Divide a rooted tree of nodes into branches and put them together as an `AirwayTree`."""

from dataclasses import dataclass

import numpy as np

from anatomy.airway_tree import AirwayTree, TreeReport
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int

TANGENT_REACH_MM = 1.5
"""A tangent is the direction between the points this far before and behind on the branch."""


@dataclass(kw_only=True, eq=False)
class NodeBranch:
    """A branch as node indices; `attach` is the node of the parent branch that it grows from."""

    nodes: list[int]
    parent: "NodeBranch | None"
    attach: int


@frozen_record
class Strand:
    """A branch as points, `(n, 3)` LPS mm, and radii, `(n,)` mm.

    It grows from the point `attach` of the strand `parent`, which comes earlier; both are -1 for the
    trachea.
    """

    points_lps: Float
    radius_mm: Float
    parent: int
    attach: int


def children_of(parents: list[int]) -> list[list[int]]:
    """Return the children of every node of a tree by the parent of each, -1 at the root."""
    children: list[list[int]] = [[] for _ in parents]
    for node, above in enumerate(parents):
        if above >= 0:
            children[above].append(node)
    return children


def line_from(start: int, children: list[list[int]]) -> list[int]:
    """Follow a line to the next node that is an end or divides, included."""
    nodes = [start]
    while len(children[nodes[-1]]) == 1:
        nodes.append(children[nodes[-1]][0])
    return nodes


def divide(mm: Float, parent: Int, depth_mm: Float, trunk_end: int) -> list[NodeBranch]:
    """Divide a tree of nodes (parents first) into branches, parents first.

    Branching points closer together than the radius at the first are one branching: the branch
    between them becomes the end of its parent.
    """
    children = children_of(parent.tolist())
    trunk = [trunk_end]
    while parent[trunk[-1]] >= 0:
        trunk.append(int(parent[trunk[-1]]))
    trunk.reverse()
    first = NodeBranch(nodes=trunk, parent=None, attach=-1)
    branches, at = [first], 0
    on_trunk = set(trunk)
    while at < len(branches):
        branch = branches[at]
        for node in branch.nodes if branch is first else branch.nodes[-1:]:
            for child in children[node]:
                if child not in on_trunk:
                    branches.append(NodeBranch(nodes=line_from(child, children), parent=branch, attach=node))
        at += 1
    return _merge_close(branches, mm, depth_mm)


def _merge_close(branches: list[NodeBranch], mm: Float, depth_mm: Float) -> list[NodeBranch]:
    """Append short branches between two branching points to their parents; return breadth first."""
    queue, merged = [branches[0]], []
    offspring: dict[int, list[NodeBranch]] = {id(b): [] for b in branches}
    for branch in branches[1:]:
        offspring[id(branch.parent)].append(branch)
    while queue:
        branch = queue.pop(0)
        merged.append(branch)
        while (short := _short_child(branch, offspring, mm, depth_mm)) is not None:
            branch.nodes = branch.nodes + short.nodes
            offspring[id(branch)].remove(short)
            for child in offspring[id(short)]:
                child.parent = branch
            offspring[id(branch)] += offspring[id(short)]
        queue += offspring[id(branch)]
    return merged


def _short_child(
    branch: NodeBranch, offspring: dict[int, list[NodeBranch]], mm: Float, depth_mm: Float
) -> NodeBranch | None:
    """Return the widest child at the end of `branch` that divides again within the radius there."""
    end = branch.nodes[-1]
    found = [
        child
        for child in offspring[id(branch)]
        if child.attach == end
        and offspring[id(child)]
        and np.linalg.norm(np.diff(mm[[end, *child.nodes]], axis=0), axis=1).sum() < depth_mm[end]
    ]
    return max(found, key=lambda child: float(depth_mm[child.nodes[-1]]), default=None)


def strands_of(
    branches: list[NodeBranch], lines: list[tuple[Float, dict[int, int]]], radii_mm: list[Float]
) -> list[Strand]:
    """Return branches as points; `lines` are the points `(n, 3)` of each, and where its nodes are in them."""
    index = {id(branch): b for b, branch in enumerate(branches)}
    return [
        Strand(
            points_lps=points,
            radius_mm=radius_mm,
            parent=-1 if branch.parent is None else index[id(branch.parent)],
            attach=-1 if branch.parent is None else lines[index[id(branch.parent)]][1][branch.attach],
        )
        for branch, (points, _), radius_mm in zip(branches, lines, radii_mm, strict=True)
    ]


def assemble(strands: list[Strand], report: TreeReport) -> AirwayTree:
    """Put branches together; generations, lengths along the tree and tangents follow from them."""
    start = np.concatenate(([0], np.cumsum([len(s.radius_mm) for s in strands])))
    points = np.concatenate([s.points_lps for s in strands])
    parent_point = np.arange(-1, len(points) - 1)
    distance, tangents = np.zeros(len(points)), np.zeros((len(points), 3))
    generation: list[int] = []
    for b, strand in enumerate(strands):
        hook = -1 if strand.parent < 0 else int(start[strand.parent]) + strand.attach
        generation.append(0 if strand.parent < 0 else generation[strand.parent] + 1)
        parent_point[start[b]] = hook
        line = strand.points_lps if hook < 0 else np.vstack((points[hook], strand.points_lps))
        along = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))))
        direction = _smooth_tangents(line, along)
        offset = 0 if hook < 0 else 1
        own = slice(int(start[b]), int(start[b + 1]))
        distance[own] = along[offset:] + (0.0 if hook < 0 else distance[hook])
        tangents[own] = direction[offset:]
    return AirwayTree(
        points_lps=points,
        radius_mm=np.concatenate([s.radius_mm for s in strands]),
        parent_point=parent_point,
        branch_of_point=np.repeat(np.arange(len(strands)), np.diff(start)),
        branch_start=start,
        branch_parent=np.array([s.parent for s in strands]),
        generation=np.array(generation),
        distance_from_root_mm=distance,
        tangents=tangents,
        report=report,
    )


def _smooth_tangents(line: Float, along_mm: Float) -> Float:
    """Return the directions `(n, 3)` of a polyline, averaged over `TANGENT_REACH_MM` on both sides."""
    ahead = np.minimum(along_mm + TANGENT_REACH_MM, along_mm[-1])
    behind = np.maximum(along_mm - TANGENT_REACH_MM, 0.0)
    chord = np.stack([np.interp(ahead, along_mm, x) - np.interp(behind, along_mm, x) for x in line.T], axis=1)
    length = np.linalg.norm(chord, axis=1)
    whole = line[-1] - line[0]
    size = float(np.linalg.norm(whole))
    # A line that returns to where it was has no direction there; any unit vector is as good.
    fallback = whole / size if size > 0 else np.array([0.0, 0.0, -1.0])
    usable = length > 1e-9
    return np.asarray(np.where(usable[:, None], chord / np.where(usable, length, 1.0)[:, None], fallback))
