"""Compiled kernel of the risk: what becomes of many deviated plans, each in one pass."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from anatomy.base.typed import Bool, Float, UInt16
from anatomy.kernels.compiling import borrowing_kernel, kernel
from lungaccess.uncertainty.risk.kernels.chain import (
    ROTATION,
    TARGET,
    find_end,
    set_needle,
    set_planar,
    set_start,
    set_twisted,
)
from lungaccess.uncertainty.risk.kernels.deviation import N_PIECE, follow

N_START = 9


class Judging(NamedTuple):
    """What decides about a deviated plan beside its obstacles, see `deviation.follow`.

    Parameters
    ----------
    depth, geometry
        Depth of the lumen.
    least_depth_mm : float
        The scope tip stands where the lumen is at least so deep.
    mediastinal : (B,) bool
    exempt_mm : float
    target : (3,) float64, LPS mm
    """

    depth: UInt16
    geometry: Float
    least_depth_mm: float
    mediastinal: Bool
    exempt_mm: float
    target: Float


@borrowing_kernel
def _set_start(devices, judging, errors, n, start):
    """Fill the start of deviated plan `n`."""
    set_start(devices.frame, judging.depth, judging.geometry, judging.least_depth_mm, errors, n, start)


@borrowing_kernel
def _set_pieces(devices, errors, which, n, pieces):
    """Fill the pieces of deviated plan `n`."""
    rolled = errors[n, ROTATION]
    if devices.shapes.shape[0] == 0:
        set_planar(devices.tubes, errors, n, pieces)
    else:
        set_twisted(devices.shapes, which[n], rolled, pieces)
        rolled += devices.rolled_rad[which[n]]
    set_needle(devices.needle, devices.max_needle_mm, devices.n_tube, rolled, errors, n, pieces)


@borrowing_kernel
def _miss(target, errors, n, start, pieces):
    """Return how far a chain ends from the deviated target, mm."""
    end = find_end(start, pieces)
    dx = end[0] - target[0] - errors[n, TARGET]
    dy = end[1] - target[1] - errors[n, TARGET + 1]
    dz = end[2] - target[2] - errors[n, TARGET + 2]
    return math.sqrt(dx * dx + dy * dy + dz * dz)


@borrowing_kernel
def _touched(obstacles, judging, start, pieces, n_tube, enough):
    """Return what a chain touches, see `deviation.follow`."""
    lumen = (judging.depth, judging.geometry)
    return follow(obstacles, lumen, judging.mediastinal, start, pieces, n_tube, judging.exempt_mm, enough)


@kernel(nogil=True)
def find_successes(devices, errors, which, obstacles, judging, radius_mm, forbidden, first, done):
    """Tell which deviated plans end within a radius of the target and touch nothing forbidden.

    Parameters
    ----------
    devices : Devices
    errors : (M, E) float64
        See `chain`.
    which : (M,) int64
        The shape of each draw, see `Devices`.
    obstacles : Obstacles
        All structures, see `deviation.follow`.
    judging : Judging
    forbidden : int
        Flags of what must not be touched.
    first : int
        Number of the first deviated plan; as many are judged as there is room in `done`.
    done : (N,) bool
    """
    target = judging.target
    start, pieces = np.zeros(N_START), np.zeros((devices.n_tube + devices.needle.shape[0], N_PIECE))
    for m in range(done.shape[0]):
        _set_start(devices, judging, errors, first + m, start)
        _set_pieces(devices, errors, which, first + m, pieces)
        done[m] = _miss(target, errors, first + m, start, pieces) <= radius_mm
        if done[m]:
            done[m] = _touched(obstacles, judging, start, pieces, devices.n_tube, forbidden) & forbidden == 0


@kernel(nogil=True)
def find_outcomes(devices, errors, which, obstacles, judging, first, touched, miss_mm):
    """Note all that deviated plans touch, `(N,)` flags, and how far they miss, `(N,)` mm.

    The parameters are those of `find_successes`.
    """
    target = judging.target
    start, pieces = np.zeros(N_START), np.zeros((devices.n_tube + devices.needle.shape[0], N_PIECE))
    for m in range(touched.shape[0]):
        _set_start(devices, judging, errors, first + m, start)
        _set_pieces(devices, errors, which, first + m, pieces)
        miss_mm[m] = _miss(target, errors, first + m, start, pieces)
        touched[m] = _touched(obstacles, judging, start, pieces, devices.n_tube, 0)


@kernel(nogil=True)
def find_starts(devices, errors, judging, starts):
    """Fill the starts `(N, 9)` of deviated plans, see `deviation`."""
    for n in range(starts.shape[0]):
        _set_start(devices, judging, errors, n, starts[n])


@kernel(nogil=True)
def find_pieces(devices, errors, which, pieces):
    """Fill the pieces `(N, P, 4)` of deviated plans, see `deviation`."""
    for n in range(pieces.shape[0]):
        _set_pieces(devices, errors, which, n, pieces[n])


@kernel(nogil=True)
def follow_chains(starts, pieces, n_tube, obstacles, judging, touched, ends):
    """Note what chains touch, `(N,)` flags, and where they end, `(N, 3)`; see `deviation.follow`."""
    for n in range(starts.shape[0]):
        touched[n] = _touched(obstacles, judging, starts[n], pieces[n], n_tube, 0)
        ends[n, 0], ends[n, 1], ends[n, 2] = find_end(starts[n], pieces[n])
