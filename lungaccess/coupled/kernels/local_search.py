"""Compiled kernels of the coupled search: random choices and changes, of which what is cheaper is kept.

Arguments are those of `lungaccess.coupled.kernels.candidate`.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from anatomy.kernels.compiling import inner_kernel
from anatomy.kernels.random import uniform
from lungaccess.coupled.kernels.candidate import INNER, N_CHOICE, OUTER, ROTATION, STAND, judged_cost
from stages.tube.kernels import N_TRACE

MAX_VIAS = 5
STAND_SPREAD = 8.0
ROTATION_SPREAD_RAD = 0.14
INSERTION_SPREAD_MM = 1.5
VIA_SPREAD_MM = 3.0
"""Largest spreads of what is changed."""
SMALLEST_SPREAD = 0.005
"""Smallest, as a share of them."""
ADD_SHARE = 0.12
DROP_SHARE = 0.16
"""Up to these shares of all changes a via point is added, or left out."""
TUBES_ONLY = 0.3
NEEDLE_ONLY = 0.6
"""Below and between these shares of the other changes only tubes or needle are changed."""
EACH_SHARE = 0.6
"""Share of the numbers that are changed at a time."""


@inner_kernel
def _normal(state):
    """Return a standard normal number."""
    radius = math.sqrt(-2.0 * math.log(1.0 - uniform(state)))
    return radius * math.cos(2.0 * math.pi * uniform(state))


@inner_kernel
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
def _vary(x, vias, count, start, target, state):
    """Change a choice at random, a little or much; return how many vias it has."""
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
            x[STAND] = round(x[STAND] + STAND_SPREAD * spread * _normal(state))
        if uniform(state) < EACH_SHARE:
            x[ROTATION] += ROTATION_SPREAD_RAD * spread * _normal(state)
        if uniform(state) < EACH_SHARE:
            x[OUTER] = max(x[OUTER] + INSERTION_SPREAD_MM * spread * _normal(state), 0.0)
        if uniform(state) < EACH_SHARE:
            x[INNER] += INSERTION_SPREAD_MM * spread * _normal(state)
        x[OUTER] = min(x[OUTER], x[INNER])
    if which >= TUBES_ONLY:
        for m in range(count):
            if uniform(state) < EACH_SHARE:
                for axis in range(3):
                    vias[m, axis] += VIA_SPREAD_MM * spread * _normal(state)
    return count


@numba.njit(cache=True, nogil=True)
def climb(tube, needle, stands, allowed, x, vias, count, target, tries, state):
    """Vary a choice at random and keep what is cheaper.

    Only what is proved is kept: the tubes by `deploy`, the needle by `blocker_on_arc`, both as in any plan.

    Parameters
    ----------
    stands : (K, 9) float64
    allowed : (K,) bool
        Where the scope can stand.
    x : (4,) float64
    vias : (MAX_VIAS, 3) float64
        Both receive the best choice.
    count : int
        Number of vias in use.
    target : tuple of 3 floats
    tries : int
    state : (1,) uint64
        Of the random numbers.

    Returns
    -------
    count : int
    cost : float
        Estimated; infinite if the choice given was refused, and all others too.
    """
    trace = np.zeros(N_TRACE)
    tip = np.zeros(9)
    start = np.zeros(3)
    cost = judged_cost(tube, needle, stands, allowed, x, vias, count, target, math.inf, trace, tip)
    start[:] = tip[:3]
    new_x = x.copy()
    new_vias = vias.copy()
    for _ in range(tries):
        for m in range(N_CHOICE):
            new_x[m] = x[m]
        for m in range(count):
            new_vias[m] = vias[m]
        new_count = _vary(new_x, new_vias, count, start, target, state)
        new_cost = judged_cost(
            tube, needle, stands, allowed, new_x, new_vias, new_count, target, cost, trace, tip
        )
        if new_cost < cost:
            cost = new_cost
            count = new_count
            start[:] = tip[:3]
            for m in range(N_CHOICE):
                x[m] = new_x[m]
            for m in range(count):
                vias[m] = new_vias[m]
    return count, cost


@numba.njit(cache=True, nogil=True)
def scatter(
    tube, needle, rows, row_of, rotations, outers, inners, spreads, target, tries, dearest, state, best
):
    """Vary random deployments a little, each with a single arc to the target, and keep the cheapest.

    Parameters
    ----------
    rows : (K, 9) float64
        Where the scope can stand.
    row_of : (N,) int64
        The place of each deployment among them.
    rotations, outers, inners : (N,) float64
        The deployments: rad, mm, mm.
    spreads : (2,) float64
        They are varied by up to so much, in rad and mm.
    target : tuple of 3 floats
    tries : int
    dearest : float
        What costs as much or more is of no interest.
    state : (1,) uint64
        Of the random numbers.
    best : (4,) float64
        Receives the cheapest choice.

    Returns
    -------
    float
        Its estimated cost, or `dearest` if there is none.
    """
    trace = np.zeros(N_TRACE)
    tip = np.zeros(9)
    x = np.zeros(N_CHOICE)
    vias = np.zeros((MAX_VIAS, 3))
    allowed = np.ones(rows.shape[0], dtype=np.bool_)
    none = np.int64(0)
    for _ in range(tries):
        n = min(int(uniform(state) * row_of.shape[0]), row_of.shape[0] - 1)
        x[STAND] = row_of[n]
        x[ROTATION] = rotations[n] + spreads[0] * (2.0 * uniform(state) - 1.0)
        x[OUTER] = max(outers[n] + spreads[1] * (2.0 * uniform(state) - 1.0), 0.0)
        x[INNER] = max(inners[n] + spreads[1] * (2.0 * uniform(state) - 1.0), x[OUTER])
        cost = judged_cost(tube, needle, rows, allowed, x, vias, none, target, dearest, trace, tip)
        if cost < dearest:
            dearest = cost
            for m in range(N_CHOICE):
                best[m] = x[m]
    return dearest
