"""Compiled kernels of the index of start poses: bundles of like poses, passed over together.

A bundle is a stretch of the sorted list of poses.  `bounds` is `(B, 8)` float64: middle and mean direction
of each bundle, LPS mm, and a distance (mm) and an angle (rad) from them that none of its poses exceeds.

From a pose that is off by `d` mm and `a` rad, a point `q` is seen displaced by at most `d + |q| a`.  The
workspace of a needle that turns by at most 90 degrees from its start lies ahead of it and outside the circle
of radius 1 / kappa that touches the start on the point's side; so a point deeper in that circle, farther
behind, or farther away than the needle is long, by more than the displacement, is reached by no pose of
the bundle.
"""

import math

from anatomy.kernels.compiling import inner_kernel, kernel
from stages.needle.kernels.connections import seen_from
from stages.needle.kernels.goal_ball import workspace_length

MIDDLE, DIRECTION, DISTANCE, ANGLE, N_BOUNDS = 0, 3, 6, 7, 8

ROUNDING_MM = 1e-6
"""Added to bounds, so that rounding excludes no pose."""


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
