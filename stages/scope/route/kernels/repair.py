"""A nonlinear program on the control points of a cubic B-spline, solved by an augmented Lagrangian.

Minimise, over the free control points, the integral of

    centring * |c - reference|^2 / radius^2  +  bending * |c''|^2

subject, at the samples, to `curvature <= limit (1 - spare)` and `depth >= needed + spare`, and at free ends
to a largest distance from the wanted point.  The inner problems are least squares; Levenberg and Marquardt's
method solves them, with banded normal equations, since a sample moves with four control points.  The terms
of a sample are the objective, the curvature and the depth in the lumen; at free ends, the distance from the
wanted points.

Rows of `samples` (S, 7): width of the sample in the parameter, reference point (3), reference radius, the
first path cone and the one after the last that lead back to the lumen.
"""

import math
from typing import NamedTuple

import numpy as np

from anatomy.base.typed import Float, Int
from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from stages.scope.route.kernels.lumen import cone_depth, deep_enough

CENTRING, BENDING, LIMIT, NEEDED, SPARE_CURVATURE, SPARE_DEPTH, TOLERANCE = range(7)
"""Places in `Program.weights`."""

INSIDE = 0.99
"""Ends are held to this share of their tolerance, so that the proof does not fail for the last digit."""


class Program(NamedTuple):
    """The program of a repair; S samples.

    lo, hi : the control points `lo` to `hi - 1` are free; first (S,), rows (S, 3, 4) : first control point
    and basis rows of each sample; samples (S, 7), weights (7,) : see `repair`; cones, cells, cell_start,
    cell_cones : the lumen, see `lumen`; guide_cones (P, 8) : cones along the guide path; ends (2, 3) : the
    wanted first and last points.
    """

    lo: int
    hi: int
    first: Int
    rows: Float
    samples: Float
    cones: Float
    cells: Float
    cell_start: Int
    cell_cones: Int
    guide_cones: Float
    weights: Float
    ends: Float


@inner_kernel
def _sample_at(control, f, rows, v):
    """Fill `v` (3, 3) with the point of a sample, and its first and second derivatives."""
    for d in range(3):
        for axis in range(3):
            v[d, axis] = 0.0
            for c in range(4):
                v[d, axis] += rows[d, c] * control[f + c, axis]


@inner_kernel
def _curvature_violation(v, weights):
    """Return the violation of the curvature limit, then c' x c'' (norm, vector), and |c'|^2 and |c'|^3."""
    nx = v[1, 1] * v[2, 2] - v[1, 2] * v[2, 1]
    ny = v[1, 2] * v[2, 0] - v[1, 0] * v[2, 2]
    nz = v[1, 0] * v[2, 1] - v[1, 1] * v[2, 0]
    speed2 = v[1, 0] ** 2 + v[1, 1] ** 2 + v[1, 2] ** 2 + 1e-12
    speed3 = speed2 * math.sqrt(speed2)
    norm = math.sqrt(nx * nx + ny * ny + nz * nz)
    value = norm / speed3 / weights[LIMIT] - 1.0 + weights[SPARE_CURVATURE]
    return value, norm, nx, ny, nz, speed2, speed3


@inner_kernel
def _depth_violation(program, s, v, multiplier, hints):
    """Return the violation of the depth at sample `s` in reference radii, and the centre of its best ball."""
    weights, sample = program.weights, program.samples[s]
    wanted = weights[NEEDED] + weights[SPARE_DEPTH]
    enough = math.inf if multiplier > 0.0 else wanted
    depth, cx, cy, cz, hints[s] = deep_enough(
        program.cones, program.cells, program.cell_start, program.cell_cones, hints[s], enough,
        v[0, 0], v[0, 1], v[0, 2],
    )  # fmt: skip
    if depth < 0.0:
        # Outside the lumen, the cones along the guide path lead back.
        for e in range(int(sample[5]), int(sample[6])):
            found, px, py, pz = cone_depth(program.guide_cones, e, v[0, 0], v[0, 1], v[0, 2])
            if found > depth:
                depth, cx, cy, cz = found, px, py, pz
    return (wanted - depth) / sample[4], cx, cy, cz


