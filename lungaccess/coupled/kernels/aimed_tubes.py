"""Compiled kernel of the search without a needle: it aims tubes at a target, validates and costs them.

`tube` is the tuple (environment, constants) of `stages.tube.kernels`.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from anatomy.kernels.arcs import normal_on_arc, pose_on_arc
from anatomy.kernels.compiling import inner_kernel
from stages.needle.kernels import cost_of_arc
from stages.tube.kernels import (
    ACCEPTED,
    CLOSE_MM,
    LEFT_AT,
    N_TRACE,
    WALL_RUN,
    aim,
    tube_pieces,
    validate_deployment,
)

ROTATION, OUTER, INNER, COST, N_AIMED = range(5)
"""Columns of what is found."""
MISSES = -1
"""Stands for a reason where no insertions bring the tip to the target."""
NOT_TRIED = -2
"""Stands for a reason where the scope cannot take the tip, or enough were found before."""
COST_STEP_MM = 0.5
"""Step of estimated integrals: about a voxel, since clearance changes by no more than one moves."""


@inner_kernel
def _cost_beyond(obstacles, objective, constants, base, normal, outer, inner, begin):
    """Return the weighted cost of the tubes' arcs from an arc length on."""
    pose = (base[0], base[1], base[2], base[3], base[4], base[5])
    towards = normal
    total = 0.0
    first = True
    for start, stop, kappa, _radius in tube_pieces(constants, outer, inner):
        if stop <= start:
            continue
        skipped = min(max(begin - start, 0.0), stop - start)
        for length, counts in ((skipped, False), (stop - start - skipped, True)):
            if length <= 0.0:
                continue
            bend = (kappa, towards[0], towards[1], towards[2])
            if counts:
                total += cost_of_arc(obstacles, objective, COST_STEP_MM, pose, bend, length, first)
                first = False
            towards = normal_on_arc(pose, bend, length)
            pose = pose_on_arc(pose, bend, length)
    return total


@numba.njit(cache=True, nogil=True)
def aim_tubes(
    tube,
    obstacles,
    weights,
    map_weights,
    scope_poses,
    allowed,
    pose_of,
    outers,
    inners,
    target,
    enough,
    found,
    why,
):
    """Aim the tubes at a target from many scope tips, and validate and cost what hits it.

    Parameters
    ----------
    obstacles : Obstacles
    weights, map_weights : ObjectiveArrays
        The objective without its costs of the map, which count from the exit on, and with these alone, which
        count beyond the wall that the tubes pierce.
    scope_poses : (K, 9) float64
    allowed : (K,) bool
        Which of these poses the scope can take.
    pose_of : (N,) int64
        The row of `scope_poses` of each attempt.
    outers, inners : (N,) float64
        Insertions from which each begins, mm.
    target : tuple of 3 floats
    enough : int
        So many deployments end the attempts.
    found : (N, N_AIMED) float64
        Receives rotation, insertions and estimated cost; the cost is infinite where the tubes are refused.
    why : (N,) int64
        Receives ACCEPTED, MISSES, NOT_TRIED, or the reason of `stages.tube.kernels`.
    """
    environment, constants = tube
    trace = np.zeros(N_TRACE)
    tip = np.zeros(9)
    for n in range(pose_of.shape[0]):
        base = scope_poses[pose_of[n]]
        found[n, COST] = math.inf
        why[n] = NOT_TRIED
        if enough <= 0 or not allowed[pose_of[n]]:
            continue
        why[n] = MISSES
        rotation, outer, inner, miss = aim(constants, base, target, outers[n], inners[n])
        if not miss <= CLOSE_MM:
            continue
        c, s = math.cos(rotation), math.sin(rotation)
        normal = (
            c * base[6] + s * (base[4] * base[8] - base[5] * base[7]),
            c * base[7] + s * (base[5] * base[6] - base[3] * base[8]),
            c * base[8] + s * (base[3] * base[7] - base[4] * base[6]),
        )
        found[n, ROTATION] = rotation
        found[n, OUTER] = outer
        found[n, INNER] = inner
        reason = validate_deployment(
            environment, constants, base[:6], np.array(normal), outer, inner, trace, tip
        )
        why[n] = reason
        if reason != ACCEPTED:
            continue
        left_at = trace[LEFT_AT]
        cost = _cost_beyond(obstacles, weights, constants, base, normal, outer, inner, left_at)
        if map_weights.map_integral > 0.0 or map_weights.voxel_sum > 0.0:
            behind = left_at + trace[WALL_RUN]
            cost += _cost_beyond(obstacles, map_weights, constants, base, normal, outer, inner, behind)
        found[n, COST] = cost
        enough -= 1
