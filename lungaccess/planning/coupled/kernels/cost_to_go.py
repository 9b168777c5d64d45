"""The least cost that a path of a needle still has before it, on shells about the target; a lower bound.

docs/theory/cost_bound.md derives it.  A direction from the target is a point of the plane, as in
`stages.needle.infeasibility.kernels.backward_reach`: its stereographic projection from the direction opposite
to an axis.
"""

import math
from typing import NamedTuple

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from anatomy.kernels.field import most_distance
from stages.needle.kernels import CLEARANCE_FLOOR_MM

LARGEST_SINE = 0.99
"""Of half the turn of an arc over a line; of paths over longer ones nothing but their length is known."""
SPARE = 1e-6
"""For rounding, mm and rad."""
LEVELS = 7
"""Least values are kept of cells, and of squares of 2, 4, ... cells a side."""
BEYOND = 65535
"""Instead of a cost: no path from there costs less than the limit."""
MOST_UNITS = 65000
"""The limit, in units of the costs that are kept."""
HALF_DIAGONAL = 0.7072
"""Of a cell, in its sides."""


class CostToGo(NamedTuple):
    """Lower bounds of what paths to a target still cost, on K shells.

    Args:
        frame ((4, 3) float64): Two axes and the middle direction, unit vectors across each other, and the
            target in LPS mm.
        numbers ((7,) float64): Side of a cell of the plane of directions; distance from shell to shell, mm;
            greatest curvature, 1/mm; cost of a unit; least cost of a mm anywhere; clearance that a needle
            keeps beyond its exempt length, mm; and the last shell that counts.
        levels (tuple of (K + 1, N, N) uint16): Least cost on shell k, k times that distance from the target,
            from anywhere in a cell, in units and rounded down, or BEYOND; then that from anywhere in a square
            of 2, 4, ... cells a side.
    """

    frame: np.ndarray
    numbers: np.ndarray
    levels: tuple[np.ndarray, ...]


CELL, SHELL, KAPPA, UNIT, LEAST_RATE, REQUIRED, LAST_SHELL, N_NUMBERS = range(8)


@inner_kernel
def angle_at(kappa, length):
    """Return the angle (rad) from a chord to the arc of greatest curvature over it, at most a right one."""
    return math.asin(min(0.5 * kappa * length, 1.0))


@inner_kernel
def _in_plane(angle, size):
    """Return how far apart points of the plane are at most, of directions an angle (rad) apart.

    One of them is `size` from the middle of the plane.
    """
    farther = math.tan(min(math.atan(size) + 0.5 * angle, 1.5))
    return math.sin(min(0.5 * angle, 1.5)) * math.sqrt((1.0 + size * size) * (1.0 + farther * farther))


@merged_kernel
def _reduce(levels, shell):
    """Fill the levels of a shell above the first."""
    for level in range(1, LEVELS):
        below, above = levels[level - 1], levels[level]
        count = below.shape[1]
        for i in range(above.shape[1]):
            for j in range(above.shape[1]):
                least = BEYOND
                for a in range(2 * i, min(2 * i + 2, count)):
                    for b in range(2 * j, min(2 * j + 2, count)):
                        least = min(least, int(below[shell, a, b]))
                above[shell, i, j] = least


