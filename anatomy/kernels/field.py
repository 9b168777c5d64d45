"""Distance lookups with a proved error: clearance fields at voxel corners, and exact local search.

A clearance field holds, at every voxel corner, the distance to the nearest obstacle voxel taken as a
solid box, rounded down to 1/256 mm.  It knows nothing of what lies beyond the grid: the outermost
voxels of a lung are OUTSIDE.  The coordinates `u, v, w` below count corners: voxel `i` spans
`i <= u <= i + 1`.

Lower bound.  Let `p` lie in a cell, `t` be its true distance, and `B` the nearest box.  Trilinear
weights are the probabilities of a random corner `X` with mean `p` and independent coordinates, of
variance `f (1 - f) s**2` along an axis with fraction `f` and voxel size `s`.  On the cell every gap
between `X` and `B` along an axis is either 0 throughout or affine, so

    E[d(X)**2] <= E[d_B(X)**2] <= t**2 + sum of f (1 - f) s**2,

hence `t >= sqrt(interpolated squared distance - sum of f (1 - f) s**2)`.  Equality holds when one
box corner is nearest from all eight corners of the cell.  At most a voxel diagonal and the rounding `q`
are lost: with `S` for the sum, `d(X) >= t - |X - p|` and Minkowski's inequality give

    sqrt(interpolated squared distance) >= t - sqrt(S) - q,  and  sqrt(S) <= half a voxel diagonal.

`geometry` is `(3, 6)` float64: rows of the affine map from LPS mm to corner coordinates, the squared voxel
size of the axis, and the half side of an obstacle in voxels: 0.5 where voxels are solid boxes, 0 where an
obstacle is the centre of its voxel.  Then the field is sampled at voxel centres, its bound holds word for
word with a point for the box, and the distance to the grid's edge still counts as that to a solid.
"""

import math

import numpy as np

from anatomy.kernels.compiling import kernel
from anatomy.kernels.labels import AIRWAY, BRANCH_SHIFT, OUTSIDE

UNITS_PER_MM = 256.0
"""A unit is 4 micrometres, far below a voxel, and 256 mm fit into uint16."""

MIN_GAP_MM = 0.005
"""A proof that walks along a curve gives up where less clearance than this is to spare."""
EXACT_REACH_MM = 0.5
"""How far beyond the required clearance such a proof searches voxels: its longest step near obstacles."""
ROUNDING = 1e-9
"""Searches go farther than what they may find by this share."""


@kernel(inline="always", _nrt=False)
def _squared_along(low, high, f):
    return (1.0 - f) * float(low) * float(low) + f * float(high) * float(high)


@kernel(inline="never", _nrt=False)
def interpolate_squared(field, geometry, x, y, z):
    """Return the interpolated squared distance and the variance term, in mm^2; (0, 0) off the grid."""
    u = geometry[0, 0] * x + geometry[0, 1] * y + geometry[0, 2] * z + geometry[0, 3]
    v = geometry[1, 0] * x + geometry[1, 1] * y + geometry[1, 2] * z + geometry[1, 3]
    w = geometry[2, 0] * x + geometry[2, 1] * y + geometry[2, 2] * z + geometry[2, 3]
    u -= 0.5 - geometry[0, 5]
    v -= 0.5 - geometry[1, 5]
    w -= 0.5 - geometry[2, 5]
    ni, nj, nk = field.shape
    if not (0.0 <= u < ni - 1 and 0.0 <= v < nj - 1 and 0.0 <= w < nk - 1):
        return 0.0, 0.0
    fu = u - int(u)
    fv = v - int(v)
    fw = w - int(w)
    # Unsigned: signed indices would be tested for being negative, which takes as long as all the rest.
    i, j, k = np.uint64(u), np.uint64(v), np.uint64(w)
    i1, j1, k1 = i + np.uint64(1), j + np.uint64(1), k + np.uint64(1)
    # Written out, in this order: a loop over the corners takes twice as long.
    total = (1.0 - fw) * (1.0 - fv) * _squared_along(field[i, j, k], field[i1, j, k], fu)
    total += (1.0 - fw) * fv * _squared_along(field[i, j1, k], field[i1, j1, k], fu)
    total += fw * (1.0 - fv) * _squared_along(field[i, j, k1], field[i1, j, k1], fu)
    total += fw * fv * _squared_along(field[i, j1, k1], field[i1, j1, k1], fu)
    total /= UNITS_PER_MM * UNITS_PER_MM
    spread = (
        fu * (1.0 - fu) * geometry[0, 4] + fv * (1.0 - fv) * geometry[1, 4] + fw * (1.0 - fw) * geometry[2, 4]
    )
    return total, spread


