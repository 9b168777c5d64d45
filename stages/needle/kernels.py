"""Compiled kernels of the needle stage: workspace test, proof of clearance, cost, direct arcs, RRT.

The needle is the path of its tip: arcs of curvature at most `limits[KAPPA]`, any roll in between.
`limits` is a `(9,)` float64 array indexed by the constants below; lengths in mm, angles in radians.
`space` is the tuple (clearance field, label volume, their geometry, obstacle bits), see
`anatomy.kernels.field`; `pose` and `bend` are the tuples of `anatomy.kernels.arcs`.
"""

from __future__ import annotations

import math

import numba

from anatomy.kernels.arcs import any_normal, arc_to_point, point_on_arc, pose_on_arc
from anatomy.kernels.field import (
    EXACT_REACH_MM,
    MIN_GAP_MM,
    distance_bound,
    distance_estimate,
    exact_distance,
)
from anatomy.kernels.labels import LUMEN
from anatomy.kernels.random import uniform

KAPPA = 0
MAX_LENGTH = 1
MAX_ANGLE = 2
MAX_TURN = 3
REQUIRED = 4
RADIUS = 5
EXEMPT_LENGTH = 6
MAX_STEP = 7
COST_STEP = 8
N_LIMITS = 9

CLEARANCE_FLOOR_MM = 0.1
"""Nearer than this, 1 / clearance stays at its value here, so that the integral is finite."""
SAMPLE_TRIES = 50
PROBE_SPACING_MM = 1.5
MIN_ARC_MM = 1e-6
TINY = 1e-9

# Columns of a tree node: pose (6), arc from the parent: length, bend (4); path length, accumulated turn.
ARC_LENGTH = 6
BEND = 7
PATH_LENGTH = 11
PATH_TURN = 12
NODE_COLUMNS = 13


@numba.njit(cache=True)
def shortest_path(rho, h, kappa, max_turn):
    """Return the length of the shortest path to a point `h` ahead and `rho` aside, inf if none.

    Shortest is an arc of the greatest curvature `kappa` followed by a straight piece [Dubins1957], and
    no other path turns less.  Points inside the circle of that curvature take a turn of more than 180
    degrees, which counts as out of reach whatever `max_turn` is.
    """
    radius = 1.0 / kappa
    if rho < TINY:
        return max(h, 0.0) if h >= -TINY else math.inf
    straight2 = (rho - radius) * (rho - radius) + h * h - radius * radius
    if straight2 < -2.0 * radius * TINY:
        return math.inf
    straight = math.sqrt(max(straight2, 0.0))
    # Both angles are seen from the centre of the circle and counted from the start.
    turn = math.atan2(h, radius - rho) - math.atan2(straight, radius)
    if turn < -TINY:
        turn += 2.0 * math.pi
    if turn > min(max_turn, math.pi) + TINY:
        return math.inf
    return radius * max(turn, 0.0) + straight


@numba.njit(cache=True)
def workspace_length(rho, h, limits):
    """Return the length of the shortest path within all limits, inf outside the workspace.

    The limits hold for every path to the point if they hold for the shortest, which also turns least:
    the trumpet of [Kuntz2015, fig. 4], exactly.
    """
    length = shortest_path(rho, h, limits[KAPPA], min(limits[MAX_ANGLE], limits[MAX_TURN]))
    return length if length <= limits[MAX_LENGTH] else math.inf


@numba.njit(cache=True)
def seen_from(pose, q):
    """Return how far aside of a pose (at least 0) and how far ahead of it a point lies."""
    dx = q[0] - pose[0]
    dy = q[1] - pose[1]
    dz = q[2] - pose[2]
    h = dx * pose[3] + dy * pose[4] + dz * pose[5]
    rx = dx - h * pose[3]
    ry = dy - h * pose[4]
    rz = dz - h * pose[5]
    return math.sqrt(rx * rx + ry * ry + rz * rz), h


@numba.njit(cache=True)
def least_cosine(forward, aside, turn):
    """Return the least value of `forward cos a + aside sin a` for `a` from 0 to `turn`.

    With the components of an arc's first tangent and of its bend along a direction, that is the cosine
    of the largest angle between the arc and the direction.
    """
    least = min(forward, forward * math.cos(turn) + aside * math.sin(turn))
    if math.atan2(aside, forward) + math.pi < turn:
        least = -math.hypot(forward, aside)
    return max(least, -1.0)


@numba.njit(cache=True)
def _early_blocker(space, required, pose, bend, begin, length):
    """Look for an obstacle at a few points of an arc, the middle first; 0 if none is met."""
    field, labels, geometry, bits = space
    count = 1
    while (length - begin) / count > PROBE_SPACING_MM:
        for m in range(count):
            x, y, z = point_on_arc(pose, bend, begin + (length - begin) * (m + 0.5) / count)
            if distance_bound(field, geometry, x, y, z) < required:
                distance, label = exact_distance(labels, geometry, x, y, z, bits, -1, required)
                if distance < required:
                    return label
        count *= 2
    return 0