@kernel(nogil=True)
def fill_shell(field, geometry, weights, off, limit, togo, k, behind, beyond, part, parts):
    """Fill each `parts`-th row of cells, from `part` on, of the shell `k` behind those that are filled.

    Args:
        field, geometry: Corner field of the distance to all obstacles.
        weights (tuple of 2 float): Of the integral of 1 / clearance, and of the length in mm.
        off (float): How far from the target a path may end, mm.
        limit (float): Costs above are not told apart.
        behind, beyond ((N, N) float64): The cost from half a shell beyond the last one, and the same for this
            one, whose rows are filled.

    Returns:
        bool: Whether paths from some cell cost less than `limit`.
    """
    frame, numbers, levels = togo
    cell, shell, kappa, unit = numbers[CELL], numbers[SHELL], numbers[KAPPA], numbers[UNIT]
    per_clearance, per_mm = weights
    values = levels[0]
    count = values.shape[1]
    half = 0.5 * (count - 1)
    radius = k * shell
    drift = angle_at(kappa, radius) - angle_at(kappa, max(radius - shell, 0.0)) + SPARE
    stretch = 1.0 / math.sqrt(1.0 - (0.5 * kappa * (radius + 0.5 * shell)) ** 2)
    border = radius * numbers[LEAST_RATE]
    some = False
    for i in range(part, count, parts):
        u = (i - half) * cell
        for j in range(count):
            if i == 0 or j == 0 or i == count - 1 or j == count - 1:
                values[k, i, j] = min(int(border / unit), BEYOND - 1)
                beyond[i, j] = border
                continue
            v = (j - half) * cell
            size2 = u * u + v * v
            size = math.sqrt(size2)
            reach = int(math.ceil(_in_plane(drift, size + HALF_DIAGONAL * cell) / cell)) if k > 0 else 0
            cost = math.inf
            for m in range(max(i - reach, 0), min(i + reach, count - 1) + 1):
                for n in range(max(j - reach, 0), min(j + reach, count - 1) + 1):
                    cost = min(cost, behind[m, n])
            values[k, i, j] = BEYOND
            beyond[i, j] = math.inf
            if cost >= limit:
                continue
            a, b, c = 2.0 * u / (1.0 + size2), 2.0 * v / (1.0 + size2), (1.0 - size2) / (1.0 + size2)
            x = frame[3, 0] + radius * (a * frame[0, 0] + b * frame[1, 0] + c * frame[2, 0])
            y = frame[3, 1] + radius * (a * frame[0, 1] + b * frame[1, 1] + c * frame[2, 1])
            z = frame[3, 2] + radius * (a * frame[0, 2] + b * frame[1, 2] + c * frame[2, 2])
            inner = max(size - HALF_DIAGONAL * cell, 0.0)
            around = radius * 2.0 * HALF_DIAGONAL * cell / (1.0 + inner * inner)
            clear = most_distance(field, geometry, x, y, z) + around + off
            if clear < numbers[REQUIRED]:
                continue
            clear = max(clear, CLEARANCE_FLOOR_MM)
            beside = per_clearance * math.log(1.0 + 0.5 * stretch * shell / clear) / stretch
            beside += 0.5 * shell * per_mm
            if k > 0:
                cost += beside
            if cost >= limit:
                continue
            some = True
            values[k, i, j] = int(cost / unit)
            beyond[i, j] = cost + beside
    return some


@kernel(nogil=True)
def end_shell(togo, k):
    """Fill the higher levels of a shell whose cells are filled; from now on it counts."""
    _reduce(togo.levels, k)
    togo.numbers[LAST_SHELL] = k


@inner_kernel
def cost_from(togo, x, y, z, around, free):
    """Bound what every path from within `around` mm of a point still costs; inf if it is beyond the limit.

    The first `free` mm of a path may be anywhere.  A path crosses the shells nearer to the target than its
    start one after the other; from the direction of its start the limits of the needle tell the directions.
    """
    frame, numbers, levels = togo
    cell, shell, kappa = numbers[CELL], numbers[SHELL], numbers[KAPPA]
    dx, dy, dz = x - frame[3, 0], y - frame[3, 1], z - frame[3, 2]
    r = math.sqrt(dx * dx + dy * dy + dz * dz)
    k = min(int((r - around - free - SPARE) / shell), int(numbers[LAST_SHELL]))
    if k < 1 or r - around - free < shell or 0.5 * kappa * (r + around) > LARGEST_SINE:
        return 0.0
    outside = k * shell * numbers[LEAST_RATE]
    ahead = (dx * frame[2, 0] + dy * frame[2, 1] + dz * frame[2, 2]) / r
    if ahead < -0.9:
        return outside
    u = (dx * frame[0, 0] + dy * frame[0, 1] + dz * frame[0, 2]) / (r * (1.0 + ahead))
    v = (dx * frame[1, 0] + dy * frame[1, 1] + dz * frame[1, 2]) / (r * (1.0 + ahead))
    wide = math.asin(min(around / r, 1.0)) + angle_at(kappa, r + around) - angle_at(kappa, k * shell) + SPARE
    e = _in_plane(wide, math.sqrt(u * u + v * v)) / cell
    count = levels[0].shape[1]
    half = 0.5 * (count - 1)
    i0, i1 = int(math.floor(u / cell + half + 0.5 - e)), int(math.floor(u / cell + half + 0.5 + e))
    j0, j1 = int(math.floor(v / cell + half + 0.5 - e)), int(math.floor(v / cell + half + 0.5 + e))
    if i0 < 0 or j0 < 0 or i1 >= count or j1 >= count:
        return outside
    level = 0
    while level < LEVELS - 1 and (i1 >> level) - (i0 >> level) > 3:
        level += 1
    values = levels[level]
    least = BEYOND
    for i in range(i0 >> level, (i1 >> level) + 1):
        for j in range(j0 >> level, (j1 >> level) + 1):
            least = min(least, int(values[k, i, j]))
    return math.inf if least == BEYOND else least * numbers[UNIT]
