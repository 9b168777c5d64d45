"""A nonlinear program on the control points of a cubic B-spline, solved by an augmented Lagrangian.

Minimise, over the free control points, the integral of

    centring * |c - reference|^2 / radius^2  +  bending * |c''|^2

subject, at the samples, to `curvature <= limit (1 - spare)` and `depth >= needed + spare`, and at free ends
to a largest distance from the wanted point.  The inner problems are least squares; Levenberg and Marquardt's
method solves them, with banded normal equations, since a sample moves with four control points.

Rows of `samples` (S, 7): width of the sample in the parameter, reference point (3), reference radius, the
first path cone and the one after the last that lead back to the lumen.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from anatomy.kernels.compiling import inner_kernel
from stages.scope.route.kernels.lumen import cone_depth, deep_enough

BAND = 12
STALL = 1e-4
MAX_DAMPING = 1e10
PATIENCE = 3
"""In so many rounds the violation must fall by a third."""

CENTRING, BENDING, LIMIT, NEEDED, SPARE_CURVATURE, SPARE_DEPTH, TOLERANCE = range(7)


@inner_kernel
def _add_row(band, slope, first, lo, hi, value, row, weight):
    """Add one residual with its 12 derivatives to the normal equations of the free control points."""
    for i in range(12):
        a = first + i // 3
        if a < lo or a >= hi:
            continue
        at = 3 * (a - lo) + i % 3
        slope[at] += weight * row[i] * value
        for j in range(i + 1):
            b = first + j // 3
            if b < lo or b >= hi:
                continue
            other = 3 * (b - lo) + j % 3
            band[at, at - other] += weight * row[i] * row[j]


@inner_kernel
def _residuals(control, lo, hi, first, rows, samples, scene, path_cones, weights, ends, multipliers, penalty,
               hints, fill, band, slope, violation):  # fmt: skip
    """Return the value of the augmented Lagrangian; with `fill`, also its gradient and Gauss-Newton matrix.

    `violation` (S + 2, 2) receives the constraint values, curvature and depth at the samples, then the
    distances of the ends.
    """
    cones, index, cell_start, cell_cones = scene
    limit = weights[LIMIT]
    total = 0.0
    row = np.zeros(12)
    v = np.zeros((3, 3))
    count = first.shape[0]
    for s in range(count):
        f = first[s]
        for d in range(3):
            for axis in range(3):
                v[d, axis] = 0.0
                for c in range(4):
                    v[d, axis] += rows[s, d, c] * control[f + c, axis]
        centring = weights[CENTRING] * samples[s, 0] / (samples[s, 4] * samples[s, 4])
        bending = weights[BENDING] * samples[s, 0]
        for axis in range(3):
            off = v[0, axis] - samples[s, 1 + axis]
            total += 0.5 * (centring * off * off + bending * v[2, axis] * v[2, axis])
            if fill:
                for c in range(4):
                    a = f + c
                    if a < lo or a >= hi:
                        continue
                    at = 3 * (a - lo) + axis
                    slope[at] += centring * rows[s, 0, c] * off + bending * rows[s, 2, c] * v[2, axis]
                    for e in range(c + 1):
                        if f + e >= lo:
                            band[at, 3 * (c - e)] += (
                                centring * rows[s, 0, c] * rows[s, 0, e]
                                + bending * rows[s, 2, c] * rows[s, 2, e]
                            )
        # Curvature.
        nx = v[1, 1] * v[2, 2] - v[1, 2] * v[2, 1]
        ny = v[1, 2] * v[2, 0] - v[1, 0] * v[2, 2]
        nz = v[1, 0] * v[2, 1] - v[1, 1] * v[2, 0]
        speed2 = v[1, 0] ** 2 + v[1, 1] ** 2 + v[1, 2] ** 2 + 1e-12
        speed3 = speed2 * math.sqrt(speed2)
        norm = math.sqrt(nx * nx + ny * ny + nz * nz)
        value = norm / speed3 / limit - 1.0 + weights[SPARE_CURVATURE]
        violation[s, 0] = value
        active = value + multipliers[s, 0] / penalty
        if active > 0.0:
            total += 0.5 * penalty * active * active
            if fill and norm > 0.0:
                nx /= norm
                ny /= norm
                nz /= norm
                scale = 1.0 / (speed3 * limit)
                fade = 3.0 * norm * scale / speed2
                ax = (v[2, 1] * nz - v[2, 2] * ny) * scale - fade * v[1, 0]
                ay = (v[2, 2] * nx - v[2, 0] * nz) * scale - fade * v[1, 1]
                az = (v[2, 0] * ny - v[2, 1] * nx) * scale - fade * v[1, 2]
                bx = (ny * v[1, 2] - nz * v[1, 1]) * scale
                by = (nz * v[1, 0] - nx * v[1, 2]) * scale
                bz = (nx * v[1, 1] - ny * v[1, 0]) * scale
                for c in range(4):
                    row[3 * c] = rows[s, 1, c] * ax + rows[s, 2, c] * bx
                    row[3 * c + 1] = rows[s, 1, c] * ay + rows[s, 2, c] * by
                    row[3 * c + 2] = rows[s, 1, c] * az + rows[s, 2, c] * bz
                _add_row(band, slope, f, lo, hi, active, row, penalty)
        # Wall, in units of the reference radius.
        wanted = weights[NEEDED] + weights[SPARE_DEPTH]
        enough = math.inf if multipliers[s, 1] > 0.0 else wanted
        depth, cx, cy, cz, hints[s] = deep_enough(
            cones, index, cell_start, cell_cones, hints[s], enough, v[0, 0], v[0, 1], v[0, 2]
        )
        if depth < 0.0:
            # Outside, what lies along the guide path leads back.
            for e in range(int(samples[s, 5]), int(samples[s, 6])):
                found, px, py, pz = cone_depth(path_cones, e, v[0, 0], v[0, 1], v[0, 2])
                if found > depth:
                    depth, cx, cy, cz = found, px, py, pz
        value = (wanted - depth) / samples[s, 4]
        violation[s, 1] = value
        active = value + multipliers[s, 1] / penalty
        if active > 0.0:
            total += 0.5 * penalty * active * active
            dx = v[0, 0] - cx
            dy = v[0, 1] - cy
            dz = v[0, 2] - cz
            size = math.sqrt(dx * dx + dy * dy + dz * dz)
            if fill and size > 0.0:
                size *= samples[s, 4]
                for c in range(4):
                    row[3 * c] = rows[s, 0, c] * dx / size
                    row[3 * c + 1] = rows[s, 0, c] * dy / size
                    row[3 * c + 2] = rows[s, 0, c] * dz / size
                _add_row(band, slope, f, lo, hi, active, row, penalty)
    total += _end_terms(control, lo, hi, weights, ends, multipliers, penalty, fill, band, slope, violation)
    return total


@inner_kernel
def _end_terms(control, lo, hi, weights, ends, multipliers, penalty, fill, band, slope, violation):
    """Return what free ends add; a clamped spline ends at its first and last control points."""
    count = violation.shape[0] - 2
    total = 0.0
    for e in range(2):
        a = 0 if e == 0 else control.shape[0] - 1
        if a < lo or a >= hi:
            violation[count + e, 0] = -1.0
            continue
        dx = control[a, 0] - ends[e, 0]
        dy = control[a, 1] - ends[e, 1]
        dz = control[a, 2] - ends[e, 2]
        distance = math.sqrt(dx * dx + dy * dy + dz * dz)
        tolerance = weights[TOLERANCE]
        # A little inside, so that the proof does not fail for the last digit.
        value = distance / tolerance - 0.99
        violation[count + e, 0] = value
        active = value + multipliers[count + e, 0] / penalty
        # The wanted point also draws, gently.
        pull = weights[CENTRING] / tolerance
        total += 0.5 * pull * distance * distance
        if active > 0.0:
            total += 0.5 * penalty * active * active
        if fill:
            at = 3 * (a - lo)
            d = np.array((dx, dy, dz))
            for i in range(3):
                slope[at + i] += pull * d[i]
                band[at + i, 0] += pull
                if active > 0.0 and distance > 0.0:
                    slope[at + i] += penalty * active * d[i] / (distance * tolerance)
                    for j in range(i + 1):
                        band[at + i, i - j] += penalty * d[i] * d[j] / (distance * tolerance) ** 2
    return total


@inner_kernel
def _solve(band, slope, damping, factor, step):
    """Solve `(band + damping * diagonal) step = -slope`; tell whether the matrix was positive definite."""
    n = slope.shape[0]
    for i in range(n):
        for j in range(max(0, i - BAND + 1), i + 1):
            total = band[i, i - j]
            if i == j:
                total += damping * (band[i, 0] + 1e-9)
            for k in range(max(0, i - BAND + 1, j - BAND + 1), j):
                total -= factor[i, i - k] * factor[j, j - k]
            if i == j:
                if not total > 0.0:
                    return False
                factor[i, 0] = math.sqrt(total)
            else:
                factor[i, i - j] = total / factor[j, 0]
    for i in range(n):
        total = -slope[i]
        for k in range(max(0, i - BAND + 1), i):
            total -= factor[i, i - k] * step[k]
        step[i] = total / factor[i, 0]
    for i in range(n - 1, -1, -1):
        total = step[i]
        for k in range(i + 1, min(n, i + BAND)):
            total -= factor[k, k - i] * step[k]
        step[i] = total / factor[i, 0]
    return True


@numba.njit(cache=True, nogil=True)
def repair(control, lo, hi, first, rows, samples, cones, index, cell_start, cell_cones, path_cones, weights,
           ends, rounds, steps, tolerance):  # fmt: skip
    """Move the control points `lo` to `hi - 1` to the solution of the program.

    Parameters
    ----------
    control : (n, 3) float64
        Changed in place.
    first : (S,) int64, rows : (S, 3, 4) float64
        First control point and basis rows of each sample.
    samples, weights : see the module
    ends : (2, 3) float64
        Wanted first and last points.
    rounds, steps : int
        Updates of the multipliers, and least-squares steps in each.
    tolerance : float
        Largest violation that counts as none: a share of the limit of curvature, or of the local radius.

    Returns
    -------
    (float, int)
        The largest violation that is left, and the least-squares steps taken.
    """
    scene = (cones, index, cell_start, cell_cones)
    count = first.shape[0]
    n = 3 * (hi - lo)
    band = np.zeros((n, BAND))
    factor = np.zeros((n, BAND))
    slope = np.zeros(n)
    step = np.zeros(n)
    multipliers = np.zeros((count + 2, 2))
    violation = np.full((count + 2, 2), -1.0)
    trial_violation = np.full((count + 2, 2), -1.0)
    trial = control.copy()
    hints = np.full(count, -1, dtype=np.int64)
    penalty = 10.0
    worst = math.inf
    taken = 0
    earlier = np.full(rounds, math.inf)
    for turn in range(rounds):
        damping = 1e-3
        value = _residuals(control, lo, hi, first, rows, samples, scene, path_cones, weights, ends,
                           multipliers, penalty, hints, False, band, slope, violation)  # fmt: skip
        for _ in range(steps):
            band[:] = 0.0
            slope[:] = 0.0
            _residuals(control, lo, hi, first, rows, samples, scene, path_cones, weights, ends,
                       multipliers, penalty, hints, True, band, slope, violation)  # fmt: skip
            taken += 1
            improved = False
            before = value
            while damping < MAX_DAMPING:
                if _solve(band, slope, damping, factor, step):
                    for a in range(lo, hi):
                        for axis in range(3):
                            trial[a, axis] = control[a, axis] + step[3 * (a - lo) + axis]
                    new = _residuals(trial, lo, hi, first, rows, samples, scene, path_cones, weights, ends,
                                     multipliers, penalty, hints, False, band, slope,
                                     trial_violation)  # fmt: skip
                    if new < value:
                        value = new
                        improved = True
                        break
                damping *= 6.0
            if not improved:
                break
            control[lo:hi] = trial[lo:hi]
            damping = max(damping * 0.2, 1e-9)
            if before - value <= STALL * abs(before):
                break
        _residuals(control, lo, hi, first, rows, samples, scene, path_cones, weights, ends, multipliers,
                   penalty, hints, False, band, slope, violation)  # fmt: skip
        previous = worst
        worst = 0.0
        for s in range(count + 2):
            for kind in range(2):
                worst = max(worst, violation[s, kind])
                multipliers[s, kind] = max(multipliers[s, kind] + penalty * violation[s, kind], 0.0)
        earlier[turn] = worst
        if worst <= tolerance or (turn >= PATIENCE and worst > 0.7 * earlier[turn - PATIENCE]):
            break
        if worst > 0.25 * previous:
            penalty = min(penalty * 10.0, 1e7)
    return worst, taken
