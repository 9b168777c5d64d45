"""A tree of arcs: what every sampling search grows.

A row of `nodes` is a pose, the arc that led to it from its parent, and the length, the accumulated turn
and the cost of the path from the root (row 0).  The root of a needle that is already on its way starts
with the length and turn behind it, and its bend's normal is then the direction from which the limit of
the angle counts.
"""

import math

from anatomy.kernels.arcs import arc_to_point, point_on_arc, pose_on_arc
from anatomy.kernels.compiling import inner_kernel, kernel
from anatomy.kernels.random import uniform
from stages.needle.kernels.connections import least_cosine, nearest_turn, seen_from, shortest_legs
from stages.needle.kernels.cost import cost_of_arc
from stages.needle.kernels.goal_ball import least_length_from
from stages.needle.kernels.proof import MIN_ARC_MM, TINY, blocker_on_arc

# Columns: pose (6), arc from the parent: length, bend (4); path length, accumulated turn, path cost.
ARC_LENGTH, BEND, PATH_LENGTH, PATH_TURN, PATH_COST, NODE_COLUMNS = 6, 7, 11, 12, 13, 14
ROWS_PER_STEP = 5
"""Rows that a step of any search adds at most, with one to spare."""


@kernel()
def pose_of(node):
    """Return the pose of a node."""
    return node[0], node[1], node[2], node[3], node[4], node[5]


@kernel()
def reference_of(root):
    """Return the direction from which the limit of the angle counts: the root's own unless it has another."""
    if root[BEND + 1] == 0.0 and root[BEND + 2] == 0.0 and root[BEND + 3] == 0.0:
        return root[3], root[4], root[5]
    return root[BEND + 1], root[BEND + 2], root[BEND + 3]


@inner_kernel
def angle_kept(limits, reference, pose, bend, turn):
    """Tell whether an arc keeps the limit of the angle to `reference`."""
    forward = pose[3] * reference[0] + pose[4] * reference[1] + pose[5] * reference[2]
    aside = bend[1] * reference[0] + bend[2] * reference[1] + bend[3] * reference[2]
    return least_cosine(forward, aside, turn) >= math.cos(limits.max_angle_rad) - TINY


@kernel()
def add_arc(obstacles, limits, objective, branch, nodes, parents, count, near, bend, length, goal, best):
    """Add an arc from node `near` as row `count`; True if it was added.

    Refused are arcs that turn too far or are not proved clear, and those from whose end no path within
    the limits leads to the goal for less than the cost `best`.  A path that ends short of the goal, within
    the tolerance, pays for what is missing, so that ending short gains nothing.
    """
    node = nodes[near]
    pose = pose_of(node)
    turn = bend[0] * length
    path_length = node[PATH_LENGTH] + length
    path_turn = node[PATH_TURN] + turn
    if path_length > limits.max_length_mm or path_turn > limits.max_turn_rad + TINY:
        return False
    reference = reference_of(nodes[0])
    if not angle_kept(limits, reference, pose, bend, turn):
        return False
    end = pose_on_arc(pose, bend, length)
    ahead = 0.0
    missing = math.hypot(*seen_from(end, goal))
    if missing > limits.goal_tolerance_mm + TINY:
        missing = 0.0
        ahead = least_length_from(end, goal, limits, reference, limits.max_turn_rad - path_turn)
    if path_length + ahead > limits.max_length_mm + TINY:
        return False
    rate = objective.least_rate
    if node[PATH_COST] + rate * (length + ahead) >= best:
        return False
    if blocker_on_arc(obstacles, limits, pose, bend, length, node[PATH_LENGTH], branch) != 0:
        return False
    cost = node[PATH_COST] + cost_of_arc(
        obstacles, objective, limits.cost_step_mm, pose, bend, length, near == 0
    )
    cost += rate * missing
    if cost + rate * ahead >= best:
        return False
    new = nodes[count]
    for m in range(6):
        new[m] = end[m]
    new[ARC_LENGTH] = length
    for m in range(4):
        new[BEND + m] = bend[m]
    new[PATH_LENGTH] = path_length
    new[PATH_TURN] = path_turn
    new[PATH_COST] = cost
    parents[count] = near
    return True


@kernel()
def add_legs(obstacles, limits, objective, branch, nodes, parents, count, near, q, goal, best):
    """Add the shortest path from node `near` to a point, all of it or nothing; return the new `count`."""
    pose = pose_of(nodes[near])
    first, first_length, second, second_length = shortest_legs(pose, q, limits.kappa)
    if not first_length + second_length < math.inf:
        return count
    at = near
    rows = count
    if first_length > MIN_ARC_MM:
        if not add_arc(
            obstacles, limits, objective, branch, nodes, parents, rows, at, first, first_length, goal, best
        ):
            return count
        at = rows
        rows += 1
    if second_length > MIN_ARC_MM:
        if not add_arc(
            obstacles, limits, objective, branch, nodes, parents, rows, at, second, second_length, goal, best
        ):
            return count
        rows += 1
    return rows


@kernel()
def aim(pose, goal, limits, state):
    """Return the point within the goal tolerance to try next, drawn at random if there is a tolerance.

    Half of the time it is the goal itself; where that cannot be reached, the nearest point of the arc of
    greatest curvature.
    """
    if limits.goal_tolerance_mm == 0.0:
        return goal[0], goal[1], goal[2]
    if uniform(state) >= 0.5:
        return within(goal, limits.goal_tolerance_mm, state)
    rho, h = seen_from(pose, goal)
    turn, miss = nearest_turn(rho, h, limits.kappa)
    radius = 1.0 / limits.kappa
    if miss <= limits.goal_tolerance_mm and math.hypot(radius - rho, h) < radius:
        _length, bend, _turn = arc_to_point(pose, goal)
        return point_on_arc(pose, (limits.kappa, bend[1], bend[2], bend[3]), turn * radius)
    return goal[0], goal[1], goal[2]


@kernel()
def within(goal, tolerance, state):
    """Return a point drawn uniformly from the ball of the goal tolerance."""
    while True:
        x = 2.0 * uniform(state) - 1.0
        y = 2.0 * uniform(state) - 1.0
        z = 2.0 * uniform(state) - 1.0
        if x * x + y * y + z * z <= 1.0:
            scale = tolerance * (1.0 - TINY)
            return goal[0] + scale * x, goal[1] + scale * y, goal[2] + scale * z


@kernel()
def add_goal(obstacles, limits, objective, branch, nodes, parents, count, near, goal, best, state):
    """Finish at the goal from node `near`, by one arc or the shortest path; return the new `count`."""
    pose = pose_of(nodes[near])
    q = aim(pose, goal, limits, state)
    length, bend, _turn = arc_to_point(pose, q)
    if length < MIN_ARC_MM:
        return count
    if bend[0] <= limits.kappa * (1.0 + TINY) and add_arc(
        obstacles, limits, objective, branch, nodes, parents, count, near, bend, length, goal, best
    ):
        return count + 1
    return add_legs(obstacles, limits, objective, branch, nodes, parents, count, near, q, goal, best)
