"""Cubic B-splines: basis, Bezier pieces, and the proof of curvature and depth on all of a curve."""

import math

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from stages.scope.route.kernels.lumen import depth_at

DEEPEST = 10
"""A piece is halved at most so often: 1/1024 of a span, where rounding still is far below `ROUNDING`."""
ROUNDING = 1e-9
"""Relative share by which every bound is widened for rounding."""

LEAST_RADIUS_MM = 0.2
"""Violations of the wall are measured in radii, but never in smaller ones."""
GUIDED_MM = 6.0
"""The cones that lead a sample back into the lumen reach this far along the guide path."""

PROVED, BENDS, LEAVES, UNDECIDED = 0, 1, 2, 3


@inner_kernel
def _blossom(control, knots, first, x0, x1, x2, axis):
    """Evaluate the symmetric form of the cubic on the span that begins at knot `first + 3`."""
    d0 = control[first, axis]
    d1 = control[first + 1, axis]
    d2 = control[first + 2, axis]
    d3 = control[first + 3, axis]
    k1, k2, k3 = knots[first + 1], knots[first + 2], knots[first + 3]
    k4, k5, k6 = knots[first + 4], knots[first + 5], knots[first + 6]
    e0 = d0 + (x0 - k1) / (k4 - k1) * (d1 - d0)
    e1 = d1 + (x0 - k2) / (k5 - k2) * (d2 - d1)
    e2 = d2 + (x0 - k3) / (k6 - k3) * (d3 - d2)
    f0 = e0 + (x1 - k2) / (k4 - k2) * (e1 - e0)
    f1 = e1 + (x1 - k3) / (k5 - k3) * (e2 - e1)
    return f0 + (x2 - k3) / (k4 - k3) * (f1 - f0)


@merged_kernel
def bezier_piece(control, knots, first, out):
    """Fill `out` (4, 3) with the Bezier points of the span governed by control points `first` to +3."""
    a = knots[first + 3]
    b = knots[first + 4]
    for axis in range(3):
        out[0, axis] = _blossom(control, knots, first, a, a, a, axis)
        out[1, axis] = _blossom(control, knots, first, a, a, b, axis)
        out[2, axis] = _blossom(control, knots, first, a, b, b, axis)
        out[3, axis] = _blossom(control, knots, first, b, b, b, axis)


@inner_kernel
def _halve(piece, left, right):
    """Divide a Bezier piece in the middle."""
    for axis in range(3):
        a = 0.5 * (piece[0, axis] + piece[1, axis])
        m = 0.5 * (piece[1, axis] + piece[2, axis])
        c = 0.5 * (piece[2, axis] + piece[3, axis])
        am = 0.5 * (a + m)
        mc = 0.5 * (m + c)
        middle = 0.5 * (am + mc)
        left[0, axis] = piece[0, axis]
        left[1, axis] = a
        left[2, axis] = am
        left[3, axis] = middle
        right[0, axis] = middle
        right[1, axis] = mc
        right[2, axis] = c
        right[3, axis] = piece[3, axis]


