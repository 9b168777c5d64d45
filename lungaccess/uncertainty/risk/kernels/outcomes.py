"""Compiled kernel of the risk: what becomes of many deviated plans, each in one pass."""

from typing import NamedTuple

import numpy as np

from anatomy.base.typed import Bool, Float, UInt16
from anatomy.kernels.compiling import borrowing_kernel, kernel
from lungaccess.plans.kernels.tissue import miss_of, tissue_taken
from lungaccess.uncertainty.risk.kernels.chain import (
    BORDER,
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

    Args:
        depth, geometry: Depth of the lumen.
        least_depth_mm: The scope tip stands where the lumen is at least so deep.
        mediastinal: (B,) bool.
    """

    depth: UInt16
    geometry: Float
    least_depth_mm: float
    mediastinal: Bool
    exempt_mm: float


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
def _shift(errors, n):
    """Return how far the target of deviated plan `n` has moved, mm."""
    return errors[n, TARGET], errors[n, TARGET + 1], errors[n, TARGET + 2]


@borrowing_kernel
def _touched(obstacles, judging, start, pieces, n_tube, enough, border_mm):
    """Return what a chain touches, see `deviation.follow`."""
    lumen = (judging.depth, judging.geometry)
    return follow(
        obstacles, lumen, judging.mediastinal, start, pieces, n_tube, judging.exempt_mm, enough, border_mm
    )


@kernel(nogil=True)
def find_taken(devices, errors, which, judging, wanted, first, taken):
    """Note how much of the nodule is in the tool of deviated plans, whatever they touch.

    Args:
        devices: Devices.
        errors ((M, E) float64): See `chain`.
        which ((M,) int64): The shape of each draw, see `Devices`.
        judging: Judging.
        wanted (Wanted): See `lungaccess.plans.kernels.tissue`.
        first (int): Number of the first deviated plan; as many are followed as there is room in `taken`.
        taken: (N,) float64.
    """
    start, pieces = np.zeros(N_START), np.zeros((devices.n_tube + devices.needle.shape[0], N_PIECE))
    for m in range(taken.shape[0]):
        _set_start(devices, judging, errors, first + m, start)
        _set_pieces(devices, errors, which, first + m, pieces)
        taken[m] = tissue_taken(wanted, _shift(errors, first + m), find_end(start, pieces))


@kernel(nogil=True)
def keep_clear(devices, errors, which, judging, obstacles, forbidden, first, done):
    """Keep of deviated plans that are done those that touch nothing forbidden.

    Args:
        obstacles (Obstacles): All structures, see `deviation.follow`.
        forbidden (int): Flags of what must not be touched; the first one ends the search for more.
        done: (N,) bool.

    The others are those of `find_taken`.
    """
    start, pieces = np.zeros(N_START), np.zeros((devices.n_tube + devices.needle.shape[0], N_PIECE))
    for m in range(done.shape[0]):
        if done[m]:
            _set_start(devices, judging, errors, first + m, start)
            _set_pieces(devices, errors, which, first + m, pieces)
            border_mm = errors[first + m, BORDER]
            touched = _touched(obstacles, judging, start, pieces, devices.n_tube, forbidden, border_mm)
            done[m] = touched & forbidden == 0


@kernel(nogil=True)
def find_outcomes(devices, errors, which, judging, obstacles, wanted, first, touched, miss_mm, taken, ends):
    """Note all that deviated plans touch, `(N,)` flags, how far the middle of the tool misses the
    target, `(N,)` mm, what they take, and where they end, `(N, 9)`.

    The parameters are those of `find_taken` and `keep_clear`.
    """
    start, pieces = np.zeros(N_START), np.zeros((devices.n_tube + devices.needle.shape[0], N_PIECE))
    for m in range(touched.shape[0]):
        _set_start(devices, judging, errors, first + m, start)
        _set_pieces(devices, errors, which, first + m, pieces)
        end = find_end(start, pieces)
        miss_mm[m] = miss_of(wanted, _shift(errors, first + m), end)
        taken[m] = tissue_taken(wanted, _shift(errors, first + m), end)
        ends[m] = end
        touched[m] = _touched(obstacles, judging, start, pieces, devices.n_tube, 0, errors[first + m, BORDER])


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
def follow_chains(starts, pieces, n_tube, obstacles, judging, wanted, moved, touched, miss_mm, taken, ends):
    """Note what chains touch, `(N,)` flags, how far they miss, `(N,)` mm, what they take and where they end.

    `moved` `(N, 4)` says how far the nodule lies from where it was planned, and how far vessels reach out of
    their voxels, in mm; see `deviation.follow`.
    """
    for n in range(starts.shape[0]):
        touched[n] = _touched(obstacles, judging, starts[n], pieces[n], n_tube, 0, moved[n, 3])
        end, shift = find_end(starts[n], pieces[n]), (moved[n, 0], moved[n, 1], moved[n, 2])
        miss_mm[n], taken[n], ends[n] = miss_of(wanted, shift, end), tissue_taken(wanted, shift, end), end
