"""Algorithm 2 of [Rosell2012], and eqs. 3 to 9: the path of the scope and its best motion."""

import math

import numpy as np

from anatomy.kernels.compiling import inlined_kernel, inner_kernel, kernel
from anatomy.kernels.random import uniform
from stages.scope.advisor.kernels.chain import circle_curvature, move_base, tip_of
from stages.scope.advisor.kernels.collision import base_fits, body_fits, distance_to, voxel_of

REACH = 5
"""Candidates on either side of the middle one, for twist and for bend."""
CANDIDATES = (2 * REACH + 1) ** 2

TWIST, BEND, VERDICT, POTENTIAL, GRADIENT, COST_NF1, COST_CLEARANCE, COST_TWIST, COST, LOOK_X = range(10)
COLUMNS = LOOK_X + 3
"""Columns of the table of candidates; the look-at point takes the last three."""

OUT_OF_RANGE, RISES, COLLIDES, VALID = 0.0, 1.0, 2.0, 3.0
"""Verdicts."""

REACHED, STUCK, FULL = 0, 1, 2
"""How a run ends."""


@inlined_kernel
def clearance_gradient(lumen, voxel, out):
    """Fill `out` (3,) with the gradient of the clearance (eq. 5); the clearance of wall voxels is 0."""
    for row in range(3):
        out[row] = 0.0
    here = lumen.clearance[voxel]
    i, j, k = lumen.voxels[voxel, 0], lumen.voxels[voxel, 1], lumen.voxels[voxel, 2]
    ni, nj, nk = lumen.numbers.shape
    for di in range(-1, 2):
        for dj in range(-1, 2):
            for dk in range(-1, 2):
                a, b, c = i + di, j + dj, k + dk
                there = 0.0
                if 0 <= a < ni and 0 <= b < nj and 0 <= c < nk and lumen.numbers[a, b, c] >= 0:
                    there = lumen.clearance[lumen.numbers[a, b, c]]
                for row in range(3):
                    m = lumen.lps_from_ijk[row]
                    out[row] += (m[0] * di + m[1] * dj + m[2] * dk) * (there - here)


@inlined_kernel
def share(value, low, high):
    """Return where a value lies between two others, 0 if they are equal."""
    return (value - low) / (high - low) if high > low else 0.0


@inlined_kernel
def twist_cost(scope, alpha, beta, alpha_now):
    """Return K_alpha (eq. 8), angles in shares of the largest value of their range."""
    largest = max(abs(scope.twist_low), abs(scope.twist_high))
    most = max(abs(scope.bend_low), abs(scope.bend_high))
    a = alpha / largest if largest > 0.0 else 0.0
    a0 = alpha_now / largest if largest > 0.0 else 0.0
    b = beta / most if most > 0.0 else 0.0
    return 0.5 * (1.0 - abs(b)) * abs(a) + 0.25 * abs(a - a0)


@inlined_kernel
def evaluate_motion(lumen, scope, state, distance, alpha, beta, voxel, gradient, row, scratch, joints):
    """Fill `row` with the verdict, the potential, cg (eq. 6) and the look-at point of one motion."""
    row[TWIST] = alpha
    row[BEND] = beta
    row[POTENTIAL] = np.inf
    for column in range(GRADIENT, COST):
        row[column] = 0.0
    row[COST] = np.inf
    move_base(state, scope.link, circle_curvature(scope.link, scope.links, beta), distance, alpha, scratch)
    x, y, z = tip_of(scratch, scope.link, scope.links, alpha, beta)
    row[LOOK_X], row[LOOK_X + 1], row[LOOK_X + 2] = x, y, z
    there = voxel_of(lumen, x, y, z)
    if there < 0:
        row[VERDICT] = COLLIDES
        return
    row[POTENTIAL] = lumen.potential[there]
    if not row[POTENTIAL] < lumen.potential[voxel]:
        row[VERDICT] = RISES
        return
    row[VERDICT] = COLLIDES
    if not body_fits(lumen, scope, scratch, alpha, beta, joints):
        return
    if scope.radius > 0.0 and not base_fits(lumen, scope, state, alpha, beta, distance, scratch):
        return
    row[VERDICT] = VALID
    norm = 0.0
    dot = 0.0
    for axis in range(3):
        m = lumen.lps_from_ijk[axis]
        d = 0.0
        for b in range(3):
            d += m[b] * (lumen.voxels[there, b] - lumen.voxels[voxel, b])
        norm += d * d
        dot += d * gradient[axis]
    row[GRADIENT] = max(dot / math.sqrt(norm), 0.0) if norm > 0.0 else 0.0