@merged_kernel
def _curvature_range(b):
    """Return the largest of three curvatures, ends and middle, of a Bezier piece, and a bound on all of it.

    The derivative is a quadratic whose Bernstein points have at least `slow` along the chord, so its norm is
    at least `slow`.  The cross product with the second derivative is a quadratic too (its cubic term
    vanishes), and its norm is at most that of its longest Bernstein point.
    """
    a = np.zeros((3, 3))
    d2 = np.zeros((2, 3))
    n = np.zeros((3, 3))
    for axis in range(3):
        for i in range(3):
            a[i, axis] = 3.0 * (b[i + 1, axis] - b[i, axis])
        for i in range(2):
            d2[i, axis] = 2.0 * (a[i + 1, axis] - a[i, axis])
    mid_a = 0.25 * a[0] + 0.5 * a[1] + 0.25 * a[2]
    mid_d = 0.5 * (d2[0] + d2[1])
    for axis in range(3):
        p = (axis + 1) % 3
        q = (axis + 2) % 3
        n[0, axis] = a[0, p] * d2[0, q] - a[0, q] * d2[0, p]
        n[2, axis] = a[2, p] * d2[1, q] - a[2, q] * d2[1, p]
        n[1, axis] = mid_a[p] * mid_d[q] - mid_a[q] * mid_d[p]
    bend = 0.0
    for i in range(3):
        total = 0.0
        for axis in range(3):
            value = n[i, axis]
            if i == 1:
                value = 2.0 * n[1, axis] - 0.5 * (n[0, axis] + n[2, axis])
            total += value * value
        bend = max(bend, math.sqrt(total))
    largest = 0.0
    for i in range(3):
        speed2 = 0.0
        turn2 = 0.0
        for axis in range(3):
            speed = mid_a[axis] if i == 1 else a[i, axis]
            speed2 += speed * speed
            turn2 += n[i, axis] * n[i, axis]
        largest = max(largest, math.sqrt(turn2) / speed2**1.5 if speed2 > 0.0 else math.inf)
    chord = b[3] - b[0]
    size = math.sqrt(chord[0] ** 2 + chord[1] ** 2 + chord[2] ** 2)
    slow = math.inf
    for i in range(3):
        slow = min(slow, a[i, 0] * chord[0] + a[i, 1] * chord[1] + a[i, 2] * chord[2])
    if size == 0.0 or slow <= 0.0:
        return largest, math.inf
    slow /= size
    return largest, bend * (1.0 + ROUNDING) / (slow * slow * slow)


@merged_kernel
def prove_span(control, knots, first, cones, index, cell_start, cell_cones, limit, needed, at_mm, bounds):
    """Decide whether one span keeps `limit` in curvature and `needed` in depth, everywhere.

    Returns `PROVED`, or why not: `BENDS` or `LEAVES` at the point `at_mm` (3,), which is filled, or
    `UNDECIDED`.  `bounds` (2,) is updated: an upper bound of the curvature, a lower bound of the depth.
    """
    stack = np.zeros((DEEPEST + 2, 4, 3))
    depth_of = np.zeros(DEEPEST + 2, dtype=np.int64)
    bezier_piece(control, knots, first, stack[0])
    # Second differences of short pieces lose digits far from the origin.
    origin = stack[0, 0].copy()
    for i in range(4):
        for axis in range(3):
            stack[0, i, axis] -= origin[axis]
    size = 1
    piece = np.zeros((4, 3))
    while size > 0:
        size -= 1
        level = depth_of[size]
        piece[:] = stack[size]
        curvature, bend = _curvature_range(piece)
        middle = 0.125 * (piece[0] + 3.0 * piece[1] + 3.0 * piece[2] + piece[3])
        reach = 0.0
        for i in range(4):
            dx, dy, dz = piece[i, 0] - middle[0], piece[i, 1] - middle[1], piece[i, 2] - middle[2]
            reach = max(reach, dx**2 + dy**2 + dz**2)
        reach = math.sqrt(reach) * (1.0 + ROUNDING)
        x, y, z = middle[0] + origin[0], middle[1] + origin[1], middle[2] + origin[2]
        depth = depth_at(cones, index, cell_start, cell_cones, x, y, z)[0] - ROUNDING
        if bend <= limit and depth - reach >= needed:
            bounds[0] = max(bounds[0], bend)
            bounds[1] = min(bounds[1], depth - reach)
            continue
        at_mm[0], at_mm[1], at_mm[2] = x, y, z
        if curvature > limit:
            return BENDS
        if depth < needed:
            return LEAVES
        if level == DEEPEST:
            return UNDECIDED
        _halve(piece, stack[size + 1], stack[size])
        depth_of[size] = depth_of[size + 1] = level + 1
        size += 2
    return PROVED


@kernel(nogil=True)
def prove_spans(control, knots, cones, index, starts, cell_cones, limit, needed, verdicts, points, bounds):
    """Fill `verdicts` (M,) and `points` (M, 3) for all spans; update `bounds` as `prove_span` does."""
    for first in range(verdicts.shape[0]):
        verdicts[first] = prove_span(
            control, knots, first, cones, index, starts, cell_cones, limit, needed, points[first], bounds
        )


