"""Shortest paths from a pose into the ball of the goal tolerance, and what turning limits rule out.

With R the smallest radius and r the tolerance: where the shortest path CS to the goal itself has a straight
piece of at least r, it is that path less its last r mm; else it is the arc C as far as the ball
(docs/theory/proofs.md, "Workspace").  With r = 0 all of this is about the goal itself.
"""

import math

from anatomy.kernels.arcs import arc_to_point
from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from stages.needle.kernels.connections import arc_and_straight, seen_from, shortest_legs, two_arcs
from stages.needle.kernels.proof import MIN_ARC_MM, TINY


@inner_kernel
def turn_into_ball(rho, h, kappa, tolerance):
    """Return the turn (rad) at which the arc C from outside enters the ball about a point, inf if never."""
    radius = 1.0 / kappa
    aside = radius - rho
    centre2 = aside * aside + h * h
    # The cosine of the angle, seen from the centre of the circle, between the point and the entry.
    cosine = (radius * radius + centre2 - tolerance * tolerance) / max(
        2.0 * radius * math.sqrt(centre2), TINY
    )
    if cosine > 1.0 + TINY:
        return math.inf
    turn = math.atan2(h, aside) - math.acos(min(cosine, 1.0))
    return turn if turn >= 0.0 else turn + 2.0 * math.pi


@merged_kernel
def least_turn_into_ball(rho, h, kappa, tolerance):
    """Return the least turn (rad) of a path CS into the ball about a point, inf if there is none.

    The straight line onwards passes the point at the distance of the tolerance.
    """
    if rho <= tolerance and h >= 0.0:
        return 0.0
    radius = 1.0 / kappa
    centre = math.hypot(radius - rho, h)
    if centre < radius - tolerance - TINY:
        return math.inf
    turn = math.atan2(h, radius - rho) - math.acos(min((radius - tolerance) / centre, 1.0))
    return turn if turn >= -TINY else turn + 2.0 * math.pi


@kernel()
def least_length(rho, h, limits, cosine, turn_left):
    """Return a length below which no path leads into the ball, inf if none does within the turning limits.

    Nothing within the limits is ruled out, and no length stated that a path could do without
    (docs/theory/proofs.md, "Workspace").  The limit of the angle, from a direction of which `cosine` is that
    of the angle to the tip, counts where no tangent of a path can lean from the tip by more than 90 degrees:
    else a tilted tip can wind around the reference, and reaches farther than by one arc.  What is left of the
    accumulated turn, `turn_left` rad, counts up to 180 degrees.  The goal is `rho` mm aside and `h` mm ahead.
    """
    tolerance = limits.goal_tolerance_mm
    kappa = limits.kappa
    radius = 1.0 / kappa
    distance2 = rho * rho + h * h
    if distance2 <= tolerance * tolerance:
        return 0.0
    allowed = turn_left if turn_left <= math.pi else math.inf
    from_tip = limits.max_angle_rad + math.acos(min(max(cosine, -1.0), 1.0))
    if from_tip <= 0.5 * math.pi:
        allowed = min(allowed, from_tip)
    if distance2 < 2.0 * radius * rho - tolerance * (2.0 * radius - tolerance) - 2.0 * radius * TINY:
        # Inside the circle and farther from it than the tolerance.
        if allowed < math.inf:
            return math.inf
        if tolerance > 0.0:
            return math.sqrt(distance2) - tolerance
        away, back = two_arcs(rho, h, kappa)
        return (away + back) / kappa
    turn, straight = arc_and_straight(rho, h, kappa)
    length = turn / kappa + straight - tolerance
    if not tolerance <= straight < math.inf:
        turn = turn_into_ball(rho, h, kappa, tolerance)
        length = turn / kappa
    if turn <= allowed:
        return length
    return length if least_turn_into_ball(rho, h, kappa, tolerance) <= allowed + TINY else math.inf


@kernel()
def workspace_length(rho, h, limits):
    """Return `least_length` for a pose that is its own reference, nothing behind it; inf if out of reach."""
    length = least_length(rho, h, limits, 1.0, limits.max_turn_rad)
    return length if length <= limits.max_length_mm else math.inf


@kernel()
def least_length_from(pose, goal, limits, reference, turn_left):
    """Return `least_length` for a tip on its way, inf also where its displacement would lean too far.

    All tangents of a path lean from `reference` by at most the limit of the angle.  Up to 90 degrees such
    directions form a convex cone, which then holds the displacement too.
    """
    rho, h = seen_from(pose, goal)
    cosine = pose[3] * reference[0] + pose[4] * reference[1] + pose[5] * reference[2]
    if limits.max_angle_rad <= 0.5 * math.pi:
        dx, dy, dz = goal[0] - pose[0], goal[1] - pose[1], goal[2] - pose[2]
        ahead = dx * reference[0] + dy * reference[1] + dz * reference[2]
        far = math.hypot(rho, h)
        beyond = math.atan2(math.sqrt(max(far * far - ahead * ahead, 0.0)), ahead) - limits.max_angle_rad
        from_cone = far if beyond >= 0.5 * math.pi else far * math.sin(beyond)
        # Share of a distance: the limit of the angle itself is kept up to a cosine of TINY.
        if from_cone > limits.goal_tolerance_mm + far * 1e-6:
            return math.inf
    return least_length(rho, h, limits, cosine, turn_left)


@kernel()
def shortest_into_ball(pose, goal, limits):
    """Return the shortest path from a pose into the ball as two legs, and how far the second leads on.

    A leg is a bend and a length, which may be 0; both are for a pose in the ball.  The goal lies straight
    ahead of the second leg if the third length is not 0.  A goal inside the circle, farther from it than the
    tolerance, is reached exactly, by a path CC.
    """
    kappa, tolerance = limits.kappa, limits.goal_tolerance_mm
    rho, h = seen_from(pose, goal)
    first, first_length, second, second_length = shortest_legs(pose, goal, kappa)
    ahead = 0.0
    if rho * rho + h * h <= tolerance * tolerance:
        return first, 0.0, second, 0.0, ahead
    if tolerance > 0.0:
        straight = arc_and_straight(rho, h, kappa)[1]
        turn = turn_into_ball(rho, h, kappa, tolerance)
        if tolerance <= straight < math.inf:
            second_length -= tolerance
            ahead = tolerance
        elif turn < math.inf:
            bend = arc_to_point(pose, goal)[1]
            first, first_length, second_length = (kappa, bend[1], bend[2], bend[3]), turn / kappa, 0.0
    if first_length < MIN_ARC_MM:
        first_length = 0.0
    if second_length + ahead < MIN_ARC_MM:
        second_length = 0.0
    return first, first_length, second, second_length, ahead


@kernel()
def single_into_ball(pose, goal, limits):
    """Return bend and length of the single arc towards the goal up to the ball; a length of 0 for none."""
    length, bend, turn = arc_to_point(pose, goal)
    if bend[0] > limits.kappa * (1.0 + TINY) or turn > math.pi or length == math.inf:
        return bend, 0.0
    half = 0.5 * bend[0] * limits.goal_tolerance_mm
    length -= 2.0 * math.asin(min(half, 1.0)) / bend[0] if half > TINY else limits.goal_tolerance_mm
    return bend, length if length > MIN_ARC_MM else 0.0