@numba.njit(cache=True)
def blocker_on_arc(space, limits, pose, bend, length, s0, branch):
    """Prove an arc clear of obstacles: 0 if it is, else the label of the voxel that is too near.

    Clearance is 1-Lipschitz: where it exceeds the required one by `gap`, the next `gap` mm are clear.
    The field's lower bound is tried first, then the exact distance to the voxels as solid boxes.
    The first `limits[EXEMPT_LENGTH]` mm of the needle (this arc starts at `s0`) may be near the
    wall of the pierced `branch` (-1: none), but never nearer than the needle's radius to any lumen.
    """
    field, labels, geometry, bits = space
    required = limits[REQUIRED]
    reach = required + EXACT_REACH_MM
    exempt = limits[EXEMPT_LENGTH] - s0 if branch >= 0 else 0.0
    early = _early_blocker(space, required, pose, bend, max(exempt, 0.0), length)
    if early != 0:
        return early
    s = 0.0
    while True:
        x, y, z = point_on_arc(pose, bend, s)
        gap = distance_bound(field, geometry, x, y, z) - required
        if gap < MIN_GAP_MM:
            in_exit = s < exempt - TINY
            spared = branch if in_exit else -1
            distance, label = exact_distance(labels, geometry, x, y, z, bits, spared, reach)
            gap = distance - required
            if in_exit:
                lumen, lumen_label = exact_distance(labels, geometry, x, y, z, LUMEN, -1, reach)
                if lumen - limits[RADIUS] < gap:
                    gap = lumen - limits[RADIUS]
                    label = lumen_label
            if gap < MIN_GAP_MM:
                return label
            if in_exit:
                gap = min(gap, exempt - s)
        if s >= length:
            return 0
        s = min(s + gap, length)


@numba.njit(cache=True)
def inverse_clearance_on_arc(space, step, pose, bend, length):
    """Estimate the integral of 1 / clearance along an arc [Kuntz2015, eq. 1] by the trapezoid rule."""
    field, _labels, geometry, _bits = space
    count = max(int(math.ceil(length / step)), 1)
    total = 0.0
    for m in range(count + 1):
        x, y, z = point_on_arc(pose, bend, length * m / count)
        weight = 0.5 if m == 0 or m == count else 1.0
        total += weight / max(distance_estimate(field, geometry, x, y, z), CLEARANCE_FLOOR_MM)
    return total * length / count


@numba.njit(cache=True, nogil=True)
def workspace_scan(positions, tangents, target, limits, lengths):
    """Fill `lengths` (N,) with the shortest path length from each pose to `target`, inf outside."""
    for n in range(positions.shape[0]):
        x, y, z = positions[n]
        tx, ty, tz = tangents[n]
        rho, h = seen_from((x, y, z, tx, ty, tz), target)
        lengths[n] = workspace_length(rho, h, limits)


@numba.njit(cache=True, nogil=True)
def direct_arcs(space, limits, positions, tangents, branches, target, blockers, costs):
    """Try the single arc from each pose to `target`.

    `blockers` (N,) gets 0 where the arc is proved clear, the label that blocks it, or -1 where no
    single arc within the limits exists; `costs` (N, 2) gets its length and, where it is clear, the
    estimated integral of 1 / clearance.
    """
    for n in range(positions.shape[0]):
        x, y, z = positions[n]
        tx, ty, tz = tangents[n]
        pose = (x, y, z, tx, ty, tz)
        length, bend, turn = arc_to_point(pose, target)
        costs[n, 0] = length
        if (
            bend[0] > limits[KAPPA]
            or length > limits[MAX_LENGTH]
            or turn > min(limits[MAX_ANGLE], limits[MAX_TURN])
        ):
            blockers[n] = -1
            continue
        blockers[n] = blocker_on_arc(space, limits, pose, bend, length, 0.0, branches[n])
        if blockers[n] == 0:
            costs[n, 1] = inverse_clearance_on_arc(space, limits[COST_STEP], pose, bend, length)


@numba.njit(cache=True)
def _pose_of(node):
    return node[0], node[1], node[2], node[3], node[4], node[5]


@numba.njit(cache=True)
def _sample(start, goal, limits, state):
    """Draw a point between start and goal that the start can reach.

    It is drawn from the spindle swept by the arcs of radius R = 1 / curvature between the two, which
    holds the paths that turn by less than 180 degrees; where start and goal are 2 R apart or more and
    there is no such arc, from the cylinder of radius R about the line between them.
    """
    radius = 1.0 / limits[KAPPA]
    ax = goal[0] - start[0]
    ay = goal[1] - start[1]
    az = goal[2] - start[2]
    distance = math.sqrt(ax * ax + ay * ay + az * az)
    ax, ay, az = ax / distance, ay / distance, az / distance
    bx, by, bz = any_normal(ax, ay, az)
    cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    half = 0.5 * distance
    for _ in range(SAMPLE_TRIES):
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


