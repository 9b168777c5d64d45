"""What stands in the way of a needle: at the start, at the target, and on paths that are tried.

`found` is `(FOUND_SIZE,)` float64: the point of the needle's axis in LPS mm, the length of the needle there,
its distance from the nearest voxel that counts, and the distance that it has to keep.
"""

import math

from anatomy.kernels.arcs import arc_to_point, point_on_arc, pose_on_arc
from anatomy.kernels.compiling import inner_kernel, kernel
from anatomy.kernels.field import distance_bound
from stages.needle.kernels.connections import arc_and_straight, seen_from, shortest_legs
from stages.needle.kernels.proof import exact_gap
from stages.needle.kernels.rrt import sample_between

X, Y, Z, INSERTED, DISTANCE, NEEDED, FOUND_SIZE = range(7)
SPARE_MM = 1e-6
"""Rounding that is allowed for before a place is called blocked."""


@inner_kernel
def _put(found, x, y, z, inserted, distance, needed):
    found[X], found[Y], found[Z] = x, y, z
    found[INSERTED], found[DISTANCE], found[NEEDED] = inserted, distance, needed


@kernel()
def blocked_start(obstacles, limits, pose, inserted, longest, branch, found):
    """Look for a place ahead of a start that no path can pass: 0 if there is none, else the label there.

    A path of curvature up to kappa is after s mm at most `kappa s^2 / 2` away from the tangent's point at s.
    Where that, added to the distance of this point, is less than has to be kept, every path is blocked that
    is at least s long.  Paths are `longest` mm long at least.
    """
    s = 0.0
    while s <= longest:
        aside = 0.5 * limits.kappa * s * s
        if aside >= limits.required_mm:
            return 0
        x, y, z = pose[0] + s * pose[3], pose[1] + s * pose[4], pose[2] + s * pose[5]
        if distance_bound(obstacles.clearance, obstacles.geometry, x, y, z) < limits.required_mm:
            _gap, label, distance, needed = exact_gap(obstacles, limits, inserted + s, x, y, z, branch)
            if distance + aside < needed - SPARE_MM:
                _put(found, x, y, z, inserted + s, distance, needed)
                return label
        # Steps along the tangent at the start; a step that is left out proves less, never something wrong.
        s += 0.05
    return 0


@inner_kernel
def _walk(obstacles, limits, pose, bend, length, inserted, branch, least, least_label, found, best):
    """Follow an arc; return the least clearance to spare and its label, early if it is not above `best`."""
    # Trial paths are looked at in steps of half a voxel: they prove nothing.
    count = max(int(math.ceil(length / 0.25)), 1)
    for m in range(count + 1):
        s = length * m / count
        x, y, z = point_on_arc(pose, bend, s)
        if distance_bound(obstacles.clearance, obstacles.geometry, x, y, z) - limits.required_mm >= least:
            continue
        _gap, label, distance, needed = exact_gap(obstacles, limits, inserted + s, x, y, z, branch)
        if distance - needed < least:
            least = distance - needed
            least_label = label
            _put(found, x, y, z, inserted + s, distance, needed)
            if least <= best:
                break
    return least, least_label


@kernel()
def easiest_trial(obstacles, limits, pose, inserted, branch, goal, trials, state, trial, found):
    """Try the shortest path to a point and others by way of random points, without asking for clearance.

    `trials` random points are drawn with the random state `state` (1,) uint64; `trial` is scratch, and
    `found` gets the tightest place of the path whose tightest place has the most to spare.  Returned are the
    label of the voxel that is nearest there, 0 if no path could be laid, and the number of paths laid.
    """
    best, best_label, tried = -math.inf, 0, 0
    for number in range(trials + 1):
        first = 0.0
        bend = (0.0, 1.0, 0.0, 0.0)
        begin = pose
        if number > 0:
            q, drawn = sample_between(pose, goal, limits, state)
            first, bend, _turn = arc_to_point(pose, q)
            if not drawn or bend[0] > limits.kappa:
                continue
            begin = pose_on_arc(pose, bend, first)
        rho, h = seen_from(begin, goal)
        turn, straight = arc_and_straight(rho, h, limits.kappa)
        if first + turn / limits.kappa + straight > limits.max_length_mm - inserted:
            continue
        bend_a, leg_a, bend_b, leg_b = shortest_legs(begin, goal, limits.kappa)
        middle = pose_on_arc(begin, bend_a, leg_a)
        tried += 1
        least, label = math.inf, 0
        if number > 0:
            least, label = _walk(
                obstacles, limits, pose, bend, first, inserted, branch, least, label, trial, best
            )
        if least > best:
            least, label = _walk(
                obstacles, limits, begin, bend_a, leg_a, inserted + first, branch, least, label, trial, best
            )
        if least > best:
            least, label = _walk(
                obstacles, limits, middle, bend_b, leg_b, inserted + first + leg_a, branch, least, label,
                trial, best,
            )  # fmt: skip
        if least > best:
            best, best_label = least, label
            found[:] = trial
    return best_label, tried
