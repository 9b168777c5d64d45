"""Collision of the scope: its radius against the Euclidean depth, or eq. 1 of [Rosell2012] as printed."""

import math
from typing import NamedTuple

import numpy as np

from anatomy.base.typed import Float, Int32, Labels
from anatomy.kernels.compiling import inlined_kernel, kernel
from anatomy.kernels.field import EXACT_REACH_MM, MIN_GAP_MM, distance_bound, exact_distance
from anatomy.kernels.labels import OUTSIDE
from stages.scope.advisor.kernels.chain import circle_curvature, joints_of, move_base

FINE_DEPTH_MM = 2.0
"""Below this the depth at voxel centres is exact; above it may be a lower bound."""
EASY_MM = 0.1
"""Where a bound leaves so much clearance, nothing finer is computed: a finer step would gain little."""

# Typed numbers: a kernel is compiled once more for every literal that it is called with.
_NOBODY = np.int64(-1)
_OUTSIDE = np.int64(OUTSIDE)


class LumenArrays(NamedTuple):
    """Arrays of a lumen of N interior voxels, for kernels.

    numbers : (ni, nj, nk) int32, -1 for wall; geometry : (3, 6), see `anatomy.kernels.field`;
    lps_from_ijk : (3, 4); voxels : (N, 3) int32; depth, depth_geometry : field of the depth in the lumen;
    solid : (ni, nj, nk) uint16, OUTSIDE where there is no lumen; clearance : (N,) L1 distance to the wall,
    and potential : (N,), both as the navigation field counts; steps_to_wall : (N,) L1 distance in voxels.
    """

    numbers: Int32
    geometry: Float
    lps_from_ijk: Float
    voxels: Int32
    depth: Labels
    depth_geometry: Float
    solid: Labels
    clearance: Float
    potential: Float
    steps_to_wall: Float
    centre_depth: Float


class Scope(NamedTuple):
    """A scope, for kernels: lengths in mm, angles in rad.

    `radius` is kept along the whole body; where it is 0, eq. 1 with `printed_limit` (l / s) rules instead.
    """

    links: int
    link: float
    twist_low: float
    twist_high: float
    bend_low: float
    bend_high: float
    bend_step: float
    radius: float
    printed_limit: float
    sweep_middle: float


@inlined_kernel
def voxel_of(lumen, x, y, z):
    """Return the number of the voxel that holds a point, -1 for wall."""
    g = lumen.geometry
    u = g[0, 0] * x + g[0, 1] * y + g[0, 2] * z + g[0, 3]
    v = g[1, 0] * x + g[1, 1] * y + g[1, 2] * z + g[1, 3]
    w = g[2, 0] * x + g[2, 1] * y + g[2, 2] * z + g[2, 3]
    ni, nj, nk = lumen.numbers.shape
    if not (0.0 <= u < ni and 0.0 <= v < nj and 0.0 <= w < nk):
        return -1
    return lumen.numbers[int(u), int(v), int(w)]


@inlined_kernel
def distance_to(lumen, voxel, x, y, z):
    """Return the distance from a point to the centre of a voxel."""
    v = lumen.voxels[voxel]
    m = lumen.lps_from_ijk
    dx = m[0, 0] * v[0] + m[0, 1] * v[1] + m[0, 2] * v[2] + m[0, 3] - x
    dy = m[1, 0] * v[0] + m[1, 1] * v[1] + m[1, 2] * v[2] + m[1, 3] - y
    dz = m[2, 0] * v[0] + m[2, 1] * v[1] + m[2, 2] * v[2] + m[2, 3] - z
    return math.sqrt(dx * dx + dy * dy + dz * dz)