@inner_kernel
def basis_rows(knots, first, u, rows):
    """Fill `rows` (3, 4) with the four basis functions at `u` and their first and second derivatives."""
    k1, k2, k3 = knots[first + 1], knots[first + 2], knots[first + 3]
    k4, k5, k6 = knots[first + 4], knots[first + 5], knots[first + 6]
    for c in range(4):
        d0, d1 = 1.0 if c == 0 else 0.0, 1.0 if c == 1 else 0.0
        d2, d3 = 1.0 if c == 2 else 0.0, 1.0 if c == 3 else 0.0
        g0 = (d1 - d0) / (k4 - k1)
        g1 = (d2 - d1) / (k5 - k2)
        g2 = (d3 - d2) / (k6 - k3)
        e0 = d0 + (u - k1) * g0
        e1 = d1 + (u - k2) * g1
        e2 = d2 + (u - k3) * g2
        f0 = e0 + (u - k2) / (k4 - k2) * (e1 - e0)
        f1 = e1 + (u - k3) / (k5 - k3) * (e2 - e1)
        rows[0, c] = f0 + (u - k3) / (k4 - k3) * (f1 - f0)
        h0 = g0 + (u - k2) / (k4 - k2) * (g1 - g0)
        h1 = g1 + (u - k3) / (k5 - k3) * (g2 - g1)
        rows[1, c] = 3.0 * (h0 + (u - k3) / (k4 - k3) * (h1 - h0))
        s0 = (g1 - g0) / (k4 - k2)
        s1 = (g2 - g1) / (k5 - k3)
        rows[2, c] = 6.0 * (s0 + (u - k3) / (k4 - k3) * (s1 - s0))


@kernel()
def evaluate(control, knots, parameters, out):
    """Fill `out` (3, S, 3) with points, first and second derivatives at sorted `parameters` (S,)."""
    rows = np.zeros((3, 4))
    first = 0
    last = control.shape[0] - 4
    for s in range(parameters.shape[0]):
        while first < last and parameters[s] >= knots[first + 4]:
            first += 1
        basis_rows(knots, first, parameters[s], rows)
        for d in range(3):
            for axis in range(3):
                total = 0.0
                for c in range(4):
                    total += rows[d, c] * control[first + c, axis]
                out[d, s, axis] = total


@kernel()
def take_samples(control, knots, begin, end, per_span, along, guide, first, rows, samples):
    """Prepare the samples of the spans `begin` to `end - 1` for `repair`.

    `guide` (P, 4) holds the points and radii of the centreline that the reference `control` follows, `along`
    (P,) their lengths along it, which are about the parameter of the spline.  Fills `first` (S,), `rows`
    (S, 3, 4) and `samples` (S, 7).
    """
    count = first.shape[0]
    near = 0
    for s in range(count):
        f = min(begin + s // per_span, end - 1)
        width = knots[f + 4] - knots[f + 3]
        u = knots[f + 3] + width * (s - (f - begin) * per_span) / per_span
        first[s] = f
        basis_rows(knots, f, u, rows[s])
        while near < along.shape[0] - 2 and along[near + 1] < u:
            near += 1
        share = min(max((u - along[near]) / (along[near + 1] - along[near]), 0.0), 1.0)
        samples[s, 0] = width / per_span
        for axis in range(3):
            total = 0.0
            for c in range(4):
                total += rows[s, 0, c] * control[f + c, axis]
            samples[s, 1 + axis] = total
        samples[s, 4] = max(guide[near, 3] * (1.0 - share) + guide[near + 1, 3] * share, LEAST_RADIUS_MM)
        low = near
        while low > 0 and u - along[low] < GUIDED_MM:
            low -= 1
        high = near + 1
        while high < along.shape[0] - 1 and along[high] - u < GUIDED_MM:
            high += 1
        samples[s, 5], samples[s, 6] = low, high
