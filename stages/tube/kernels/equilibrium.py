"""Equilibria of tubes whose rear ends are held at given angles, and whether they are stable.

With psi_i(0) - beta_i u_i(0) as the angle alpha_i of the rear end (the part behind the front plate is held
straight, so its torsion is constant), alpha is a smooth function of the angles psi_tip at the tip, and its
derivative J both drives Newton's method and tells stability: an equilibrium is stable if
det d psi(s) / d psi_tip stays above 0 from the tip to the rearmost end [Gilbert2016, Dupont2010].

As turning all tubes together turns everything, only derivatives by the angles of all tubes but the last are
carried; those of each row sum up to 1.
"""

import math

import numpy as np

from anatomy.kernels.compiling import borrowing_kernel, kernel, merged_kernel
from anatomy.kernels.linear import solve_in_place
from stages.tube.kernels.assembly import PIECE_COLUMNS, cut
from stages.tube.kernels.pose import lay, put_pose, turned
from stages.tube.kernels.torsion import FEW, SCRATCH_ROWS, twist

TOLERANCE = 1e-12
LARGEST_TURN = 0.8
"""The angles between tubes turn by no more in one step of Newton's method, rad."""
NEWTON_STEPS = 25
"""Newton's method converges in fewer than 10 steps from a guess nearby."""
NEAR_ENOUGH = 1e-3
"""Largest error of a base angle on the way, rad: little beside the turns that Newton's method corrects."""
LEAST_STRIDE = 1e-3
ROUND = 12
"""Angles tried all round for each tube but the last."""
# With a type of its own it is no literal, for each of which a function would be compiled anew.
_PLATE = np.float64(0.0)
_FIRST_NODE = np.int64(0)
SHARES = 8
"""Places at which the determinant is looked at between two rear ends, for four tubes or more."""

# Columns of a result: converged, stable, least determinant, residual (rad), then the tip frame as a pose.
CONVERGED, STABLE, LEAST_DETERMINANT, RESIDUAL, TIP, RESULT_COLUMNS = 0, 1, 2, 3, 4, 16


@borrowing_kernel
def _relative(dpsi, drate, at, beta, s, matrix):
    """Fill `matrix` (n - 1, n - 1) with how angles between the tubes at `s` depend on those at the tip."""
    last = matrix.shape[0]
    for i in range(last):
        for c in range(last):
            matrix[i, c] = dpsi[at, c, i] - dpsi[at, c, last]
            if s < 0.0:
                matrix[i, c] += max(s, beta[i]) * drate[at, c, i] - max(s, beta[last]) * drate[at, c, last]


@kernel(_nrt=False)
def determinant_at(dpsi, drate, at, beta, s, matrix, right):
    """Return det d psi(s) / d psi_tip at or behind node `at`; `matrix` and `right` are scratch."""
    if matrix.shape[0] == 0:
        return 1.0
    _relative(dpsi, drate, at, beta, s, matrix)
    if matrix.shape[0] == 1:
        return matrix[0, 0]
    if matrix.shape[0] == 2:
        return matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]
    right[:] = 0.0
    return solve_in_place(matrix, right)


@merged_kernel
def _least_behind(dpsi, drate, beta, matrix, right):
    """Return the least determinant from the front plate to the rearmost end.

    Between two rear ends it is a polynomial in s of a degree less than the number of tubes: linear for two
    of them, a parabola for three, of which the vertex is looked at.
    """
    n = dpsi.shape[2]
    least = determinant_at(dpsi, drate, _FIRST_NODE, beta, 0.0, matrix, right)
    for i in range(n):
        near = 0.0
        for j in range(n):
            if beta[i] < beta[j] < near:
                near = beta[j]
        far = beta[i]
        ends = determinant_at(dpsi, drate, _FIRST_NODE, beta, far, matrix, right)
        least = min(least, ends)
        if n == 3:
            a = determinant_at(dpsi, drate, _FIRST_NODE, beta, near, matrix, right)
            b = determinant_at(dpsi, drate, _FIRST_NODE, beta, 0.5 * (near + far), matrix, right)
            bow = a - 2.0 * b + ends
            if bow > 0.0:
                vertex = 0.25 * (3.0 * a - 4.0 * b + ends) / bow
                if 0.0 < vertex < 1.0:
                    s = near + vertex * (far - near)
                    least = min(least, determinant_at(dpsi, drate, _FIRST_NODE, beta, s, matrix, right))
        elif n > 3:
            for m in range(1, SHARES):
                s = near + (far - near) * m / SHARES
                least = min(least, determinant_at(dpsi, drate, _FIRST_NODE, beta, s, matrix, right))
    return least