@kernel(_nrt=False)
def distance_bound(field, geometry, x, y, z):
    """Return a distance in mm that the true distance is never below; 0 outside the grid."""
    total, spread = interpolate_squared(field, geometry, x, y, z)
    return math.sqrt(max(total - spread, 0.0))


@kernel(_nrt=False)
def distance_estimate(field, geometry, x, y, z):
    """Return a smooth estimate of the distance in mm, off by less than a voxel diagonal; no bound."""
    total, spread = interpolate_squared(field, geometry, x, y, z)
    return math.sqrt(max(total - 0.5 * spread, 0.0))


@kernel(_nrt=False)
def most_distance(field, geometry, x, y, z):
    """Return a distance in mm that the true distance never exceeds; inf off the grid and next to its border.

    Let X be the corner nearest to the point p, and o the obstacle point nearest to X.  No obstacle point
    is nearer to another corner than that corner's distance, which bounds how far o lies beyond X.
    """
    u = geometry[0, 0] * x + geometry[0, 1] * y + geometry[0, 2] * z + geometry[0, 3]
    v = geometry[1, 0] * x + geometry[1, 1] * y + geometry[1, 2] * z + geometry[1, 3]
    w = geometry[2, 0] * x + geometry[2, 1] * y + geometry[2, 2] * z + geometry[2, 3]
    u -= 0.5 - geometry[0, 5]
    v -= 0.5 - geometry[1, 5]
    w -= 0.5 - geometry[2, 5]
    ni, nj, nk = field.shape
    if not (1.0 <= u < ni - 2 and 1.0 <= v < nj - 2 and 1.0 <= w < nk - 2):
        return math.inf
    i, j, k = int(u + 0.5), int(v + 0.5), int(w + 0.5)
    here = (float(field[i, j, k]) + 2.0) / UNITS_PER_MM
    square = here * here
    total = beside = 0.0
    for axis in range(3):
        if axis == 0:
            off = u - i
            other = field[i - 1 if off > 0.0 else i + 1, j, k]
        elif axis == 1:
            off = v - j
            other = field[i, j - 1 if off > 0.0 else j + 1, k]
        else:
            off = w - k
            other = field[i, j, k - 1 if off > 0.0 else k + 1]
        share, size2 = abs(off), geometry[axis, 4]
        there = float(other) / UNITS_PER_MM
        total += share * (square - there * there + size2)
        beside += share * share * size2
    return min(math.sqrt(max(square + total + beside, 0.0)), here + math.sqrt(beside))


@kernel(_nrt=False)
def label_at(labels, geometry, x, y, z):
    """Return the label of the voxel that holds a point; OUTSIDE beyond the grid."""
    u = geometry[0, 0] * x + geometry[0, 1] * y + geometry[0, 2] * z + geometry[0, 3]
    v = geometry[1, 0] * x + geometry[1, 1] * y + geometry[1, 2] * z + geometry[1, 3]
    w = geometry[2, 0] * x + geometry[2, 1] * y + geometry[2, 2] * z + geometry[2, 3]
    ni, nj, nk = labels.shape
    if not (0.0 <= u < ni and 0.0 <= v < nj and 0.0 <= w < nk):
        return OUTSIDE
    return int(labels[np.uint64(u), np.uint64(v), np.uint64(w)])


