"""Paths of several arcs, from many start poses, to the points that no single arc of `reach_arcs` reaches."""

import math

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from stages.needle.kernels.connections import seen_from
from stages.needle.kernels.goal_ball import workspace_length
from stages.needle.kernels.reach_arcs import CLEARANCE, COST, SEARCHED, UNREACHED, least_clearance
from stages.needle.kernels.rrt import grow_rrt
from stages.needle.kernels.tree import ARC_LENGTH, BEND, PATH_COST, PATH_LENGTH, pose_of

_ONE = np.int64(1)
"""Rows of a tree that is its root alone; for a plain 1 all of the RRT would be compiled once more."""


@inner_kernel
def _grow(obstacles, limits, objective, start, branch, q, nodes, parents, iterations, share, state):
    """Grow a tree from one start pose; return the row at the point, 0 if it was not reached."""
    for c in range(nodes.shape[1]):
        nodes[0, c] = start[c] if c < 6 else 0.0
    count, _used, solved = grow_rrt(
        obstacles, limits, objective, branch, q, nodes, parents, _ONE, iterations, share, state, math.inf
    )
    return count - 1 if solved else 0


@merged_kernel
def _record_path(obstacles, limits, nodes, parents, last, row):
    """Fill `row` with cost and least clearance of the path to the node `last`."""
    least = math.inf
    node = last
    while node != 0:
        parent = parents[node]
        arc = nodes[node]
        bend = (arc[BEND], arc[BEND + 1], arc[BEND + 2], arc[BEND + 3])
        pose = pose_of(nodes[parent])
        if nodes[node, PATH_LENGTH] > limits.exempt_mm or node == last:
            begun = nodes[parent, PATH_LENGTH]
            least = least_clearance(obstacles, limits, pose, bend, arc[ARC_LENGTH], begun, least)
        node = parent
    row[COST] = nodes[last, PATH_COST]
    row[CLEARANCE] = least


@kernel(nogil=True)
def reach_by_search(
    obstacles, limits, objective, starts, branches, order, points, trees, iterations, share, seeds,
    nodes, parents, picked, kinds, found, entries,
):  # fmt: skip
    """Search paths of several arcs to the points that no single arc reaches.

    From every start pose with the point in its workspace, the shortest path is tried; if none is clear, an
    RRT from the first `trees` of them in the mixed order.  What is not stated is as in
    `reach_arcs.reach_by_arcs`; points found become SEARCHED.

    Args:
        iterations, share (int, float): Iterations of each tree, and their share of random arcs.
        seeds ((N,) uint64): Seed of each point, so that points may be searched in any order.

    Returns:
        int: The row of `nodes` at the last point that was searched, 0 if it was not found.
    """
    state = seeds[:1].copy()
    last = 0
    for n in range(points.shape[0]):
        if kinds[n] != UNREACHED:
            continue
        q = (points[n, 0], points[n, 1], points[n, 2])
        state[0] = seeds[n]
        last = 0
        count = 0
        entry = -1
        for entry in order:
            start = starts[entry]
            rho, h = seen_from((start[0], start[1], start[2], start[3], start[4], start[5]), q)
            if workspace_length(rho, h, limits) == math.inf:
                continue
            last = _grow(
                obstacles, limits, objective, start, branches[entry], q, nodes, parents, 0, share, state
            )
            if last > 0:
                break
            if count < trees:
                picked[count] = entry
                count += 1
        turn = 0
        while last == 0 and turn < count:
            entry = picked[turn]
            last = _grow(
                obstacles, limits, objective, starts[entry], branches[entry], q, nodes, parents, iterations,
                share, state,
            )  # fmt: skip
            turn += 1
        if last > 0:
            kinds[n] = SEARCHED
            entries[n] = entry
            _record_path(obstacles, limits, nodes, parents, last, found[n])
    return last