@numba.njit(cache=True)
def _nearest(nodes, count, q, limits):
    """Return the node with the shortest single arc to a point, -1 if none may take it."""
    best = math.inf
    nearest = -1
    for m in range(count):
        node = nodes[m]
        length, bend, turn = arc_to_point(_pose_of(node), q)
        if (
            length < best
            and bend[0] <= limits[KAPPA]
            and node[PATH_LENGTH] + length <= limits[MAX_LENGTH]
            and node[PATH_TURN] + turn <= limits[MAX_TURN]
        ):
            best = length
            nearest = m
    return nearest


@numba.njit(cache=True)
def _extend(space, limits, branch, nodes, parents, count, near, q, goal, max_step):
    """Add an arc from node `near` towards a point, at most `max_step` long; True if it was added.

    Arcs that turn too far from the start are refused, and those from whose end no path within the
    limits leads to the goal.
    """
    node = nodes[near]
    pose = _pose_of(node)
    length, bend, turn = arc_to_point(pose, q)
    if (
        bend[0] > limits[KAPPA]
        or node[PATH_LENGTH] + length > limits[MAX_LENGTH]
        or node[PATH_TURN] + turn > limits[MAX_TURN]
    ):
        return False
    length = min(length, max_step)
    if length < MIN_ARC_MM:
        return False
    start = nodes[0]
    forward = pose[3] * start[3] + pose[4] * start[4] + pose[5] * start[5]
    aside = bend[1] * start[3] + bend[2] * start[4] + bend[3] * start[5]
    turn = bend[0] * length
    if least_cosine(forward, aside, turn) < math.cos(limits[MAX_ANGLE]):
        return False
    end = pose_on_arc(pose, bend, length)
    angle = math.acos(min(max(forward * math.cos(turn) + aside * math.sin(turn), -1.0), 1.0))
    turn_left = min(limits[MAX_TURN] - node[PATH_TURN] - turn, limits[MAX_ANGLE] + angle)
    rho, h = seen_from(end, goal)
    ahead = shortest_path(rho, h, limits[KAPPA], turn_left)
    if node[PATH_LENGTH] + length + ahead > limits[MAX_LENGTH]:
        return False
    if blocker_on_arc(space, limits, pose, bend, length, node[PATH_LENGTH], branch) != 0:
        return False
    new = nodes[count]
    for m in range(6):
        new[m] = end[m]
    new[ARC_LENGTH] = length
    for m in range(4):
        new[BEND + m] = bend[m]
    new[PATH_LENGTH] = node[PATH_LENGTH] + length
    new[PATH_TURN] = node[PATH_TURN] + turn
    parents[count] = near
    return True


@numba.njit(cache=True, nogil=True)
def grow_rrt(space, limits, branch, goal, nodes, parents, count, iterations, state):
    """Grow the tree of [Kuntz2015, sec. IV-C] by up to `iterations` samples.

    After every new node, one arc to the goal is tried from it.  A goal nearer than MIN_ARC_MM to the
    start is no problem to solve: nothing is grown.

    Parameters
    ----------
    space : tuple
    limits : (9,) float64
    branch : int
        Pierced branch, whose wall is exempt at the exit; -1 for none.
    goal : (3,) float64, LPS mm
    nodes : (M, 13) float64, parents : (M,) int64
        The tree; row 0 is the start pose, `count` rows are in use.
    iterations : int
    state : (1,) uint64
        Random state.

    Returns
    -------
    count, used, solved : int, int, bool
        Rows in use, iterations spent, and whether the last row is the goal.
    """
    start = _pose_of(nodes[0])
    rho, h = seen_from(start, goal)
    if math.hypot(rho, h) < MIN_ARC_MM:
        return count, 0, False
    if count == 1 and _extend(space, limits, branch, nodes, parents, 1, 0, goal, goal, math.inf):
        return 2, 0, True
    for used in range(iterations):
        if count + 2 > nodes.shape[0]:
            return count, used, False
        q, drawn = _sample(start, goal, limits, state)
        near = _nearest(nodes, count, q, limits) if drawn else -1
        if near < 0:
            continue
        if not _extend(space, limits, branch, nodes, parents, count, near, q, goal, limits[MAX_STEP]):
            continue
        count += 1
        if _extend(space, limits, branch, nodes, parents, count, count - 1, goal, goal, math.inf):
            return count + 1, used + 1, True
    return count, iterations, False
