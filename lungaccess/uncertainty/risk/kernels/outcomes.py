"""Compiled kernel of the risk: what becomes of many deviated plans, each in one pass."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from anatomy.base.typed import Bool, Float, UInt8, UInt16
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


class Wanted(NamedTuple):
    """What has to be in the tool in the end.

    Parameters
    ----------
    points : (K, 3) float64
        Of the tool, in the frame of the last tip, +z ahead; one at its origin where the tip itself counts.
    weight : float
        What each of them stands for, in the unit of `least`.
    tissue : (X, Y, Z) uint8
        1 in the nodule; empty where the nodule is a ball about the target.
    geometry : (3, 4) float64
        From LPS mm to voxels of it, of which number i spans i to i + 1.
    within, beyond : float
        Radii in mm between which the ball counts.
    least : float
    """

    points: Float
    weight: float
    tissue: UInt8
    geometry: Float
    within: float
    beyond: float
    least: float


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
def _miss(target, errors, n, end):
    """Return how far a chain ends from the deviated target, mm."""
    dx = end[0] - target[0] - errors[n, TARGET]
    dy = end[1] - target[1] - errors[n, TARGET + 1]
    dz = end[2] - target[2] - errors[n, TARGET + 2]
    return math.sqrt(dx * dx + dy * dy + dz * dz)


@borrowing_kernel
def _is_nodule(wanted, target, x, y, z):
    """Tell whether a point is tissue of the nodule that counts."""
    if wanted.tissue.shape[0] == 0:
        dx, dy, dz = x - target[0], y - target[1], z - target[2]
        far = math.sqrt(dx * dx + dy * dy + dz * dz)
        return wanted.beyond <= far <= wanted.within
    g, (ni, nj, nk) = wanted.geometry, wanted.tissue.shape
    u = g[0, 0] * x + g[0, 1] * y + g[0, 2] * z + g[0, 3]
    v = g[1, 0] * x + g[1, 1] * y + g[1, 2] * z + g[1, 3]
    w = g[2, 0] * x + g[2, 1] * y + g[2, 2] * z + g[2, 3]
    if not (0.0 <= u < ni and 0.0 <= v < nj and 0.0 <= w < nk):
        return False
    return wanted.tissue[int(u), int(v), int(w)] != 0


@borrowing_kernel
def _in_tool(wanted, target, dx, dy, dz, end):
    """Return how much of a nodule that lies `(dx, dy, dz)` off is in the tool at an end of a chain."""
    x, y, z, tx, ty, tz, nx, ny, nz = end
    bx, by, bz = ty * nz - tz * ny, tz * nx - tx * nz, tx * ny - ty * nx
    x, y, z, found = x - dx, y - dy, z - dz, 0
    for k in range(wanted.points.shape[0]):
        a, b, c = wanted.points[k, 0], wanted.points[k, 1], wanted.points[k, 2]
        px, py, pz = (
            x + a * nx + b * bx + c * tx,
            y + a * ny + b * by + c * ty,
            z + a * nz + b * bz + c * tz,
        )
        found += _is_nodule(wanted, target, px, py, pz)
    return found * wanted.weight


@borrowing_kernel
def _taken(wanted, target, errors, n, end):
    """Return how much of the deviated nodule is in the tool."""
    return _in_tool(wanted, target, errors[n, TARGET], errors[n, TARGET + 1], errors[n, TARGET + 2], end)


@borrowing_kernel
def _touched(obstacles, judging, start, pieces, n_tube, enough):
    """Return what a chain touches, see `deviation.follow`."""
    lumen = (judging.depth, judging.geometry)
    return follow(obstacles, lumen, judging.mediastinal, start, pieces, n_tube, judging.exempt_mm, enough)


@kernel(nogil=True)
def find_successes(devices, errors, which, obstacles, judging, wanted, forbidden, first, done):
    """Tell which deviated plans end with enough of the nodule in the tool and touch nothing forbidden.

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
    wanted : Wanted
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
        done[m] = _taken(wanted, target, errors, first + m, find_end(start, pieces)) >= wanted.least
        if done[m]:
            done[m] = _touched(obstacles, judging, start, pieces, devices.n_tube, forbidden) & forbidden == 0


@kernel(nogil=True)
def find_outcomes(devices, errors, which, obstacles, judging, wanted, first, touched, miss_mm, taken):
    """Note all that deviated plans touch, `(N,)` flags, how far they miss, `(N,)` mm, and what they take.

    The parameters are those of `find_successes`.
    """
    target = judging.target
    start, pieces = np.zeros(N_START), np.zeros((devices.n_tube + devices.needle.shape[0], N_PIECE))
    for m in range(touched.shape[0]):
        _set_start(devices, judging, errors, first + m, start)
        _set_pieces(devices, errors, which, first + m, pieces)
        end = find_end(start, pieces)
        miss_mm[m] = _miss(target, errors, first + m, end)
        taken[m] = _taken(wanted, target, errors, first + m, end)
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
def follow_chains(starts, pieces, n_tube, obstacles, judging, wanted, target_mm, touched, ends, taken):
    """Note what chains touch, `(N,)` flags, where they end, `(N, 3)`, and how much of the nodule they take.

    `target_mm` `(N, 3)` says how far the nodule lies from where it was planned; see `deviation.follow`.
    """
    for n in range(starts.shape[0]):
        touched[n] = _touched(obstacles, judging, starts[n], pieces[n], n_tube, 0)
        end = find_end(starts[n], pieces[n])
        ends[n, 0], ends[n, 1], ends[n, 2] = end[0], end[1], end[2]
        dx, dy, dz = target_mm[n, 0], target_mm[n, 1], target_mm[n, 2]
        taken[n] = _in_tool(wanted, judging.target, dx, dy, dz, end)
