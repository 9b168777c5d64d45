"""Breathing at points: displacements between nodes, their gradient, and points pulled back to the masks.

`nodes` is `(ni, nj, nk, 3)` float64: displacements in mm from end-exhale to end-inhale at places of the
masks. `frame` is `(4,)`: LPS of the first node, and the distance of nodes along all three axes, which are
those of LPS.  Between nodes a displacement is trilinear; beyond them it is that of the nearest place on the
border. `share` is the amplitude times the phase less that of the masks: a place X of the masks is at `X +
share d(X)`.
"""

import math

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel

MOST_STEPS = 60
"""The error of the fixed point falls by the norm of the gradient, 0.2 to 0.4 in a lung, with each step."""
CONVERGED_MM = 1e-9
"""A step below this ends the search; what is left is returned, and counts."""

SMALL = 1e-6
"""Taken off bounds for rounding, of which closed-form eigenvalues of size 1 have less than 1e-7."""


@kernel(inline="always")
def cell_of(place, first, step, count):
    """Return cell and fraction in it of a coordinate; those of the border beyond it."""
    at = min(max((place - first) / step, 0.0), count - 1.0)
    cell = min(int(at), count - 2)
    return cell, at - cell


@inner_kernel
def displacement_at(nodes, frame, x, y, z):
    """Return the displacement at a point, mm."""
    i, fi = cell_of(x, frame[0], frame[3], nodes.shape[0])
    j, fj = cell_of(y, frame[1], frame[3], nodes.shape[1])
    k, fk = cell_of(z, frame[2], frame[3], nodes.shape[2])
    dx = dy = dz = 0.0
    for a in range(2):
        wa = fi if a else 1.0 - fi
        for b in range(2):
            wb = wa * (fj if b else 1.0 - fj)
            for c in range(2):
                w = wb * (fk if c else 1.0 - fk)
                dx += w * nodes[i + a, j + b, k + c, 0]
                dy += w * nodes[i + a, j + b, k + c, 1]
                dz += w * nodes[i + a, j + b, k + c, 2]
    return dx, dy, dz


@merged_kernel
def gradient_at(nodes, frame, x, y, z, out):
    """Fill `out` (3, 3) with the derivative of the displacement (rows) along x, y, z (columns) in a cell."""
    i, fi = cell_of(x, frame[0], frame[3], nodes.shape[0])
    j, fj = cell_of(y, frame[1], frame[3], nodes.shape[1])
    k, fk = cell_of(z, frame[2], frame[3], nodes.shape[2])
    for row in range(3):
        gx = gy = gz = 0.0
        for a in range(2):
            wa, sa = (fi, 1.0) if a else (1.0 - fi, -1.0)
            for b in range(2):
                wb, sb = (fj, 1.0) if b else (1.0 - fj, -1.0)
                for c in range(2):
                    wc, sc = (fk, 1.0) if c else (1.0 - fk, -1.0)
                    value = nodes[i + a, j + b, k + c, row]
                    gx += sa * wb * wc * value
                    gy += wa * sb * wc * value
                    gz += wa * wb * sc * value
        out[row, 0], out[row, 1], out[row, 2] = gx / frame[3], gy / frame[3], gz / frame[3]


@kernel()
def pulled_back(nodes, frame, share, qx, qy, qz, x, y, z):
    """Return the place of the masks that is at `q` in a phase, sought from `x, y, z`, and its error, mm."""
    rest = math.inf
    for _ in range(MOST_STEPS):
        dx, dy, dz = displacement_at(nodes, frame, x, y, z)
        nx, ny, nz = qx - share * dx, qy - share * dy, qz - share * dz
        rest = math.sqrt((nx - x) ** 2 + (ny - y) ** 2 + (nz - z) ** 2)
        if rest <= CONVERGED_MM:
            break
        x, y, z = nx, ny, nz
    return x, y, z, rest


@kernel()
def displacements(nodes, frame, points, out):
    """Fill `out` (N, 3) with the displacements at `points` (N, 3)."""
    for n in range(points.shape[0]):
        out[n, 0], out[n, 1], out[n, 2] = displacement_at(
            nodes, frame, points[n, 0], points[n, 1], points[n, 2]
        )