@inner_kernel
def _end_violation(program, control, end):
    """Return the violation at an end, the vector from the wanted point, its length, the point (-1: held)."""
    a = 0 if end == 0 else control.shape[0] - 1
    if a < program.lo or a >= program.hi:
        return -1.0, 0.0, 0.0, 0.0, 0.0, -1
    dx = control[a, 0] - program.ends[end, 0]
    dy = control[a, 1] - program.ends[end, 1]
    dz = control[a, 2] - program.ends[end, 2]
    distance = math.sqrt(dx * dx + dy * dy + dz * dz)
    return distance / program.weights[TOLERANCE] - INSIDE, dx, dy, dz, distance, a


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


@merged_kernel
def _curvature_row(rows, v, limit, norm, nx, ny, nz, speed2, speed3, row):
    """Fill `row` (12,) with the derivatives of the curvature by the four control points."""
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
        row[3 * c] = rows[1, c] * ax + rows[2, c] * bx
        row[3 * c + 1] = rows[1, c] * ay + rows[2, c] * by
        row[3 * c + 2] = rows[1, c] * az + rows[2, c] * bz


@merged_kernel
def _add_end(band, slope, at, dx, dy, dz, distance, active, penalty, weights):
    """Add a free end, whose first unknown is `at`, to the normal equations."""
    tolerance = weights[TOLERANCE]
    pull = weights[CENTRING] / tolerance
    d = np.array((dx, dy, dz))
    for i in range(3):
        slope[at + i] += pull * d[i]
        band[at + i, 0] += pull
        if active > 0.0 and distance > 0.0:
            slope[at + i] += penalty * active * d[i] / (distance * tolerance)
            for j in range(i + 1):
                band[at + i, i - j] += penalty * d[i] * d[j] / (distance * tolerance) ** 2


@inner_kernel
def lagrangian(program, control, multipliers, penalty, hints, violation, band, slope):
    """Return the augmented Lagrangian; fill its gradient `slope` and the Gauss-Newton matrix `band`.

    `violation` (S + 2, 2) receives the constraint values, curvature and depth at the samples, then the
    distances of the ends.  `hints` (S,) keeps the cone in which each sample was found.
    """
    lo, hi, weights = program.lo, program.hi, program.weights
    band[:] = 0.0
    slope[:] = 0.0
    row, v = np.zeros(12), np.zeros((3, 3))
    count, total = program.first.shape[0], 0.0
    for s in range(count):
        f, rows, sample = program.first[s], program.rows[s], program.samples[s]
        _sample_at(control, f, rows, v)
        centre = weights[CENTRING] * sample[0] / (sample[4] * sample[4])
        bend = weights[BENDING] * sample[0]
        for axis in range(3):
            off = v[0, axis] - sample[1 + axis]
            total += 0.5 * (centre * off * off + bend * v[2, axis] * v[2, axis])
            for c in range(max(lo - f, 0), min(hi - f, 4)):
                at = 3 * (f + c - lo) + axis
                slope[at] += centre * rows[0, c] * off + bend * rows[2, c] * v[2, axis]
                for e in range(max(lo - f, 0), c + 1):
                    band[at, 3 * (c - e)] += centre * rows[0, c] * rows[0, e] + bend * rows[2, c] * rows[2, e]
        value, norm, nx, ny, nz, speed2, speed3 = _curvature_violation(v, weights)
        violation[s, 0] = value
        active = value + multipliers[s, 0] / penalty
        if active > 0.0:
            total += 0.5 * penalty * active * active
            if norm > 0.0:
                _curvature_row(rows, v, weights[LIMIT], norm, nx, ny, nz, speed2, speed3, row)
                _add_row(band, slope, f, lo, hi, active, row, penalty)
        value, cx, cy, cz = _depth_violation(program, s, v, multipliers[s, 1], hints)
        violation[s, 1] = value
        active = value + multipliers[s, 1] / penalty
        dx, dy, dz = v[0, 0] - cx, v[0, 1] - cy, v[0, 2] - cz
        size = math.sqrt(dx * dx + dy * dy + dz * dz) * sample[4]
        if active > 0.0:
            total += 0.5 * penalty * active * active
            if size > 0.0:
                for c in range(4):
                    row[3 * c] = rows[0, c] * dx / size
                    row[3 * c + 1] = rows[0, c] * dy / size
                    row[3 * c + 2] = rows[0, c] * dz / size
                _add_row(band, slope, f, lo, hi, active, row, penalty)
    ends = 0.0
    for end in range(2):
        value, dx, dy, dz, distance, a = _end_violation(program, control, end)
        violation[count + end, 0] = value
        if a < 0:
            continue
        # The wanted point also draws, gently.
        pull = weights[CENTRING] / weights[TOLERANCE]
        ends += 0.5 * pull * distance * distance
        active = value + multipliers[count + end, 0] / penalty
        if active > 0.0:
            ends += 0.5 * penalty * active * active
        _add_end(band, slope, 3 * (a - lo), dx, dy, dz, distance, active, penalty, weights)
    return total + ends