@merged_kernel
def _turns_back(dpsi, drate, beta, at, matrix, before, right):
    """Tell, by the trace of the step's own matrix, whether two ways of turning lose stability within it."""
    last = matrix.shape[0]
    trace = 0.0
    if last == 2:
        # The inverse of a matrix of two rows is its adjugate over its determinant.
        _relative(dpsi, drate, at, beta, 0.0, matrix)
        _relative(dpsi, drate, at + 1, beta, 0.0, before)
        trace = matrix[0, 0] * before[1, 1] + matrix[1, 1] * before[0, 0]
        trace -= matrix[0, 1] * before[1, 0] + matrix[1, 0] * before[0, 1]
        return trace * (before[0, 0] * before[1, 1] - before[0, 1] * before[1, 0]) <= 0.0
    for c in range(last):
        _relative(dpsi, drate, at, beta, 0.0, matrix)
        _relative(dpsi, drate, at + 1, beta, 0.0, before)
        # Row c of the step's matrix X solves X before = matrix.
        for m in range(last):
            right[m] = matrix[c, m]
            for k in range(m + 1, last):
                before[m, k], before[k, m] = before[k, m], before[m, k]
        solve_in_place(before, right)
        trace += right[c]
    return trace <= 0.0


@kernel()
def solving_scratch(n):
    """Return scratch for n tubes: two matrices, a right side of linear systems, and that of `twist`."""
    last, rows = n - 1, SCRATCH_ROWS if n > FEW else 0
    return np.zeros((last, last)), np.zeros((last, last)), np.zeros(last), np.zeros((rows, n, n))


@kernel(_nrt=False)
def least_determinant(nodes, beta, scratch):
    """Return the least determinant along the tubes; -inf where two directions turn unstable at once."""
    _s, _psi, _rate, dpsi, drate = nodes
    matrix, before, right, _work = scratch
    last = dpsi.shape[2] - 1
    least = 1.0
    if last == 0:
        return least
    for at in range(dpsi.shape[0] - 2, -1, -1):
        least = min(least, determinant_at(dpsi, drate, at, beta, _PLATE, matrix, right))
        if last > 1 and _turns_back(dpsi, drate, beta, at, matrix, before, right):
            return -math.inf
    return min(least, _least_behind(dpsi, drate, beta, matrix, right))


@merged_kernel
def _newton_step(nodes, beta, base_angles, tip_angles, scratch):
    """Move the tip angles towards the wanted base angles; return the largest error before, rad."""
    _s, psi, rate, dpsi, drate = nodes
    matrix, _before, right, _work = scratch
    last = tip_angles.shape[0] - 1
    worst = 0.0
    for i in range(last + 1):
        worst = max(worst, abs(base_angles[i] - psi[0, i] - beta[i] * rate[0, i]))
    if worst < TOLERANCE:
        return worst
    error = base_angles[last] - psi[0, last] - beta[last] * rate[0, last]
    if last > 0:
        for i in range(last):
            right[i] = base_angles[i] - psi[0, i] - beta[i] * rate[0, i] - error
        rearmost = beta[0]
        for i in range(1, last + 1):
            rearmost = min(rearmost, beta[i])
        _relative(dpsi, drate, _FIRST_NODE, beta, rearmost, matrix)
        solve_in_place(matrix, right)
        size = 0.0
        for i in range(last):
            # What is not a number stays.
            size = size if abs(right[i]) <= size or size != size else abs(right[i])
        if not size < LARGEST_TURN:
            factor = LARGEST_TURN / size if size < math.inf else 0.0
            for i in range(last):
                right[i] *= factor
    for c in range(last):
        error -= (dpsi[0, c, last] + beta[last] * drate[0, c, last]) * right[c]
    tip_angles[last] += error
    for c in range(last):
        tip_angles[c] += right[c] + error
    return worst


@borrowing_kernel
def newton(design, cutting, base_angles, beta, nodes, steps, tip_angles, scratch, enough):
    """Let Newton's method find tip angles from a guess, to `enough` of an error; return the last one, rad."""
    worst = math.inf
    for _ in range(NEWTON_STEPS):
        twist(design, cutting, tip_angles, nodes, steps, scratch[3])
        worst = _newton_step(nodes, beta, base_angles, tip_angles, scratch)
        if worst < enough:
            break
    return worst


@merged_kernel
def _continued(design, cutting, base_angles, beta, nodes, steps, tip_angles, scratch):
    """Find tip angles by raising the precurvature from nothing; return the last error, rad."""
    pieces, moments, directions, count = cutting
    tip_angles[:] = base_angles
    kept = tip_angles.copy()
    done, stride, worst = 0.0, 0.125, math.inf
    while done < 1.0 and stride > LEAST_STRIDE:
        share = min(done + stride, 1.0)
        eased = (pieces, math.sqrt(share) * moments, directions, count)
        enough = TOLERANCE if share == 1.0 else NEAR_ENOUGH
        worst = newton(design, eased, base_angles, beta, nodes, steps, tip_angles, scratch, enough)
        if worst < enough:
            done = share
            kept[:] = tip_angles
        else:
            stride *= 0.5
            tip_angles[:] = kept
    return worst if done == 1.0 else math.inf