@kernel()
def points_pulled_back(nodes, frame, share, points, out):
    """Fill `out` (N, 3) with places of the masks; return the largest distance that is left, mm."""
    worst = 0.0
    for n in range(points.shape[0]):
        qx, qy, qz = points[n, 0], points[n, 1], points[n, 2]
        x, y, z, rest = pulled_back(nodes, frame, share, qx, qy, qz, qx, qy, qz)
        out[n, 0], out[n, 1], out[n, 2] = x, y, z
        worst = max(worst, rest)
    return worst


@merged_kernel
def _eigenvalue_ends(g):
    """Return least and greatest eigenvalue of the symmetric part of a matrix (3, 3), in closed form."""
    mean = (g[0, 0] + g[1, 1] + g[2, 2]) / 3.0
    a, b, c = g[0, 0] - mean, g[1, 1] - mean, g[2, 2] - mean
    d, e, f = 0.5 * (g[0, 1] + g[1, 0]), 0.5 * (g[0, 2] + g[2, 0]), 0.5 * (g[1, 2] + g[2, 1])
    size = math.sqrt((a * a + b * b + c * c + 2.0 * (d * d + e * e + f * f)) / 6.0)
    if size < SMALL:
        return mean - 3.0 * size, mean + 3.0 * size
    det = a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)
    angle = math.acos(min(max(0.5 * det / size**3, -1.0), 1.0)) / 3.0
    return mean + 2.0 * size * math.cos(angle + 2.0 * math.pi / 3.0), mean + 2.0 * size * math.cos(angle)


@kernel()
def fill_cell_bounds(nodes, spacing, out):
    """Fill `out` (ni - 1, nj - 1, nk - 1, 3), see `anatomy.motion.motion.cell_bounds`."""
    edges, mean = np.zeros((4, 3)), np.zeros((3, 3))
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            for k in range(out.shape[2]):
                spread, squares = 0.0, 0.0
                for axis in range(3):
                    for edge in range(4):
                        u, v = edge & 1, edge >> 1
                        if axis == 0:
                            low, high = nodes[i, j + u, k + v], nodes[i + 1, j + u, k + v]
                        elif axis == 1:
                            low, high = nodes[i + u, j, k + v], nodes[i + u, j + 1, k + v]
                        else:
                            low, high = nodes[i + u, j + v, k], nodes[i + u, j + v, k + 1]
                        for row in range(3):
                            edges[edge, row] = (high[row] - low[row]) / spacing
                    farthest = 0.0
                    for row in range(3):
                        total = edges[0, row] + edges[1, row] + edges[2, row] + edges[3, row]
                        mean[row, axis] = 0.25 * total
                        squares += mean[row, axis] ** 2
                    for edge in range(4):
                        away = 0.0
                        for row in range(3):
                            away += (edges[edge, row] - mean[row, axis]) ** 2
                        farthest = max(farthest, away)
                    spread += farthest
                spread = math.sqrt(spread) + SMALL
                low_end, high_end = _eigenvalue_ends(mean)
                out[i, j, k, 0] = low_end - spread
                out[i, j, k, 1] = high_end + spread
                out[i, j, k, 2] = math.sqrt(squares) + spread


@inner_kernel
def stretch_near(cells, frame, begin, end, x, y, z, reach):
    """Return least stretch from share `begin` to `end`, and greatest norm of the gradient, near a point.

    `cells` is `(ni, nj, nk, 3)`, see `anatomy.motion.motion`; those are taken that meet a box of half side
    `reach` mm about the point.
    """
    ni, nj, nk, _ = cells.shape
    i0, _f = cell_of(x - reach, frame[0], frame[3], ni + 1)
    j0, _f = cell_of(y - reach, frame[1], frame[3], nj + 1)
    k0, _f = cell_of(z - reach, frame[2], frame[3], nk + 1)
    i1, _f = cell_of(x + reach, frame[0], frame[3], ni + 1)
    j1, _f = cell_of(y + reach, frame[1], frame[3], nj + 1)
    k1, _f = cell_of(z + reach, frame[2], frame[3], nk + 1)
    low, high, norm = 0.0, 0.0, 0.0
    for i in range(i0, i1 + 1):
        for j in range(j0, j1 + 1):
            for k in range(k0, k1 + 1):
                low = min(low, cells[i, j, k, 0])
                high = max(high, cells[i, j, k, 1])
                norm = max(norm, cells[i, j, k, 2])
    # Linear in the share on either side of 0: least at an end, and 1 at 0.
    return 1.0 + min(max(end, 0.0) * low, min(begin, 0.0) * high), norm
