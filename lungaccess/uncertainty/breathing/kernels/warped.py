"""Distances in the middle phase of a stretch to voxels as the motion deforms them, within bounds.

Near a place X of the masks a vector r becomes F r, F = I + share G(X), but for what the gradient changes on
the way: on a cell each column of G is affine in every coordinate, so G is nowhere in a box farther from
G(X) than at the corners of the parts into which the cells divide the box.
"""

import math

import numpy as np

from anatomy.kernels.compiling import kernel, merged_kernel
from anatomy.kernels.labels import AIRWAY, BRANCH_SHIFT, OUTSIDE
from anatomy.kernels.motion import gradient_at
from lungaccess.uncertainty.breathing.kernels.rigid import inverse_transposed

LEAST_RATE = 1e-9
"""Keeps a rate above 0."""
SWEEPS = 4
"""Of coordinate descent for the nearest point of a deformed box; the bound holds wherever it stops."""


@kernel(inline="always")
def _across(d, fb, fc):
    """Return the value between those of four edges at fractions across them."""
    return (1.0 - fc) * ((1.0 - fb) * d[0] + fb * d[1]) + fc * ((1.0 - fb) * d[2] + fb * d[3])


@merged_kernel
def _fill_column_changes(nodes, step, i, j, k, ends, own, edges, out):
    """Fill `out` (3, 4): how much each column of the gradient differs from `own` in part of a cell, squared.

    `ends` (3, 2) are the borders of the part as fractions of the cell i, j, k.  The column along an axis does
    not change along it; across, it is largest at one of four corners.  `edges` (3, 4) is room for slopes.
    """
    out[:] = 0.0
    for row in range(3):
        for edge in range(4):
            u, v = edge & 1, edge >> 1
            edges[0, edge] = (nodes[i + 1, j + u, k + v, row] - nodes[i, j + u, k + v, row]) / step
            edges[1, edge] = (nodes[i + v, j + 1, k + u, row] - nodes[i + v, j, k + u, row]) / step
            edges[2, edge] = (nodes[i + u, j + v, k + 1, row] - nodes[i + u, j + v, k, row]) / step
        for corner in range(4):
            u, v = corner & 1, corner >> 1
            out[0, corner] += (_across(edges[0], ends[1, u], ends[2, v]) - own[row, 0]) ** 2
            out[1, corner] += (_across(edges[1], ends[2, u], ends[0, v]) - own[row, 1]) ** 2
            out[2, corner] += (_across(edges[2], ends[0, u], ends[1, v]) - own[row, 2]) ** 2


@kernel(inline="always")
def _cells_of(low, width, first, step, count):
    """Return a coordinate in cells, and the first and last cell of a stretch of `width` cells from there."""
    at = (low - first) / step
    return at, min(max(int(at), 0), count - 2), min(max(int(at + width), 0), count - 2)


@merged_kernel
def _gradient_change(breath, x, y, z, reach, own):
    """Return how far, in Frobenius norm, the gradient is from `own` (3, 3) in a box of half side `reach`."""
    step, nodes = breath.frame[3], breath.nodes
    width = 2.0 * reach / step
    low_x, i0, i1 = _cells_of(x - reach, width, breath.frame[0], step, nodes.shape[0])
    low_y, j0, j1 = _cells_of(y - reach, width, breath.frame[1], step, nodes.shape[1])
    low_z, k0, k1 = _cells_of(z - reach, width, breath.frame[2], step, nodes.shape[2])
    ends, edges, changes = np.zeros((3, 2)), np.zeros((3, 4)), np.zeros((3, 4))
    worst = 0.0
    for i in range(i0, i1 + 1):
        for j in range(j0, j1 + 1):
            for k in range(k0, k1 + 1):
                for end in range(2):
                    ends[0, end] = min(max(low_x + end * width - i, 0.0), 1.0)
                    ends[1, end] = min(max(low_y + end * width - j, 0.0), 1.0)
                    ends[2, end] = min(max(low_z + end * width - k, 0.0), 1.0)
                _fill_column_changes(nodes, step, i, j, k, ends, own, edges, changes)
                for corner in range(8):
                    i_end, j_end, k_end = corner & 1, (corner >> 1) & 1, corner >> 2
                    squares = changes[0, j_end + 2 * k_end] + changes[1, k_end + 2 * i_end]
                    worst = max(worst, squares + changes[2, i_end + 2 * j_end])
    return math.sqrt(worst) * (1.0 + 1e-6)


@merged_kernel
def _nearest_in_box(m, low, high, y, way):
    """Return a lower and an upper bound of the least length of `m y` over a box; `y` begins in the box.

    Coordinate descent finds y.  With n the direction of m y, no point of the box is nearer than the least of
    n'm y over the box, which is taken at a corner.  The third number is n'way: who goes t along the unit
    vector `way` loses no more than t n'way of the lower bound.
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
        return 0.0, length, 1.0
    least = 0.0
    for c in range(3):
        slope = (m[0, c] * v0 + m[1, c] * v1 + m[2, c] * v2) / length
        least += slope * (low[c] if slope > 0.0 else high[c])
    return max(least, 0.0), length, (way[0] * v0 + way[1] * v1 + way[2] * v2) / length


@merged_kernel
def deformed_distance(tissue, breath, share, at, bits, branch, reach, stretch, way, chord, needed, slope):
    """Return bounds of the distance to deformed voxels within `reach` mm of X, the nearest label, and a step.

    The step is proved along the unit vector `way`, at most the length `chord`: so far `needed`, which grows
    by `slope` a mm, is kept from each voxel.

    Lengths shrink by `stretch` at most, so that a voxel that is far in the masks is not measured where one
    is known to be nearer.  Voxels are taken as `anatomy.kernels.field.exact_distance` takes them; without
    any the bounds are infinite.
    """
    labels, geometry = tissue.labels, tissue.geometry
    own, m = np.zeros((3, 3)), np.zeros((3, 3))
    x, y, z = at[0], at[1], at[2]
    gradient_at(breath.nodes, breath.frame, x, y, z, own)
    error = abs(share) * _gradient_change(breath, x, y, z, reach, own) * reach
    axes, place = np.zeros((3, 3)), np.zeros(3)
    for r in range(3):
        place[r] = geometry[r, 0] * x + geometry[r, 1] * y + geometry[r, 2] * z + geometry[r, 3]
    inverse_transposed(geometry, axes)
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
    least, most, nearest, step = math.inf, math.inf, 0, chord
    in_reach = needed + error + (1.0 + slope) * chord
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
                kept = max(least, in_reach)
                if away > reach * reach or stretch * stretch * away > kept * kept:
                    continue
                below, above, toward = _nearest_in_box(m, low, high, y_best, way)
                rate = max(toward, 0.0) + slope + LEAST_RATE
                step = min(step, (below - error - needed) / rate)
                if below < least:
                    least, nearest = below, label
                most = min(most, above)
    return max(least - error, 0.0), most + error, nearest, step
