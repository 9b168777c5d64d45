"""Compiled kernels of the coupled search: local search from one choice, and local sampling around many.

The needle stage has a local search of its own (`stages.needle.search.kernels.optimal.refine`).  There the
start is fixed, a via point may be reached by an arc and a straight line, and points are drawn from balls.
Here scope pose, tubes and via points change together, by normal distributions of one common spread, and all
legs are single arcs.

The arguments are those of `lungaccess.planning.coupled.kernels.candidate`.
"""

import math

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from anatomy.kernels.random import uniform
from lungaccess.planning.coupled.kernels.candidate import INSERTED, ROTATION, SCOPE_POSE, validated_cost
from stages.tube.kernels import N_TRACE, take_member, take_over

MAX_VIAS = 5
"""Size of the arrays of via points: a path of the local search has at most one arc more."""
SCOPE_POSE_SPREAD = 8.0
ROTATION_SPREAD_RAD = 0.14
RELATIVE_SPREAD_RAD = 0.28
INSERTION_SPREAD_MM = 1.5
VIA_SPREAD_MM = 3.0
"""The largest standard deviations of a change.  The poses of a scope lie 0.25 mm of its motion apart."""
SMALLEST_SPREAD = 0.005
"""The smallest standard deviation as a share of the largest: a change of about 0.01 mm."""
ADD_SHARE = 0.12
DROP_SHARE = 0.16
"""Below the first share of all changes a via point is added, between both one is left out."""
TUBES_ONLY = 0.3
NEEDLE_ONLY = 0.6
"""Below the first share of the other changes only the tubes are changed, between both only the needle."""
OTHER_SHAPE = 0.05
"""This share of the samples takes another shape of tubes that twist each other, which is slow to compute."""
EACH_SHARE = 0.6
"""The probability with which each number is changed, so that most changes leave some numbers as they are."""


@inner_kernel
def _normal(state):
    """Return a standard normal number."""
    radius = math.sqrt(-2.0 * math.log(1.0 - uniform(state)))
    return radius * math.cos(2.0 * math.pi * uniform(state))


@merged_kernel
def _add_via(vias, count, start, target, spread, state):
    """Put a via point near a chord of the path from the tube's tip `start`, and return how many there are."""
    at = min(int(uniform(state) * (count + 1)), count)
    share = 0.2 + 0.6 * uniform(state)
    for m in range(count, at, -1):
        vias[m] = vias[m - 1]
    for axis in range(3):
        before = start[axis] if at == 0 else vias[at - 1, axis]
        behind = target[axis] if at == count else vias[at + 1, axis]
        vias[at, axis] = before + share * (behind - before) + spread * VIA_SPREAD_MM * _normal(state)
    return count + 1


@inner_kernel
def _vary_tubes(design, x, spread, state):
    """Change rotation and insertions, and how the tubes are turned beside it where that changes the shape."""
    n = design.radii.shape[0]
    if uniform(state) < EACH_SHARE:
        x[ROTATION] += ROTATION_SPREAD_RAD * spread * _normal(state)
    for m in range(INSERTED, INSERTED + n):
        if uniform(state) < EACH_SHARE:
            x[m] += INSERTION_SPREAD_MM * spread * _normal(state)
    x[INSERTED] = max(x[INSERTED], 0.0)
    for m in range(INSERTED + n - 2, INSERTED - 1, -1):
        x[m] = min(x[m], x[m + 1])
    for i in range(n):
        if design.turned[i] and uniform(state) < EACH_SHARE:
            x[INSERTED + 2 * n - 1 - i] += RELATIVE_SPREAD_RAD * spread * _normal(state)


@merged_kernel
def _vary(design, x, vias, count, start, target, state):
    """Change a choice at random, by spreads from small to large; return how many vias it then has."""
    spread = math.exp(math.log(SMALLEST_SPREAD) * uniform(state))
    change = uniform(state)
    if change < ADD_SHARE and count < MAX_VIAS:
        return _add_via(vias, count, start, target, spread, state)
    if ADD_SHARE <= change < DROP_SHARE and count > 0:
        gone = min(int(uniform(state) * count), count - 1)
        for m in range(gone, count - 1):
            vias[m] = vias[m + 1]
        return count - 1
    which = uniform(state) if count > 0 else 0.0
    if not TUBES_ONLY <= which < NEEDLE_ONLY:
        if uniform(state) < EACH_SHARE:
            x[SCOPE_POSE] = round(x[SCOPE_POSE] + SCOPE_POSE_SPREAD * spread * _normal(state))
        _vary_tubes(design, x, spread, state)
    if which >= TUBES_ONLY:
        for m in range(count):
            if uniform(state) < EACH_SHARE:
                for axis in range(3):
                    vias[m, axis] += VIA_SPREAD_MM * spread * _normal(state)
    return count


