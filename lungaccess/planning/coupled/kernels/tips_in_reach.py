"""How far from a target tips of tubes are at least that a needle may lead on from to it.

docs/explanation/cost_bound.md derives it.
"""

from __future__ import annotations

import math

from anatomy.kernels.compiling import inner_kernel, merged_kernel
from lungaccess.planning.coupled.kernels.cost_to_go import angle_at
from lungaccess.planning.coupled.kernels.deployment_box import (
    HALF_INNER,
    HALF_OUTER,
    HALF_ROTATION,
    INNER,
    OUTER,
    SPARE,
)
from stages.tube.kernels import CORNER_MM, CURVED_LENGTH, INNER_CURVATURE, OVERLAP_CURVATURE, planar_point


@inner_kernel
def cross(a, b):
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@inner_kernel
def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inner_kernel
def minus(a, b, scale):
    """Return a - scale b."""
    return (a[0] - scale * b[0], a[1] - scale * b[1], a[2] - scale * b[2])


@merged_kernel
def least_distance(tubes, kappa, pose, box, tip, tangent, target, off):
    """Return how far the tips of a box with the target in reach are at least, mm; inf if there is none.

    The target moves, as the tips see it, with each side of the box.  To first order its distance from the
    middle tip, and from the centre of the tightest circle there, change with each in proportion.  The least
    distance with the target outside of that circle is that of a linear program with one condition.
    """
    base, forward, normal, place, tilt = pose
    outer, inner = box[OUTER], box[INNER]
    half_outer, half_inner, roll = box[HALF_OUTER], box[HALF_INNER], box[HALF_ROTATION]
    bent = tubes[INNER_CURVATURE]
    unlike = tubes[OVERLAP_CURVATURE] - bent
    binormal = cross(forward, normal)
    from_base, from_tip = minus(target, base, 1.0), minus(target, tip, 1.0)
    far_base, far = math.sqrt(dot(from_base, from_base)), math.sqrt(dot(from_tip, from_tip))
    if far < CORNER_MM:
        return 0.0
    # The displacements to first order, and the remainder: what each motion turns of those before it.
    moved = place + tilt * (far_base + place)
    second = moved
    along = dot(from_base, forward)
    lever = math.sqrt(max(far_base * far_base - along * along, 0.0)) + moved
    second += roll * (moved + 0.5 * roll * lever)
    moved += roll * lever
    by_roll = minus((0.0, 0.0, 0.0), cross(forward, from_base), -roll)
    joint = min(max(outer, inner - tubes[CURVED_LENGTH], 0.0), inner)
    x, z = planar_point(tubes, outer, inner, joint)
    from_joint = minus(minus(from_base, normal, x), forward, z)
    about_joint = cross(binormal, from_joint)
    far_joint = math.sqrt(dot(from_joint, from_joint))
    nothing = (0.0, 0.0, 0.0)
    by_outer, by_inner = nothing, nothing
    if outer <= inner and inner + half_inner <= tubes[CURVED_LENGTH]:
        speed = abs(unlike) * (far_joint + moved + half_outer)
        second += abs(unlike) * half_outer * (moved + 0.5 * (1.0 + speed) * half_outer)
        moved += speed * half_outer
        speed = 1.0 + abs(bent) * (far + moved + half_inner) * math.exp(abs(bent) * half_inner)
        second += abs(bent) * half_inner * (moved + 0.5 * speed * half_inner)
        moved += speed * half_inner
        by_outer = minus(nothing, about_joint, -unlike * half_outer)
        change = minus(tangent, cross(binormal, from_tip), -bent)
        by_inner = minus(nothing, change, -half_inner)
    else:
        lever = far + moved + inner + half_inner
        most = max(abs(unlike), abs(bent))
        second += abs(unlike) * lever * half_outer + (1.0 + most * lever) * half_inner
    ahead = dot(from_tip, tangent)
    aside = minus(from_tip, tangent, ahead)
    rho = math.sqrt(dot(aside, aside))
    if rho < CORNER_MM:
        return max(far - moved - off, 0.0)
    radius = 1.0 / kappa
    from_centre = minus(from_tip, aside, radius / rho)
    size = math.sqrt(dot(from_centre, from_centre))
    if size < CORNER_MM:
        return max(far - moved - off, 0.0)
    second += off + SPARE
    sides = (by_roll, by_outer, by_inner)
    outward = across = nearer = 0.0
    for side in sides:
        part = dot(from_centre, side) / size
        outward += abs(part)
        across += math.sqrt(max(dot(side, side) - part * part, 0.0))
        nearer += abs(dot(from_tip, side)) / far
    needed = max(radius - second, 0.0)
    needed = math.sqrt(max(needed * needed - across * across, 0.0)) - size
    if needed > outward:
        return math.inf
    best = -nearer
    for at in sides:
        slope = dot(from_centre, at) / size
        if slope == 0.0:
            continue
        price = dot(from_tip, at) / (far * slope)
        if price <= 0.0:
            continue
        total = price * needed
        for side in sides:
            total -= abs(dot(from_tip, side) / far - price * dot(from_centre, side) / size)
        best = max(best, total)
    return max(far + best - second, 0.0)


@inner_kernel
def leans_too_far(kappa, tangent, ahead, swing, off):
    """Tell whether no path of the curvature `kappa` leads as far as `ahead`, an offset known to `off` mm.

    `swing` (rad) is how well the direction at the start is known.
    """
    x, y, z = ahead
    far = math.sqrt(x * x + y * y + z * z)
    if far <= off:
        return False
    cosine = (tangent[0] * x + tangent[1] * y + tangent[2] * z) / far
    lean = math.acos(min(max(cosine, -1.0), 1.0)) - swing - math.asin(min(off / far, 1.0))
    return lean > angle_at(kappa, far + off) + SPARE