BAND = 12
"""Half the bandwidth of the normal equations: four control points of three coordinates."""
STALL = 1e-4
"""Relative gain below which the least-squares steps of a round end; the next round moves the multipliers."""
LEAST_DAMPING, FIRST_DAMPING = 1e-9, 1e-3
RAISE, LOWER = 6.0, 0.2
"""Levenberg-Marquardt damping, relative to the diagonal, and its factors after a failure and a success."""
FIRST_PENALTY, MAX_PENALTY = 10.0, 1e7
PATIENCE = 3
"""In so many rounds the violation must fall by a third."""


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


@merged_kernel
def _descend(program, control, multipliers, penalty, hints, violation, steps, work):
    """Minimise the augmented Lagrangian by at most `steps` least-squares steps; return how many were taken.

    `work`: band and slope of the normal equations, their factor and step, and the control points, violations,
    band and slope of a trial.  `control` and its `violation` are changed in place.
    """
    band, slope, factor, step, trial, trial_violation, trial_band, trial_slope = work
    lo, hi = program.lo, program.hi
    damping = FIRST_DAMPING
    value = lagrangian(program, control, multipliers, penalty, hints, violation, band, slope)
    for taken in range(steps):
        before = value
        # No step gains anything where the damping is larger: steps are then rounding.
        while damping < 1e10:
            if _solve(band, slope, damping, factor, step):
                for a in range(lo, hi):
                    for axis in range(3):
                        trial[a, axis] = control[a, axis] + step[3 * (a - lo) + axis]
                new = lagrangian(
                    program, trial, multipliers, penalty, hints, trial_violation, trial_band, trial_slope
                )
                if new < value:
                    value = new
                    break
            damping *= RAISE
        else:
            return taken + 1
        control[lo:hi] = trial[lo:hi]
        violation[:], band[:], slope[:] = trial_violation, trial_band, trial_slope
        damping = max(damping * LOWER, LEAST_DAMPING)
        if before - value <= STALL * abs(before):
            return taken + 1
    return steps


@kernel(nogil=True)
def repair(control, program, rounds, steps, tolerance):
    """Move the free control points of `control` (n, 3) to the solution of the program, in place.

    `rounds` and `steps` are updates of the multipliers, and least-squares steps in each.  Up to `tolerance` a
    violation counts as none: a share of the limit of curvature, or of the local radius.  Returned are the
    largest violation that is left, and the least-squares steps taken.
    """
    count = program.first.shape[0]
    n = 3 * (program.hi - program.lo)
    multipliers = np.zeros((count + 2, 2))
    violation = np.full((count + 2, 2), -1.0)
    work = (
        np.zeros((n, BAND)), np.zeros(n), np.zeros((n, BAND)), np.zeros(n), control.copy(),
        violation.copy(), np.zeros((n, BAND)), np.zeros(n),
    )  # fmt: skip
    hints = np.full(count, -1, dtype=np.int64)
    penalty, worst, taken = FIRST_PENALTY, math.inf, 0
    earlier = np.full(rounds, math.inf)
    for turn in range(rounds):
        taken += _descend(program, control, multipliers, penalty, hints, violation, steps, work)
        previous, worst = worst, 0.0
        for s in range(count + 2):
            for kind in range(2):
                worst = max(worst, violation[s, kind])
                multipliers[s, kind] = max(multipliers[s, kind] + penalty * violation[s, kind], 0.0)
        earlier[turn] = worst
        if worst <= tolerance or (turn >= PATIENCE and worst > 0.7 * earlier[turn - PATIENCE]):
            break
        if worst > 0.25 * previous:
            penalty = min(penalty * 10.0, MAX_PENALTY)
    return worst, taken
