"""A nonlinear program on the control points of a cubic B-spline, solved by an augmented Lagrangian.

Minimise, over the free control points, the integral of

    centring * |c - reference|^2 / radius^2  +  bending * |c''|^2

subject, at the samples, to `curvature <= limit (1 - spare)` and `depth >= needed + spare`, and at free ends
to a largest distance from the wanted point.  The inner problems are least squares; Levenberg and Marquardt's
method solves them, with banded normal equations, since a sample moves with four control points.

Rows of `samples` (S, 7): width of the sample in the parameter, reference point (3), reference radius, the
first path cone and the one after the last that lead back to the lumen.
"""

import math

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from stages.scope.route.kernels.lagrangian import lagrangian

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
        improved = False
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
                    improved = True
                    break
            damping *= RAISE
        if not improved:
            return taken + 1
        control[lo:hi] = trial[lo:hi]
        violation[:], band[:], slope[:] = trial_violation, trial_band, trial_slope
        damping = max(damping * LOWER, LEAST_DAMPING)
        if before - value <= STALL * abs(before):
            return taken + 1
    return steps


@kernel(nogil=True)
def repair(control, program, rounds, steps, tolerance):
    """Move the free control points to the solution of the program.

    Args:
        control ((n, 3) float64): Changed in place.
        program: lagrangian.Program.
        rounds, steps (int): Updates of the multipliers, and least-squares steps in each.
        tolerance (float): Largest violation that counts as none: a share of the limit of curvature, or of the
            local radius.

    Returns:
        (float, int): The largest violation that is left, and the least-squares steps taken.
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
    penalty = FIRST_PENALTY
    worst = math.inf
    taken = 0
    earlier = np.full(rounds, math.inf)
    for turn in range(rounds):
        taken += _descend(program, control, multipliers, penalty, hints, violation, steps, work)
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
            penalty = min(penalty * 10.0, MAX_PENALTY)
    return worst, taken