@kernel(nogil=True)
def improve(tube, needle, scope_poses, allowed, x, vias, count, target, tries, state):
    """Improve a choice by a stochastic local search: vary it at random and keep what is cheaper.

    A choice is kept only if it is proved: the tubes by their whole way and `validate_arcs`, the needle by
    `blocker_on_arc`.  The shape nearby in `tube` becomes that of the choice.  So many variations are tried.

    Args:
        scope_poses, allowed ((K, 9) float64, (K,) bool): Scope tips, and which of them the scope can take.
        x, vias ((c,) and (MAX_VIAS, 3) float64): Both receive the best choice.
        count (int): Number of vias in use.
        state ((1,) uint64): State of the random numbers.

    Returns:
        - count (int) - Number of vias of the best choice.
        - cost (float) - Its estimated cost; infinite if the choice given was refused, and all others too.
    """
    _environment, _constants, design, near, shape = tube
    trace = np.zeros(N_TRACE)
    tip = np.zeros(9)
    start = np.zeros(3)
    cost = validated_cost(tube, needle, scope_poses, allowed, x, vias, count, target, math.inf, trace, tip)
    if cost < math.inf:
        take_over(near, shape)
    start[:] = tip[:3]
    new_x = x.copy()
    new_vias = vias.copy()
    for _ in range(tries):
        new_x[:] = x
        for m in range(count):
            new_vias[m] = vias[m]
        new_count = _vary(design, new_x, new_vias, count, start, target, state)
        new_cost = validated_cost(
            tube, needle, scope_poses, allowed, new_x, new_vias, new_count, target, cost, trace, tip
        )
        if new_cost < cost:
            cost = new_cost
            count = new_count
            start[:] = tip[:3]
            x[:] = new_x
            take_over(near, shape)
            for m in range(count):
                vias[m] = new_vias[m]
    return count, cost


@inner_kernel
def _draw(design, near, shapes, row, rotation, spreads, x, state):
    """Draw a choice near a deployment with a rotation, and near its shape."""
    x[ROTATION] = rotation + spreads[0] * (2.0 * uniform(state) - 1.0)
    n = design.radii.shape[0]
    take_member(near, shapes, row)
    for m in range(2 * n):
        x[INSERTED + m] = near.joints[n - 1 - m if m < n else 3 * n - 1 - m]
    if design.turned.any() and uniform(state) >= OTHER_SHAPE:
        return
    for m in range(n):
        x[INSERTED + m] = max(x[INSERTED + m] + spreads[1] * (2.0 * uniform(state) - 1.0), 0.0)
        if m > 0:
            x[INSERTED + m] = max(x[INSERTED + m], x[INSERTED + m - 1])
        if design.turned[n - 1 - m]:
            x[INSERTED + n + m] += spreads[0] * (2.0 * uniform(state) - 1.0)


@kernel(nogil=True)
def sample_deployments(
    tube,
    needle,
    scope_poses,
    pose_of,
    rotations,
    shapes,
    spreads,
    target,
    tries,
    cost_limit,
    state,
    best,
    best_shape,
):
    """Sample deployments near given ones, each with a single arc to the target, and keep the cheapest.

    Args:
        scope_poses ((K, 9) float64): Poses that the scope can take.
        pose_of, rotations, shapes ((N,) int64, (N,) float64, ManyShapes): Of each deployment.
        spreads ((2,) float64): The largest change of rotations in rad and of insertions in mm.
        cost_limit (float): Choices that cost as much or more are dropped.
        state ((1,) uint64): State of the random numbers.
        best, best_shape ((c,) float64, ShapeArrays): Receive the cheapest choice and its shape.

    Returns:
        float: Its estimated cost, or `cost_limit` if there is none.
    """
    _environment, _constants, design, near, shape = tube
    trace = np.zeros(N_TRACE)
    tip = np.zeros(9)
    x = np.zeros(best.shape[0])
    vias = np.zeros((MAX_VIAS, 3))
    allowed = np.ones(scope_poses.shape[0], dtype=np.bool_)
    none = np.int64(0)
    for _ in range(tries):
        n = min(int(uniform(state) * pose_of.shape[0]), pose_of.shape[0] - 1)
        x[SCOPE_POSE] = pose_of[n]
        _draw(design, near, shapes, n, rotations[n], spreads, x, state)
        cost = validated_cost(
            tube, needle, scope_poses, allowed, x, vias, none, target, cost_limit, trace, tip
        )
        if cost < cost_limit:
            cost_limit = cost
            best[:] = x
            take_over(best_shape, shape)
    return cost_limit