@merged_kernel
def _tried_all_round(design, cutting, base_angles, beta, nodes, steps, tip_angles, scratch):
    """Start from angles all round until an equilibrium is stable, else take the first; return its error."""
    n = tip_angles.shape[0]
    any_found = math.inf
    kept = base_angles.copy()
    for number in range(ROUND ** (n - 1)):
        code = number
        tip_angles[:] = base_angles
        for i in range(n - 1):
            tip_angles[i] += 2.0 * math.pi * (code % ROUND) / ROUND
            code //= ROUND
        worst = newton(design, cutting, base_angles, beta, nodes, steps, tip_angles, scratch, TOLERANCE)
        if worst < TOLERANCE:
            if least_determinant(nodes, beta, scratch) > 0.0:
                return worst
            if any_found == math.inf:
                any_found = worst
                kept[:] = tip_angles
    tip_angles[:] = kept
    if any_found < math.inf:
        twist(design, cutting, tip_angles, nodes, steps, scratch[3])
    return any_found


@kernel()
def settle(design, cutting, base_angles, beta, nodes, steps, scratch, prefer_stable, tip_angles):
    """Find the equilibrium next to the guess in `tip_angles`, which gets its angles, `nodes` the rest.

    If Newton's method fails from there, or ends at an unstable one and stable ones are preferred, the
    precurvature is raised from nothing, and then angles all round are tried.  Returns the largest error of a
    base angle and the least determinant.
    """
    worst = newton(design, cutting, base_angles, beta, nodes, steps, tip_angles, scratch, TOLERANCE)
    least = least_determinant(nodes, beta, scratch) if worst < TOLERANCE else -math.inf
    if least > 0.0 or (worst < TOLERANCE and not prefer_stable):
        return worst, least
    first, first_worst = tip_angles.copy(), worst
    worst = _continued(design, cutting, base_angles, beta, nodes, steps, tip_angles, scratch)
    least = least_determinant(nodes, beta, scratch) if worst < TOLERANCE else -math.inf
    if least > 0.0:
        return worst, least
    worst = _tried_all_round(design, cutting, base_angles, beta, nodes, steps, tip_angles, scratch)
    least = least_determinant(nodes, beta, scratch) if worst < TOLERANCE else -math.inf
    if least > 0.0 or not first_worst < TOLERANCE:
        return worst, least
    tip_angles[:] = first
    twist(design, cutting, tip_angles, nodes, steps, scratch[3])
    return first_worst, least_determinant(nodes, beta, scratch)


@kernel()
def cutting_scratch(design, n):
    """Return arrays for `assembly.cut` of n tubes: pieces, moments and directions."""
    bodies = design[1].shape[0]
    most = 1 + bodies + 2 * design[2].shape[0]
    return np.zeros((most, PIECE_COLUMNS + bodies)), np.zeros((most, n)), np.zeros((most, n))


@kernel()
def scratch_for(n_steps, n, columns):
    """Return `nodes` and `steps` as `torsion.twist` fills them."""
    angles = np.zeros((2, n_steps + 1, n))
    derivatives = np.zeros((2, n_steps + 1, columns, n))
    nodes = (np.zeros(n_steps + 1), angles[0], angles[1], derivatives[0], derivatives[1])
    return nodes, (np.zeros(n_steps), np.zeros(n_steps, np.int64))


@kernel(nogil=True)
def settle_many(design, base_angles, beta, step, prefer_stable, tip_angles, results):
    """Solve many configurations; `tip_angles` (M, n) holds guesses and gets the answers.

    Base angles `(M, n)` are in rad; `beta` `(M, b)`, mm, is of the tubes and then of straight bodies in them.
    See `settle` for what is preferred.  `results` (M, RESULT_COLUMNS) is filled; the tip frame is that of the
    first tube's material.
    """
    n = base_angles.shape[1]
    pieces, moments, directions = cutting_scratch(design, n)
    nodes, steps = scratch_for(_FIRST_NODE, n, n - 1)
    poses, scratch = np.zeros((1, 12)), solving_scratch(n)
    for m in range(beta.shape[0]):
        count, n_steps = cut(design, beta[m], step, pieces, moments, directions)
        if n_steps + 1 != poses.shape[0]:
            nodes, steps = scratch_for(n_steps, n, n - 1)
            poses = np.zeros((n_steps + 1, 12))
        cutting, tip = (pieces, moments, directions, count), tip_angles[m]
        worst, least = settle(
            design, cutting, base_angles[m], beta[m], nodes, steps, scratch, prefer_stable, tip
        )
        lay(cutting, nodes, steps, poses)
        put_pose(results[m, TIP:], turned(poses[n_steps], tip[0]))
        results[m, CONVERGED] = 1.0 if worst < TOLERANCE else 0.0
        results[m, STABLE] = 1.0 if least > 0.0 else 0.0
        results[m, LEAST_DETERMINANT] = least
        results[m, RESIDUAL] = worst
