"""Distances in the middle phase of a stretch to voxels as the motion deforms them, within bounds.

Near a place X of the masks a vector r becomes F r, F = I + share G(X), but for what the gradient changes on
the way: on a cell each column of G is affine in every coordinate, so G is nowhere in a box farther from
G(X) than at the corners of the parts into which the cells divide the box.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from anatomy.kernels.labels import AIRWAY, BRANCH_SHIFT, OUTSIDE
from anatomy.kernels.motion import gradient_at
from lungaccess.breathing.kernels.rigid import inverse_transposed

SWEEPS = 4
"""Of coordinate descent for the nearest point of a deformed box; the bound holds wherever it stops."""
INSIDE = 1e-9
"""Share of a cell by which corners are moved into it, so that the gradient is that of the cell."""


@numba.njit(cache=True)
def _gradient_change(breath, x, y, z, reach, own):
    """Return how far, in Frobenius norm, the gradient is from `own` (3, 3) in a box of half side `reach`."""
    step, nodes = breath.frame[3], breath.nodes
    low, high = np.zeros(3), np.zeros(3)
    cells = np.zeros((3, 2), dtype=np.int64)
    at = (x, y, z)
    for axis in range(3):
        low[axis], high[axis] = at[axis] - reach, at[axis] + reach
        last = nodes.shape[axis] - 2
        cells[axis, 0] = min(max(int((low[axis] - breath.frame[axis]) / step), 0), last)
        cells[axis, 1] = min(max(int((high[axis] - breath.frame[axis]) / step), 0), last)
    here = np.zeros((3, 3))
    ends = np.zeros((3, 2))
    worst = 0.0
    for i in range(cells[0, 0], cells[0, 1] + 1):
        for j in range(cells[1, 0], cells[1, 1] + 1):
            for k in range(cells[2, 0], cells[2, 1] + 1):
                for axis in range(3):
                    cell = i if axis == 0 else (j if axis == 1 else k)
                    begin = breath.frame[axis] + cell * step
                    ends[axis, 0] = min(max(low[axis], begin), begin + step) + INSIDE * step
                    ends[axis, 1] = max(min(high[axis], begin + step), begin) - INSIDE * step
                for corner in range(8):
                    gradient_at(
                        nodes, breath.frame,
                        ends[0, corner & 1], ends[1, (corner >> 1) & 1], ends[2, corner >> 2], here,
                    )  # fmt: skip
                    squares = 0.0
                    for r in range(3):
                        for c in range(3):
                            squares += (here[r, c] - own[r, c]) ** 2
                    worst = max(worst, squares)
    return math.sqrt(worst) * (1.0 + 1e-6)


@numba.njit(cache=True)
def _nearest_in_box(m, low, high, y):
    """Return a lower and an upper bound of the least length of `m y` over a box; `y` begins in the box.

    Coordinate descent finds y.  With n the direction of m y, no point of the box is nearer than the least of
    n'm y over the box, which is taken at a corner.
    """
    for _ in range(SWEEPS):
        for c in range(3):
            top, bottom = 0.0, 0.0
            for r in range(3):
                rest = 0.0
                for other in range(3):
                    if other != c:
                        rest += m[r, other] * y[other]
                top -= m[r, c] * rest
                bottom += m[r, c] * m[r, c]
            y[c] = min(max(top / bottom, low[c]), high[c])
    v0 = m[0, 0] * y[0] + m[0, 1] * y[1] + m[0, 2] * y[2]
    v1 = m[1, 0] * y[0] + m[1, 1] * y[1] + m[1, 2] * y[2]
    v2 = m[2, 0] * y[0] + m[2, 1] * y[1] + m[2, 2] * y[2]
    length = math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
    if length < 1e-9:
        return 0.0, length
    least = 0.0
    for c in range(3):
        slope = (m[0, c] * v0 + m[1, c] * v1 + m[2, c] * v2) / length
        least += slope * (low[c] if slope > 0.0 else high[c])
    return max(least, 0.0), length


@numba.njit(cache=True)
def deformed_distance(tissue, breath, share, at, bits, branch, reach):
    """Return bounds of the distance to deformed voxels within `reach` mm of X, the nearest label, and why.

    Voxels are taken as `anatomy.kernels.field.exact_distance` takes them; without any the bounds are
    infinite.
    """
    labels, geometry = tissue.labels, tissue.geometry
    own, m = np.zeros((3, 3)), np.zeros((3, 3))
    x, y, z = at[0], at[1], at[2]
    gradient_at(breath.nodes, breath.frame, x, y, z, own)
    error = abs(share) * _gradient_change(breath, x, y, z, reach, own) * reach
    to_index, axes = np.zeros((3, 3)), np.zeros((3, 3))
    place = np.zeros(3)
    for r in range(3):
        for c in range(3):
            to_index[r, c] = geometry[r, c]
        place[r] = geometry[r, 0] * x + geometry[r, 1] * y + geometry[r, 2] * z + geometry[r, 3]
    inverse_transposed(to_index, axes)
    for r in range(3):
        for c in range(3):
            m[r, c] = axes[c, r]
            for k in range(3):
                m[r, c] += share * own[r, k] * axes[c, k]
    first, last = np.zeros(3, dtype=np.int64), np.zeros(3, dtype=np.int64)
    for axis in range(3):
        margin = reach / math.sqrt(geometry[axis, 4])
        first[axis] = int(math.floor(place[axis] - margin))
        last[axis] = int(math.floor(place[axis] + margin))
    low, high, y_best = np.zeros(3), np.zeros(3), np.zeros(3)
    least, most, nearest = math.inf, math.inf, 0
    for k in range(first[2], last[2] + 1):
        for j in range(first[1], last[1] + 1):
            for i in range(first[0], last[0] + 1):
                inside = 0 <= i < labels.shape[0] and 0 <= j < labels.shape[1] and 0 <= k < labels.shape[2]
                label = int(labels[i, j, k]) if inside else OUTSIDE
                hit = label & bits
                if hit == 0:
                    continue
                if hit == AIRWAY and branch >= 0 and (label >> BRANCH_SHIFT) - 1 == branch:
                    continue
                away = 0.0
                for axis in range(3):
                    cell = i if axis == 0 else (j if axis == 1 else k)
                    low[axis], high[axis] = cell - place[axis], cell + 1.0 - place[axis]
                    y_best[axis] = min(max(0.0, low[axis]), high[axis])
                    away += y_best[axis] * y_best[axis] * geometry[axis, 4]
                if away > reach * reach:
                    continue
                below, above = _nearest_in_box(m, low, high, y_best)
                if below < least:
                    least, nearest = below, label
                most = min(most, above)
    return max(least - error, 0.0), most + error, nearest
