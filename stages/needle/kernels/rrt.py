"""The RRT of [Patil2014] as used in [Kuntz2015] and [Fu2018]."""

import math

import numpy as np

from anatomy.kernels.arcs import any_normal, arc_to_point
from anatomy.kernels.compiling import inner_kernel, kernel
from anatomy.kernels.random import uniform
from stages.needle.kernels import tree
from stages.needle.kernels.connections import seen_from
from stages.needle.kernels.goal_ball import workspace_length
from stages.needle.kernels.proof import MIN_ARC_MM

# Typed numbers: a kernel is compiled once more for every literal that it is called with.
_ROOT = np.int64(0)


@inner_kernel
def sample_between(start, goal, limits, state):
    """Draw a point between start and goal that the start can reach.

    It is drawn from the spindle swept by the arcs of radius R = 1 / curvature between the two, which
    holds the paths that turn by less than 180 degrees; where start and goal are 2 R apart or more and
    there is no such arc, from the cylinder of radius R about the line between them.
    """
    radius = 1.0 / limits.kappa
    ax = goal[0] - start[0]
    ay = goal[1] - start[1]
    az = goal[2] - start[2]
    distance = math.sqrt(ax * ax + ay * ay + az * az)
    ax, ay, az = ax / distance, ay / distance, az / distance
    bx, by, bz = any_normal(ax, ay, az)
    cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    half = 0.5 * distance
    # At most this many points are drawn in search of one in the workspace; then the iteration draws none.
    for _ in range(50):
        along = uniform(state) * distance
        widest = radius
        if half < radius:
            offset = along - half
            widest = math.sqrt(radius * radius - offset * offset) - math.sqrt(radius * radius - half * half)
        r = widest * math.sqrt(uniform(state))
        phi = 2.0 * math.pi * uniform(state)
        u = r * math.cos(phi)
        v = r * math.sin(phi)
        q = (
            start[0] + along * ax + u * bx + v * cx,
            start[1] + along * ay + u * by + v * cy,
            start[2] + along * az + u * bz + v * cz,
        )
        rho, h = seen_from(start, q)
        if workspace_length(rho, h, limits) < math.inf:
            return q, True
    return (goal[0], goal[1], goal[2]), False


@kernel()
def _nearest(nodes, count, q, limits):
    """Return the node with the shortest single arc to a point, -1 if none may take it."""
    best = math.inf
    nearest = -1
    for m in range(count):
        node = nodes[m]
        length, bend, turn = arc_to_point(tree.pose_of(node), q)
        if (
            length < best
            and bend[0] <= limits.kappa
            and node[tree.PATH_LENGTH] + length <= limits.max_length_mm
            and node[tree.PATH_TURN] + turn <= limits.max_turn_rad
        ):
            best = length
            nearest = m
    return nearest


@inner_kernel
def random_arc(pose, limits, state):
    """Draw an arc: any roll, the greatest curvature half of the time and else any, up to the longest step."""
    roll = 2.0 * math.pi * uniform(state)
    ax, ay, az = any_normal(pose[3], pose[4], pose[5])
    bx, by, bz = pose[4] * az - pose[5] * ay, pose[5] * ax - pose[3] * az, pose[3] * ay - pose[4] * ax
    c, s = math.cos(roll), math.sin(roll)
    kappa = limits.kappa * min(2.0 * uniform(state), 1.0)
    length = MIN_ARC_MM + limits.max_step_mm * uniform(state)
    return (kappa, c * ax + s * bx, c * ay + s * by, c * az + s * bz), length


@inner_kernel
def goal_from_root(obstacles, limits, objective, branch, goal, nodes, parents, count, state, best):
    """Try the goal from a tree's root; return the new `count`, if growing ends here, and if it is solved."""
    rho, h = seen_from(tree.pose_of(nodes[0]), goal)
    if math.hypot(rho, h) < MIN_ARC_MM:
        return count, True, False
    if count > 1:
        return count, False, False
    count = tree.add_goal(
        obstacles, limits, objective, branch, nodes, parents, count, _ROOT, goal, best, state
    )
    return count, count > 1, count > 1


@kernel(nogil=True)
def grow_rrt(
    obstacles, limits, objective, branch, goal, nodes, parents, count, iterations, random_share, state, best
):
    """Grow the tree of [Kuntz2015, sec. IV-C] by up to `iterations` samples, until it reaches the goal.

    From the root and after every new node, the goal is tried.  A goal nearer than MIN_ARC_MM to the start is
    no problem to solve: nothing is grown.

    Args:
        branch (int): Pierced branch, whose wall is exempt at the exit; -1 for none.
        nodes ((M, NODE_COLUMNS) float64, parents : (M,) int64): The tree; row 0 is the start pose, `count`
            rows are in use.
        random_share (float): Share of the iterations that extend a random node by a random arc, so that every
            path has a chance; the others draw a point, and extend the node nearest to it.
        best (float): Paths that cost as much are not looked for.

    Returns:
        count, used, solved (int, int, bool): Rows in use, iterations spent, and whether the last row is at
            the goal.
    """
    start = tree.pose_of(nodes[0])
    count, ends, solved = goal_from_root(
        obstacles, limits, objective, branch, goal, nodes, parents, count, state, best
    )
    if ends:
        return count, 0, solved
    for used in range(iterations):
        if count + tree.ROWS_PER_STEP > nodes.shape[0]:
            return count, used, False
        if uniform(state) < random_share:
            near = int(uniform(state) * count)
            bend, length = random_arc(tree.pose_of(nodes[near]), limits, state)
        else:
            q, drawn = sample_between(
                start, tree.within(goal, limits.goal_tolerance_mm, state), limits, state
            )
            near = _nearest(nodes, count, q, limits) if drawn else -1
            if near < 0:
                continue
            length, bend, _turn = arc_to_point(tree.pose_of(nodes[near]), q)
            length = min(length, limits.max_step_mm)
        if not tree.add_arc(
            obstacles, limits, objective, branch, nodes, parents, count, near, bend, length, goal, best
        ):
            continue
        count += 1
        rows = tree.add_goal(
            obstacles, limits, objective, branch, nodes, parents, count, count - 1, goal, best, state
        )
        if rows > count:
            return rows, used + 1, True
    return count, iterations, False
