"""Many start poses and one target: each is tried by the cheapest means that finds a clear path."""

import math

import numpy as np

from anatomy.kernels.arcs import arc_to_point
from anatomy.kernels.compiling import kernel, merged_kernel
from anatomy.kernels.field import MIN_GAP_MM
from stages.needle.kernels.connections import nearest_turn, seen_from, single_arc_exceeds
from stages.needle.kernels.goal_ball import workspace_length
from stages.needle.kernels.limits import MIN_ARC_MM
from stages.needle.kernels.proof import blocker_on_arc, exact_gap
from stages.needle.kernels.rrt import grow_rrt
from stages.needle.kernels.tree import ROWS_PER_STEP, add_arc, add_goal, pose_of

NO_PATH, DIRECT, VIA, SEARCHED, START_BLOCKED, OUT_OF_REACH = 0, 1, 2, 3, 4, 5

ROWS = ROWS_PER_STEP + 2
"""Rows that a tree needs before its first step."""

# Typed numbers: a kernel is compiled once more for every literal that it is called with.
_ROOT, _ONE, _TWO = np.int64(0), np.int64(1), np.int64(2)


@kernel(nogil=True)
def try_starts(
    obstacles, limits, objective, branch, positions, tangents, vias, goal, iterations, share, seed, nodes,
    parents, kinds,
):  # fmt: skip
    """Try the single arc from each start pose, then paths through via points, then an RRT.

    Before the via points comes the shortest path in free space; through each leads a single arc, and from
    there an arc or the shortest path.

    Parameters
    ----------
    positions, tangents : (N, 3) float64
    vias : (V, 3) float64, LPS mm
    iterations, share : int, float
        Of the RRT, see `grow_rrt`; 0 iterations for none.
    seed : int
        Of the random numbers; each pose has its own.
    nodes, parents : arrays
        Scratch: a tree.
    kinds : (N,) uint8
        Receives NO_PATH, DIRECT, VIA, SEARCHED, START_BLOCKED or OUT_OF_REACH.
    """
    state = np.zeros(1, dtype=np.uint64)
    for n in range(positions.shape[0]):
        x, y, z = positions[n, 0], positions[n, 1], positions[n, 2]
        pose = (x, y, z, tangents[n, 0], tangents[n, 1], tangents[n, 2])
        gap, _label, _distance, _needed = exact_gap(obstacles, limits, 0.0, x, y, z, branch)
        if gap < MIN_GAP_MM:
            kinds[n] = START_BLOCKED
            continue
        rho, h = seen_from(pose, goal)
        if workspace_length(rho, h, limits) == math.inf:
            kinds[n] = OUT_OF_REACH
            continue
        if _by_arc(obstacles, limits, branch, pose, goal):
            kinds[n] = DIRECT
            continue
        for c in range(nodes.shape[1]):
            nodes[0, c] = 0.0
        for c in range(6):
            nodes[0, c] = pose[c]
        state[0] = np.uint64(seed) + np.uint64(n)
        kinds[n] = NO_PATH
        if _by_vias(obstacles, limits, objective, branch, vias, goal, nodes, parents, state):
            kinds[n] = VIA
        elif iterations > 0:
            _count, _used, solved = grow_rrt(
                obstacles,
                limits,
                objective,
                branch,
                goal,
                nodes,
                parents,
                _ONE,
                iterations,
                share,
                state,
                math.inf,
            )
            if solved:
                kinds[n] = SEARCHED


@merged_kernel
def _by_arc(obstacles, limits, branch, pose, goal):
    """Tell whether the single arc that ends at the goal, or nearest to it, is clear and within all limits."""
    length, bend, turn = arc_to_point(pose, goal)
    if bend[0] > limits.kappa and limits.goal_tolerance_mm > 0.0:
        rho, h = seen_from(pose, goal)
        turn, miss = nearest_turn(rho, h, limits.kappa)
        if miss > limits.goal_tolerance_mm:
            return False
        length, bend = turn / limits.kappa, (limits.kappa, bend[1], bend[2], bend[3])
    if single_arc_exceeds(limits, bend, length, turn):
        return False
    return blocker_on_arc(obstacles, limits, pose, bend, length, 0.0, branch) == 0


@merged_kernel
def _by_vias(obstacles, limits, objective, branch, vias, goal, nodes, parents, state):
    """Try the shortest path, then paths through one via point each; True if one is clear."""
    rows = add_goal(obstacles, limits, objective, branch, nodes, parents, _ONE, _ROOT, goal, math.inf, state)
    if rows > 1:
        return True
    pose = pose_of(nodes[0])
    for v in range(vias.shape[0]):
        q = (vias[v, 0], vias[v, 1], vias[v, 2])
        length, bend, _turn = arc_to_point(pose, q)
        if not MIN_ARC_MM < length < math.inf or bend[0] > limits.kappa:
            continue
        if not add_arc(
            obstacles, limits, objective, branch, nodes, parents, _ONE, _ROOT, bend, length, goal, math.inf
        ):
            continue
        rows = add_goal(
            obstacles, limits, objective, branch, nodes, parents, _TWO, _ONE, goal, math.inf, state
        )
        if rows > 2:
            return True
    return False