@inlined_kernel
def fill_costs(scope, table, count, weights, alpha_now):
    """Fill the costs of the valid rows (eqs. 4 and 7 to 9); the extremes of the first `count` normalise."""
    low_p, high_p, low_g, high_g = np.inf, -np.inf, np.inf, -np.inf
    for n in range(count):
        if table[n, VERDICT] == VALID:
            low_p = min(low_p, table[n, POTENTIAL])
            high_p = max(high_p, table[n, POTENTIAL])
            low_g = min(low_g, table[n, GRADIENT])
            high_g = max(high_g, table[n, GRADIENT])
    for n in range(table.shape[0]):
        row = table[n]
        if row[VERDICT] != VALID:
            continue
        row[COST_NF1] = min(max(share(row[POTENTIAL], low_p, high_p), 0.0), 1.0)
        clearer = share(row[GRADIENT], low_g, high_g) if high_g > low_g else 1.0
        row[COST_CLEARANCE] = min(max(1.0 - clearer, 0.0), 1.0)
        row[COST_TWIST] = twist_cost(scope, row[TWIST], row[BEND], alpha_now)
        row[COST] = (
            weights[0] * row[COST_NF1] + weights[1] * row[COST_CLEARANCE] + weights[2] * row[COST_TWIST]
        )


@inlined_kernel
def best_of(table, count):
    """Return the row of least cost, on ties the first in the order twist by twist; -1 if none is valid."""
    best = -1
    for n in range(count):
        if table[n, VERDICT] == VALID and (best < 0 or table[n, COST] < table[best, COST]):
            best = n
    return best


@inner_kernel
def evaluate_candidates(lumen, scope, state, ahead, weights, offsets, table, gradient, scratch, joints):
    """Fill the table of all candidates (eq. 3) and return the best one, -1 if none is valid.

    `offsets` (121, 2) are shares, from -0.5 to 0.5, of the spacing of twist and bend.  A row beyond the
    candidates, if there is one, holds the twist and bend of a motion that is evaluated like them.
    """
    x, y, z = tip_of(state, scope.link, scope.links, state[12], state[13])
    voxel = voxel_of(lumen, x, y, z)
    for n in range(table.shape[0]):
        table[n, VERDICT] = OUT_OF_RANGE
        table[n, COST] = np.inf
    if voxel < 0:
        return -1
    clearance_gradient(lumen, voxel, gradient)
    twist_step = (scope.twist_high - scope.twist_low) / (2.0 * REACH)
    n = -1
    for i in range(-REACH, REACH + 1):
        for j in range(-REACH, REACH + 1):
            n += 1
            beta = state[13] + j * scope.bend_step
            alpha = scope.sweep_middle + i * twist_step
            inside = scope.bend_low - 1e-12 <= beta <= scope.bend_high + 1e-12
            if i != 0 or j != 0:
                alpha += offsets[n, 0] * twist_step
                beta += offsets[n, 1] * scope.bend_step
            alpha = min(max(alpha, scope.twist_low), scope.twist_high)
            beta = min(max(beta, scope.bend_low), scope.bend_high)
            table[n, TWIST] = alpha
            table[n, BEND] = beta
            if inside:
                evaluate_motion(
                    lumen, scope, state, ahead, alpha, beta, voxel, gradient, table[n], scratch, joints
                )
    for n in range(CANDIDATES, table.shape[0]):
        alpha, beta = table[n, TWIST], table[n, BEND]
        evaluate_motion(lumen, scope, state, ahead, alpha, beta, voxel, gradient, table[n], scratch, joints)
    fill_costs(scope, table, CANDIDATES, weights, state[12])
    return best_of(table, CANDIDATES)


