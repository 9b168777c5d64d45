"""Many start poses and one target: each is tried by the cheapest means that finds a clear path.

The index of start poses passes over bundles of like poses together.

A bundle is a stretch of the sorted list of poses.  `bounds` is `(B, 8)` float64: middle and mean direction
of each bundle, LPS mm, and a distance (mm) and an angle (rad) from them that none of its poses exceeds.

From a pose that is off by `d` mm and `a` rad, a point `q` is seen displaced by at most `d + |q| a`.  The
workspace of a needle that turns by at most 90 degrees from its start lies ahead of it and outside the circle
of radius 1 / kappa that touches the start on the point's side; so a point deeper in that circle, farther
behind, or farther away than the needle is long, by more than the displacement, is reached by no pose of
the bundle.
"""

import math

import numpy as np

from anatomy.kernels.arcs import arc_to_point
from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from anatomy.kernels.field import MIN_GAP_MM
from stages.needle.kernels.connections import nearest_turn, seen_from, single_arc_exceeds
from stages.needle.kernels.cost import inverse_clearance_on_arc
from stages.needle.kernels.goal_ball import workspace_length
from stages.needle.kernels.proof import MIN_ARC_MM, blocker_on_arc, exact_gap
from stages.needle.kernels.rrt import grow_rrt
from stages.needle.kernels.tree import ROWS_PER_STEP, add_arc, add_goal, pose_of

MIDDLE, DIRECTION, DISTANCE, ANGLE, N_BOUNDS = 0, 3, 6, 7, 8

ROUNDING_MM = 1e-6
"""Added to bounds, so that rounding excludes no pose."""

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
    """Try the single arc from each start pose `(N, 3)`, then paths through via points, then an RRT.

    Before the via points comes the shortest path in free space; through each leads a single arc, and from
    there an arc or the shortest path.

    Args:
        positions, tangents, vias: (N, 3), (N, 3), (V, 3) float64, LPS mm.
        iterations, share, seed: Of the RRT, see `grow_rrt`; 0 iterations for none.  Each pose has its own
            random numbers.
        nodes, parents (arrays): Scratch: a tree.
        kinds ((N,) uint8): Receives NO_PATH, DIRECT, VIA, SEARCHED, START_BLOCKED or OUT_OF_REACH.
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
                obstacles, limits, objective, branch, goal, nodes, parents, _ONE, iterations, share, state,
                math.inf,
            )  # fmt: skip
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


@kernel(nogil=True)
def workspace_scan(positions, tangents, target, limits, lengths):
    """Fill `lengths` (N,) with the shortest path length from each pose to `target`, inf outside."""
    for n in range(positions.shape[0]):
        x, y, z = positions[n]
        tx, ty, tz = tangents[n]
        rho, h = seen_from((x, y, z, tx, ty, tz), target)
        lengths[n] = workspace_length(rho, h, limits)


@kernel(nogil=True)
def direct_arcs(obstacles, limits, positions, tangents, branches, target, blockers, costs):
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
        if single_arc_exceeds(limits, bend, length, turn):
            blockers[n] = -1
            continue
        blockers[n] = blocker_on_arc(obstacles, limits, pose, bend, length, 0.0, branches[n])
        if blockers[n] == 0:
            costs[n, 1] = inverse_clearance_on_arc(obstacles, limits.cost_step_mm, pose, bend, length)


@kernel(nogil=True)
def bound_bundles(positions, tangents, order, begins, bounds):
    """Fill `bounds` (B, 8); bundle `b` holds the poses `order[begins[b]:begins[b + 1]]`."""
    for b in range(bounds.shape[0]):
        row = bounds[b]
        for m in range(N_BOUNDS):
            row[m] = 0.0
        count = begins[b + 1] - begins[b]
        for n in range(begins[b], begins[b + 1]):
            for m in range(3):
                row[MIDDLE + m] += positions[order[n], m] / count
                row[DIRECTION + m] += tangents[order[n], m]
        norm = math.sqrt(row[DIRECTION] ** 2 + row[DIRECTION + 1] ** 2 + row[DIRECTION + 2] ** 2)
        if norm < 1e-9:
            row[DIRECTION], row[DIRECTION + 1], row[DIRECTION + 2] = 1.0, 0.0, 0.0
            norm = 1.0
        farthest = 0.0
        least = 1.0
        for m in range(3):
            row[DIRECTION + m] /= norm
        for n in range(begins[b], begins[b + 1]):
            gap = 0.0
            cosine = 0.0
            for m in range(3):
                gap += (positions[order[n], m] - row[MIDDLE + m]) ** 2
                cosine += tangents[order[n], m] * row[DIRECTION + m]
            farthest = max(farthest, gap)
            least = min(least, cosine)
        row[DISTANCE] = math.sqrt(farthest)
        row[ANGLE] = math.acos(min(max(least, -1.0), 1.0))


@inner_kernel
def _out_of_reach(bound, target, limits):
    """Tell whether no pose of a bundle can have the target in its workspace."""
    dx = target[0] - bound[MIDDLE]
    dy = target[1] - bound[MIDDLE + 1]
    dz = target[2] - bound[MIDDLE + 2]
    far2 = dx * dx + dy * dy + dz * dz
    far = math.sqrt(far2)
    spare = limits.goal_tolerance_mm + ROUNDING_MM
    if far - bound[DISTANCE] - spare > limits.max_length_mm:
        return True
    if limits.max_angle_rad > 0.5 * math.pi:
        return False
    off = bound[DISTANCE] + far * bound[ANGLE] + spare
    h = dx * bound[DIRECTION] + dy * bound[DIRECTION + 1] + dz * bound[DIRECTION + 2]
    radius = 1.0 / limits.kappa
    if h < -off:
        return True
    rho = math.sqrt(max(far2 - h * h, 0.0))
    return math.hypot(h, rho - radius) < radius - off


@kernel(nogil=True)
def workspace_query(bounds, begins, order, positions, tangents, target, limits, found, lengths):
    """Write which poses have `target` in their workspace, and the shortest path lengths; return how many.

    `positions` and `tangents` (N, 3) are in sorted order, `order` (N,) are their numbers in the caller's.
    """
    count = 0
    for b in range(bounds.shape[0]):
        if _out_of_reach(bounds[b], target, limits):
            continue
        for n in range(begins[b], begins[b + 1]):
            pose = (
                positions[n, 0], positions[n, 1], positions[n, 2],
                tangents[n, 0], tangents[n, 1], tangents[n, 2],
            )  # fmt: skip
            rho, h = seen_from(pose, target)
            length = workspace_length(rho, h, limits)
            if length < math.inf:
                found[count] = order[n]
                lengths[count] = length
                count += 1
    return count