@kernel(_nrt=False)
def exact_distance(labels, geometry, x, y, z, bits, exempt_branch, cap):
    """Search the voxels around a point for the nearest one with any of `bits`, as `geometry` takes them.

    Airway voxels of `exempt_branch` count only for their other structures (-1 exempts nothing).
    Space beyond the grid is OUTSIDE.  Returns the distance in mm, at most `cap`, and the label of the
    nearest voxel, 0 if none lies within `cap`.
    """
    u = geometry[0, 0] * x + geometry[0, 1] * y + geometry[0, 2] * z + geometry[0, 3]
    v = geometry[1, 0] * x + geometry[1, 1] * y + geometry[1, 2] * z + geometry[1, 3]
    w = geometry[2, 0] * x + geometry[2, 1] * y + geometry[2, 2] * z + geometry[2, 3]
    ni, nj, nk = labels.shape
    half = geometry[0, 5]
    best = cap * cap
    nearest = 0
    su = math.sqrt(geometry[0, 4])
    sv = math.sqrt(geometry[1, 4])
    sw = math.sqrt(geometry[2, 4])
    if bits & OUTSIDE:
        if not (0.0 <= u <= ni and 0.0 <= v <= nj and 0.0 <= w <= nk):
            return 0.0, OUTSIDE
        edge = min(u * su, (ni - u) * su, v * sv, (nj - v) * sv, w * sw, (nk - w) * sw)
        if edge * edge < best:
            best = edge * edge
            nearest = OUTSIDE
    elif not math.isfinite(u + v + w):
        return cap, 0
    i0 = max(int(math.floor(u - cap / su)), 0)
    i1 = min(int(math.floor(u + cap / su)), ni - 1)
    j0 = max(int(math.floor(v - cap / sv)), 0)
    j1 = min(int(math.floor(v + cap / sv)), nj - 1)
    k0 = max(int(math.floor(w - cap / sw)), 0)
    k1 = min(int(math.floor(w + cap / sw)), nk - 1)
    for k in range(k0, k1 + 1):
        gw = max(abs(k + 0.5 - w) - half, 0.0) * sw
        if gw * gw >= best:
            continue
        uk = np.uint64(k)
        for j in range(j0, j1 + 1):
            gv = max(abs(j + 0.5 - v) - half, 0.0) * sv
            g2 = gw * gw + gv * gv
            if g2 >= best:
                continue
            uj = np.uint64(j)
            for i in range(i0, i1 + 1):
                label = int(labels[np.uint64(i), uj, uk])
                hit = label & bits
                if hit == 0:
                    continue
                if hit == AIRWAY and exempt_branch >= 0 and (label >> BRANCH_SHIFT) - 1 == exempt_branch:
                    continue
                gu = max(abs(i + 0.5 - u) - half, 0.0) * su
                d2 = g2 + gu * gu
                if d2 < best:
                    best = d2
                    nearest = label
    return math.sqrt(best), nearest


@kernel()
def bounds_at(field, geometry, points, out):
    """Fill `out` (N,) with `distance_bound` at `points` (N, 3)."""
    for n in range(points.shape[0]):
        out[n] = distance_bound(field, geometry, points[n, 0], points[n, 1], points[n, 2])


@kernel()
def exact_at(labels, geometry, points, bits, exempt_branch, cap, out):
    """Fill `out` (N,) with `exact_distance` at `points` (N, 3)."""
    for n in range(points.shape[0]):
        out[n] = exact_distance(
            labels, geometry, points[n, 0], points[n, 1], points[n, 2], bits, exempt_branch, cap
        )[0]


@kernel()
def least_exact(labels, geometry, points, order, bounds, bits, exempt_branch, cap):
    """Return the least `exact_distance` of `points` (N, 3), at most `cap`.

    `bounds` (N,) are never above the distances, and `order` (N,) is that of rising bounds: what cannot be
    the least is not searched, and no search goes farther than the least that is known.
    """
    least = cap
    for at in range(order.shape[0]):
        n = order[at]
        if bounds[n] >= least:
            break
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        reach = min(least * (1.0 + ROUNDING), cap)
        distance, label = exact_distance(labels, geometry, x, y, z, bits, exempt_branch, reach)
        if label != 0 and distance < least:
            least = distance
    return least
