"""Compiled kernel of the search without a needle: it aims tubes at a target, validates and costs them.

`tube` is that of `lungaccess.planning.coupled.kernels.candidate`.
"""

from __future__ import annotations

import math

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from lungaccess.planning.coupled.kernels.candidate import why_refused
from stages.needle.kernels import cost_of_arc
from stages.tube.kernels import (
    ACCEPTED,
    CLOSE_MM,
    LEFT_AT,
    N_TRACE,
    WALL_RUN,
    aim,
    aim_shape,
    bend_towards,
    carried,
    take_member,
    tube_pieces,
)

ROTATION, OUTER, INNER, COST, JOINTS = range(5)
"""Columns of what is found; tubes that are not planar have all their joints from JOINTS on."""
MISSES = -1
"""Stands for a reason where no insertions bring the tip to the target."""
SPOILT_WAY = -3
"""Stands for a reason where the tubes would snap, sweep or be strained too much on their way there."""
TIP_OFF_MM = 5e-7
"""So far from the target may a tip be after its whole way was followed: half of what a proof allows."""
NOT_TRIED = -2
"""Stands for a reason where the scope cannot take the tip, or enough were found before."""
COST_STEP_MM = 0.5
"""Step of estimated integrals: about a voxel, since clearance changes by no more than one moves."""


@inner_kernel
def _cost_beyond(obstacles, objective, base, normal, pieces, begin):
    """Return the weighted cost of the pieces of tubes from an arc length on."""
    pose = (base[0], base[1], base[2], base[3], base[4], base[5])
    across = normal
    total = 0.0
    first = True
    for start, stop, direction, kappa in pieces:
        if stop <= start:
            continue
        skipped = min(max(begin - start, 0.0), stop - start)
        for length, counts in ((skipped, False), (stop - start - skipped, True)):
            if length <= 0.0:
                continue
            bend = bend_towards(pose, across, direction, kappa)
            if counts:
                total += cost_of_arc(obstacles, objective, COST_STEP_MM, pose, bend, length, first)
                first = False
            pose, across = carried(pose, across, bend, direction, length)
    return total


@merged_kernel
def _pieces_of(constants, outer, inner, shape):
    """Return begin, end, direction and curvature of each piece of tubes `(P, 4)`."""
    if shape.number[0] > 0:
        pieces, at = np.zeros((shape.number[0], 4)), 0.0
        for m in range(shape.number[0]):
            length, direction, kappa, _radius = shape.arcs[m]
            pieces[m] = np.array([at, at + length, direction, kappa])
            at += length
        return pieces
    pieces = np.zeros((4, 4))
    for m, (start, stop, kappa, _radius) in enumerate(tube_pieces(constants, outer, inner)):
        pieces[m] = np.array([start, stop, 0.0, kappa])
    return pieces


@inner_kernel
def _aimed(constants, design, near, shape, shapes, n, base, target, outer, inner, joints):
    """Return ACCEPTED or why the tubes miss the target, rotation and insertions; fill `joints`."""
    if design is None:
        rotation, outer, inner, miss = aim(constants, base, target, outer, inner)
        return ACCEPTED if miss <= CLOSE_MM else MISSES, rotation, outer, inner
    take_member(near, shapes, n)
    rotation, miss, kept = aim_shape(design, near, shape, base, target)
    if not miss <= TIP_OFF_MM:
        return MISSES, rotation, outer, inner
    if not kept:
        return SPOILT_WAY, rotation, outer, inner
    joints[:] = shape.joints
    return ACCEPTED, rotation, shape.joints[design.lengths.shape[0] - 1], shape.joints[0]


@kernel(nogil=True)
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
    shapes,
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
    shapes : ManyShapes
        The shapes from which they begin instead where tubes are not planar.
    target : tuple of 3 floats
    enough : int
        So many deployments end the attempts.
    found : (N, JOINTS + 2 n) float64
        Receives rotation, insertions and estimated cost; the cost is infinite where the tubes are refused.
    why : (N,) int64
        Receives ACCEPTED, MISSES, SPOILT_WAY, NOT_TRIED, or the reason of `stages.tube.kernels`.
    """
    environment, constants, design, near, shape = tube
    trace = np.zeros(N_TRACE)
    tip = np.zeros(9)
    for n in range(pose_of.shape[0]):
        base = scope_poses[pose_of[n]]
        found[n, COST] = math.inf
        why[n] = NOT_TRIED
        if enough <= 0 or not allowed[pose_of[n]]:
            continue
        why[n], rotation, outer, inner = _aimed(
            constants, design, near, shape, shapes, n, base, target, outers[n], inners[n], found[n, JOINTS:]
        )
        if why[n] != ACCEPTED:
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
        towards = np.array(normal)
        reason = why_refused(
            environment, constants, design, shape, base[:6], towards, outer, inner, trace, tip
        )
        why[n] = reason
        if reason != ACCEPTED:
            continue
        left_at = trace[LEFT_AT]
        pieces = _pieces_of(constants, outer, inner, shape)
        cost = _cost_beyond(obstacles, weights, base, normal, pieces, left_at)
        if map_weights.map_integral > 0.0 or map_weights.voxel_sum > 0.0:
            behind = left_at + trace[WALL_RUN]
            cost += _cost_beyond(obstacles, map_weights, base, normal, pieces, behind)
        found[n, COST] = cost
        enough -= 1