@inlined_kernel
def clearance_beyond(lumen, radius, x, y, z):
    """Return the clearance of a ball of `radius` about a point, a lower bound; negative if the wall cuts it.

    Where the field cannot tell, the voxels around are searched, up to `EXACT_REACH_MM` beyond the ball.
    """
    bound = distance_bound(lumen.depth, lumen.depth_geometry, x, y, z)
    if bound - radius >= EASY_MM:
        return bound - radius
    g = lumen.depth_geometry
    voxel = voxel_of(lumen, x, y, z)
    if voxel < 0 or bound + math.sqrt(g[0, 4] + g[1, 4] + g[2, 4]) + 0.01 < radius:
        return -1.0
    away = distance_to(lumen, voxel, x, y, z)
    middle = lumen.centre_depth[voxel]
    if middle - away - radius >= EASY_MM:
        return middle - away - radius
    if middle < FINE_DEPTH_MM and middle + away < radius:
        return -1.0
    cap = radius + EXACT_REACH_MM
    return exact_distance(lumen.solid, lumen.geometry, x, y, z, _OUTSIDE, _NOBODY, cap)[0] - radius


@inlined_kernel
def chain_fits(lumen, scope, joints):
    """Tell whether a ball of the scope's radius fits everywhere along the links, from the tip backwards."""
    along = 0.0
    length = scope.links * scope.link
    while True:
        k = min(int(along / scope.link), scope.links - 1)
        t = min(along / scope.link - k, 1.0)
        tip = scope.links - k
        x = joints[tip, 0] + t * (joints[tip - 1, 0] - joints[tip, 0])
        y = joints[tip, 1] + t * (joints[tip - 1, 1] - joints[tip, 1])
        z = joints[tip, 2] + t * (joints[tip - 1, 2] - joints[tip, 2])
        gap = clearance_beyond(lumen, scope.radius, x, y, z)
        if gap < MIN_GAP_MM:
            return False
        if along >= length:
            return True
        along = min(along + gap, length)


@inlined_kernel
def base_fits(lumen, scope, state, alpha, beta, distance, scratch):
    """Tell whether the shaft fits along the arc on which the base moves by `distance` mm."""
    kappa = circle_curvature(scope.link, scope.links, beta)
    stretch = 1.0 / math.cos(0.5 * beta / scope.links)
    done = 0.0
    while True:
        move_base(state, scope.link, kappa, done, alpha, scratch)
        gap = clearance_beyond(lumen, scope.radius, scratch[9], scratch[10], scratch[11])
        if gap < MIN_GAP_MM:
            return False
        if done >= distance:
            return True
        done = min(done + gap / stretch, distance)


@inlined_kernel
def passes_printed_rule(lumen, scope, joints):
    """Tell whether no link collides by eq. 1, which looks at the centres of its spheres alone."""
    for k in range(scope.links + 1):
        voxel = voxel_of(lumen, joints[k, 0], joints[k, 1], joints[k, 2])
        if voxel < 0 or lumen.steps_to_wall[voxel] <= scope.printed_limit:
            return False
    return True


@inlined_kernel
def body_fits(lumen, scope, state, alpha, beta, joints):
    """Fill `joints` and tell whether the links are free, by the rule of the scope."""
    joints_of(state, scope.link, scope.links, alpha, beta, joints)
    if scope.radius > 0.0:
        return chain_fits(lumen, scope, joints)
    return passes_printed_rule(lumen, scope, joints)


@kernel()
def measure(lumen, scope, states, fits, clearances):
    """Fill for states (M, 14) whether the links fit, and the sum of clearances of links and tip (IV-D)."""
    joints = np.zeros((scope.links + 1, 3))
    for m in range(states.shape[0]):
        fits[m] = body_fits(lumen, scope, states[m], states[m, 12], states[m, 13], joints)
        total = 0.0
        for k in range(scope.links + 1):
            voxel = voxel_of(lumen, joints[k, 0], joints[k, 1], joints[k, 2])
            if voxel >= 0:
                total += lumen.steps_to_wall[voxel] * (2.0 if k == 0 else 1.0)
        clearances[m] = total
