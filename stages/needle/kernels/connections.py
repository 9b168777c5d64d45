"""Shortest paths of bounded curvature from a pose to a point, and the sets of points they reach.

A path of the needle has curvature at most `kappa`; it may roll anywhere.  By symmetry the shortest path
from a pose to a point lies in the plane of both, so a point is two numbers: `rho` aside of the pose and
`h` ahead of it.  With R = 1 / kappa, C an arc of radius R and S a straight piece, the shortest path is CS
to points outside the circle of radius R on the point's side and CC to points inside it, the first arc
turning away [Dubins1957, CockayneHall1975].

The *trumpet* of a pose is the set of points it reaches [Kuntz2015, fig. 4]; the *spindle* of two points
is the set of points on the paths between them.
"""

import math

from anatomy.kernels.arcs import any_normal, arc_to_point
from anatomy.kernels.compiling import kernel, merged_kernel
from stages.needle.kernels.proof import TINY


@kernel()
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


@kernel()
def arc_and_straight(rho, h, kappa):
    """Return turn (rad, below 2 pi) and straight length of the path CS to a point; (inf, inf) if none."""
    radius = 1.0 / kappa
    if rho < TINY and h >= 0.0:
        return 0.0, h
    straight2 = (rho - radius) * (rho - radius) + h * h - radius * radius
    if straight2 < -2.0 * radius * TINY:
        return math.inf, math.inf
    straight = math.sqrt(max(straight2, 0.0))
    # Both angles are seen from the centre of the circle and counted from the start.
    turn = math.atan2(h, radius - rho) - math.atan2(straight, radius)
    if turn < -TINY:
        turn += 2.0 * math.pi
    return max(turn, 0.0), straight


@kernel()
def two_arcs(rho, h, kappa):
    """Return the turns (rad) of the shorter path CC to a point: away from it, then towards it.

    (inf, inf) where the point is too far.  The second circle touches the first, whose centre lies at
    `rho = -R`, and passes through the point.
    """
    radius = 1.0 / kappa
    dx = rho + radius
    distance = math.hypot(dx, h)
    cosine = (distance * distance + 3.0 * radius * radius) / (4.0 * radius * max(distance, TINY))
    if cosine > 1.0:
        return math.inf, math.inf
    at_centre = math.acos(cosine)
    ahead = math.atan2(h, dx)
    best_first = math.inf
    best_second = math.inf
    for side in range(2):
        first = ahead + at_centre if side == 0 else ahead - at_centre
        if first < -TINY:
            first += 2.0 * math.pi
        first = max(first, 0.0)
        # From the second centre, the point of contact lies straight back towards the first.
        cx = 2.0 * radius * math.cos(first) - radius
        cy = 2.0 * radius * math.sin(first)
        second = (math.pi + first) - math.atan2(h - cy, rho - cx)
        second -= 2.0 * math.pi * math.floor(second / (2.0 * math.pi))
        if first + second < best_first + best_second:
            best_first = first
            best_second = second
    return best_first, best_second


@kernel()
def shortest_path(rho, h, kappa, max_angle, max_turn):
    """Return the length of the shortest path CS or CC to a point within two turning limits, inf if none.

    `max_angle` limits the angle between tip and start direction, `max_turn` the sum of all turning, both
    in rad.  Exact without turning limits, with an angle of at most 90 degrees, and with a turn of at most
    180: then no path leads to points inside the circle, and to others none turns less than CS.
    """
    turn, straight = arc_and_straight(rho, h, kappa)
    if min(turn, math.pi) <= max_angle + TINY and turn <= max_turn + TINY:
        return turn / kappa + straight
    if max_turn <= math.pi:
        return math.inf
    away, back = two_arcs(rho, h, kappa)
    if max(min(away, math.pi), min(back - away, math.pi)) > max_angle + TINY or away + back > max_turn + TINY:
        return math.inf
    return (away + back) / kappa


@kernel()
def nearest_turn(rho, h, kappa):
    """Return the turn (rad) at which the arc of radius 1 / kappa passes a point nearest, and how near."""
    radius = 1.0 / kappa
    turn = math.atan2(h, radius - rho)
    return max(turn, 0.0), abs(radius - math.hypot(radius - rho, h)) if turn >= 0.0 else math.hypot(rho, h)


@kernel()
def single_arc_exceeds(limits, bend, length, turn):
    """Tell whether an arc that is the whole path breaks a limit of curvature, length or turning."""
    return (
        bend[0] > limits.kappa
        or length > limits.max_length_mm
        or turn > min(limits.max_angle_rad, limits.max_turn_rad)
    )


@kernel()
def least_cosine(forward, aside, turn):
    """Return the least value of `forward cos a + aside sin a` for `a` from 0 to `turn`.

    With the components of an arc's first tangent and of its bend along a direction, that is the cosine
    of the largest angle between the arc and the direction.
    """
    least = min(forward, forward * math.cos(turn) + aside * math.sin(turn))
    if math.atan2(aside, forward) + math.pi < turn:
        least = -math.hypot(forward, aside)
    return max(least, -1.0)


@kernel()
def shortest_legs(pose, q, kappa):
    """Return the shortest path from a pose to a point as two legs: bend and length of each.

    The second leg is straight (CS), or bends the other way (CC); its bend is what `pose_on_arc` needs at
    the end of the first.  A leg may have length 0.
    """
    _length, bend, _turn = arc_to_point(pose, q)
    nx, ny, nz = bend[1], bend[2], bend[3]
    rho, h = seen_from(pose, q)
    turn, straight = arc_and_straight(rho, h, kappa)
    if turn < math.inf:
        first = (kappa, nx, ny, nz)
        end_x, end_y, end_z = _tangent_after(pose, first, turn)
        sx, sy, sz = any_normal(end_x, end_y, end_z)
        return first, turn / kappa, (0.0, sx, sy, sz), straight
    away, back = two_arcs(rho, h, kappa)
    # Turned by `away`, the normal towards the first centre; the second circle lies opposite.
    c, s = math.cos(away), math.sin(away)
    second = (kappa, c * nx + s * pose[3], c * ny + s * pose[4], c * nz + s * pose[5])
    return (kappa, -nx, -ny, -nz), away / kappa, second, back / kappa


@merged_kernel
def _tangent_after(pose, bend, turn):
    c, s = math.cos(turn), math.sin(turn)
    return c * pose[3] + s * bend[1], c * pose[4] + s * bend[2], c * pose[5] + s * bend[3]
