"""All equilibria of two tubes whose rear ends are held at given angles.

With y the angle between the tubes at the tip, the angle alpha(y) between their rear ends is a smooth function
and alpha(y + 2 pi) = alpha(y) + 2 pi, so one turn tells all: between two of its extrema it is monotone, and
has each value once or not at all.
"""

from __future__ import annotations

import math

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from stages.tube.kernels.torsion import twist

TURN = 2.0 * math.pi
SAMPLES = 256
"""Samples of a turn in which sign changes are looked for."""
BISECTIONS = 60
"""Halvings of a bracket: to the last bit of a float."""


@inner_kernel
def _between_rear_ends(design, cutting, beta, owners, nodes, steps, tip_angles, y):
    """Return the angle between the rear ends for an angle between the tips, and its derivative."""
    tip_angles[0] = y
    tip_angles[1] = 0.0
    twist(design, cutting, tip_angles, owners, nodes, steps)
    _s, psi, rate, dpsi, drate = nodes
    value = psi[0, 0] + beta[0] * rate[0, 0] - psi[0, 1] - beta[1] * rate[0, 1]
    slope = dpsi[0, 0, 0] + beta[0] * drate[0, 0, 0] - dpsi[0, 0, 1] - beta[1] * drate[0, 0, 1]
    return value, slope


@merged_kernel
def _extremum(design, cutting, beta, owners, nodes, steps, tip_angles, low, high, rising):
    """Return the extremum between two angles where the slope changes sign; `rising` is that of `low`."""
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        slope = _between_rear_ends(design, cutting, beta, owners, nodes, steps, tip_angles, middle)[1]
        if (slope > 0.0) == rising:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


@merged_kernel
def _root(design, cutting, beta, owners, nodes, steps, tip_angles, low, high, wanted, rising):
    """Return where a monotone piece has a value, by Newton's method within a shrinking bracket."""
    y = 0.5 * (low + high)
    for _ in range(BISECTIONS):
        value, slope = _between_rear_ends(design, cutting, beta, owners, nodes, steps, tip_angles, y)
        if (value < wanted) == rising:
            low = y
        else:
            high = y
        following = y + (wanted - value) / slope if slope != 0.0 else low
        if not low <= following <= high:
            following = 0.5 * (low + high)
        if abs(following - y) <= 1e-15 * max(abs(y), 1.0):
            return following
        y = following
    return y


@kernel()
def all_of_two(design, cutting, beta, wanted, nodes, steps, found):
    """Find all angles between the tips of two tubes for the angle `wanted` between their rear ends.

    Parameters
    ----------
    design, cutting, beta, nodes, steps
        See `torsion.twist`; `nodes` holds one derivative.
    wanted : float
        rad, not wrapped.
    found : (F,) float64
        Is filled, rising; what exceeds its size is dropped.

    Returns
    -------
    int
        How many there are.
    """
    owners = np.full(1, -1)
    tip_angles = np.zeros(2)
    ends = np.zeros((2 * SAMPLES + 1, 2))
    count = 0
    before, slope_before, value_before = 0.0, 0.0, 0.0
    for m in range(SAMPLES + 1):
        y = TURN * m / SAMPLES
        value, slope = _between_rear_ends(design, cutting, beta, owners, nodes, steps, tip_angles, y)
        if m > 0 and (slope > 0.0) != (slope_before > 0.0):
            rising = slope_before > 0.0
            at = _extremum(design, cutting, beta, owners, nodes, steps, tip_angles, before, y, rising)
            ends[count, 0] = at
            ends[count, 1] = _between_rear_ends(design, cutting, beta, owners, nodes, steps, tip_angles, at)[
                0
            ]
            count += 1
        if m == 0 or m == SAMPLES or abs(value - value_before) > 0.0:
            ends[count, 0], ends[count, 1] = y, value
            count += 1
        before, slope_before, value_before = y, slope, value
    # As many turns as the value may lie from its argument have to be looked at.
    away = 0.0
    for m in range(count):
        away = max(away, abs(ends[m, 1] - ends[m, 0]))
    first = math.floor((wanted - away) / TURN) - 1
    last = math.ceil((wanted + away) / TURN) + 1
    roots = 0
    for turn in range(first, last + 1):
        for m in range(count - 1):
            low, high = ends[m, 1] + turn * TURN, ends[m + 1, 1] + turn * TURN
            if not (low <= wanted < high or high < wanted <= low):
                continue
            shifted = wanted - turn * TURN
            y = _root(
                design, cutting, beta, owners, nodes, steps, tip_angles, ends[m, 0], ends[m + 1, 0], shifted,
                high > low,
            )  # fmt: skip
            if roots < found.shape[0]:
                found[roots] = y + turn * TURN
            roots += 1
    return roots