@kernel()
def best_motion(lumen, scope, state, look_ahead, weights, offsets, table):
    """Call `evaluate_candidates` from Python."""
    scratch = np.zeros(14)
    joints = np.zeros((scope.links + 1, 3))
    return evaluate_candidates(
        lumen, scope, state, look_ahead, weights, offsets, table, np.zeros(3), scratch, joints
    )


@inner_kernel
def take_sub_step(lumen, scope, state, ahead, step, row, looks, out, joints):
    """Write the state `out` after a sub-step to a candidate; tell if all its `looks` poses are free."""
    part = step / ahead
    alpha = state[12] + (row[TWIST] - state[12]) * part
    beta = state[13] + (row[BEND] - state[13]) * part
    kappa = circle_curvature(scope.link, scope.links, beta)
    if scope.radius > 0.0 and not base_fits(lumen, scope, state, alpha, beta, step, out):
        return False
    for n in range(1, looks + 1):
        f = n / looks
        move_base(state, scope.link, kappa, f * step, alpha, out)
        out[12] = state[12] + f * (alpha - state[12])
        out[13] = state[13] + f * (beta - state[13])
        if not body_fits(lumen, scope, out, out[12], out[13], joints):
            return False
    return True


@kernel(nogil=True)
def compute_path(lumen, scope, weights, goal, steps, randomness, looks, states, info):
    """Algorithm 2: follow the best motions from `states[0]`; return the number of states and the end.

    `steps` is (4,): look-ahead (with a true radius not beyond the goal), sub-step, the least look-ahead that
    is tried when there is no valid candidate, and how far the scope may advance at most, mm.  `randomness`
    is a (1,) uint64 state; 0 means no random offsets.  Each further row of `states` (M, 14) is a state, of
    `info` (M, 4) its cost, look-ahead, sub-step and potential.
    """
    table = np.zeros((CANDIDATES, COLUMNS))
    offsets = np.zeros((CANDIDATES, 2))
    gradient = np.zeros(3)
    scratch = np.zeros(14)
    joints = np.zeros((scope.links + 1, 3))
    random = randomness[0] != 0
    left = steps[3]
    count = 1
    while True:
        state = states[count - 1]
        x, y, z = tip_of(state, scope.link, scope.links, state[12], state[13])
        here = voxel_of(lumen, x, y, z)
        info[count - 1, 3] = lumen.potential[here] if here >= 0 else np.inf
        if here == goal:
            return count, REACHED
        if left <= 0.0 or count == states.shape[0]:
            return count, FULL
        if random:
            for n in range(CANDIDATES):
                offsets[n, 0] = uniform(randomness) - 0.5
                offsets[n, 1] = uniform(randomness) - 0.5
        ahead = steps[0]
        if scope.radius > 0.0:
            ahead = min(ahead, max(distance_to(lumen, goal, x, y, z), steps[2]))
        moved = False
        while not moved:
            best = evaluate_candidates(
                lumen, scope, state, ahead, weights, offsets, table, gradient, scratch, joints
            )
            step = min(steps[1], ahead)
            while best >= 0 and not moved:
                if take_sub_step(lumen, scope, state, ahead, step, table[best], looks, states[count], joints):
                    moved = True
                else:
                    table[best, VERDICT] = COLLIDES
                    best = best_of(table, CANDIDATES)
            if moved:
                info[count, 0] = table[best, COST]
                info[count, 1] = ahead
                info[count, 2] = step
                left -= step
            elif ahead <= steps[2]:
                return count, STUCK
            else:
                ahead = max(0.5 * ahead, steps[2])
        count += 1
