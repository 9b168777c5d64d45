"""Torsion of nested precurved tubes, integrated from tip to base [Rucker2010], [Dupont2010].

With the Bishop frame of the centreline, tube i is turned by the angle psi_i and twisted by u_i = psi_i', and

    u_i' = -(1 / kt_i) sum_j [kb_i kappa_i kb_j kappa_j / sum kb] sin(psi_j - psi_i)

where psi includes the direction of the precurvature, and u_i = 0 at the end of each tube.  Angles at the tip
are given, so this is an initial value problem; its derivatives by them are carried along.
"""

import math

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from stages.tube.kernels.assembly import FAR, NEAR, SOFTNESS, STEPS

# Nystroem's method of order 5 for y'' = f(y) [Hairer1993, sec. II.14].
C2, C3 = 1.0 / 5.0, 2.0 / 3.0
A21 = 1.0 / 50.0
A31, A32 = -1.0 / 27.0, 7.0 / 27.0
A41, A42, A43 = 3.0 / 10.0, -2.0 / 35.0, 9.0 / 35.0
P1, P2, P3 = 14.0 / 336.0, 100.0 / 336.0, 54.0 / 336.0
R1, R2, R3, R4 = 14.0 / 336.0, 125.0 / 336.0, 162.0 / 336.0, 35.0 / 336.0


# Rows of the scratch: pulls at the four stages of a step, and the angles at which they are looked for.
ANGLES, SCRATCH_ROWS = 4, 5
# Columns of `pairs`: two bent tubes, what their sine pulls at each, and the angle between them at rest.
FIRST, SECOND, PULL_FIRST, PULL_SECOND, REST, PAIR_COLUMNS = range(6)


@merged_kernel
def _pair_up(torsional, pieces, moments, directions, k, pairs):
    """Fill `pairs` with the pairs of bent tubes in piece `k`; return how many there are."""
    count = 0
    n = moments.shape[1]
    for i in range(n):
        for j in range(i + 1, n):
            most = pieces[k, SOFTNESS] * moments[k, i] * moments[k, j]
            if most != 0.0:
                pairs[count, FIRST] = i
                pairs[count, SECOND] = j
                pairs[count, PULL_FIRST] = most / torsional[i, 1]
                pairs[count, PULL_SECOND] = most / torsional[j, 1]
                pairs[count, REST] = directions[k, j] - directions[k, i]
                count += 1
    return count


@inner_kernel
def _pull(pairs, count, angles, pull):
    """Fill `pull` (1 + columns, n) with psi'' at `angles`, and with its derivatives."""
    rows, n = pull.shape
    for row in range(rows):
        for i in range(n):
            pull[row, i] = 0.0
    for p in range(count):
        i, j = int(pairs[p, FIRST]), int(pairs[p, SECOND])
        one, two = pairs[p, PULL_FIRST], pairs[p, PULL_SECOND]
        angle = angles[0, j] - angles[0, i] + pairs[p, REST]
        sine, cosine = math.sin(angle), math.cos(angle)
        pull[0, i] -= one * sine
        pull[0, j] += two * sine
        for row in range(1, rows):
            change = cosine * (angles[row, j] - angles[row, i])
            pull[row, i] -= one * change
            pull[row, j] += two * change


@inner_kernel
def _look_ahead(nodes, at, h, share, a1, a2, a3, work):
    """Put into `work[ANGLES]` the angles at a share of the step down from node `at`, and derivatives."""
    _s, psi, rate, dpsi, drate = nodes
    along, h2 = share * h, h * h
    for i in range(work.shape[2]):
        bent = a1 * work[0, 0, i] + a2 * work[1, 0, i] + a3 * work[2, 0, i]
        work[ANGLES, 0, i] = psi[at, i] - along * rate[at, i] + h2 * bent
    for c in range(work.shape[1] - 1):
        for i in range(work.shape[2]):
            bent = a1 * work[0, c + 1, i] + a2 * work[1, c + 1, i] + a3 * work[2, c + 1, i]
            work[ANGLES, c + 1, i] = dpsi[at, c, i] - along * drate[at, c, i] + h2 * bent


@merged_kernel
def _look_from(nodes, at, h, pairs, count, work):
    """Fill the four stages of `work` of the step of `h` down from node `at`."""
    _look_ahead(nodes, at, h, 0.0, 0.0, 0.0, 0.0, work)
    _pull(pairs, count, work[ANGLES], work[0])
    _look_ahead(nodes, at, h, C2, A21, 0.0, 0.0, work)
    _pull(pairs, count, work[ANGLES], work[1])
    _look_ahead(nodes, at, h, C3, A31, A32, 0.0, work)
    _pull(pairs, count, work[ANGLES], work[2])
    _look_ahead(nodes, at, h, 1.0, A41, A42, A43, work)
    _pull(pairs, count, work[ANGLES], work[3])


@inner_kernel
def _step(nodes, at, h, pairs, count, work):
    """Take a step of -h from node `at` to the one before it; `rate` is along s, so its sign is turned."""
    _s, psi, rate, dpsi, drate = nodes
    _look_from(nodes, at, h, pairs, count, work)
    h2 = h * h
    for i in range(work.shape[2]):
        bent = P1 * work[0, 0, i] + P2 * work[1, 0, i] + P3 * work[2, 0, i]
        turned = R1 * work[0, 0, i] + R2 * work[1, 0, i] + R3 * work[2, 0, i] + R4 * work[3, 0, i]
        psi[at - 1, i] = psi[at, i] - h * rate[at, i] + h2 * bent
        rate[at - 1, i] = rate[at, i] - h * turned
        for c in range(work.shape[1] - 1):
            dbent = P1 * work[0, c + 1, i] + P2 * work[1, c + 1, i] + P3 * work[2, c + 1, i]
            dturned = R1 * work[0, c + 1, i] + R2 * work[1, c + 1, i]
            dturned += R3 * work[2, c + 1, i] + R4 * work[3, c + 1, i]
            dpsi[at - 1, c, i] = dpsi[at, c, i] - h * drate[at, c, i] + h2 * dbent
            drate[at - 1, c, i] = drate[at, c, i] - h * dturned


@merged_kernel
def _coast(nodes, at, h):
    """Take a step of -h from node `at` where no two tubes are bent: torsion stays."""
    _s, psi, rate, dpsi, drate = nodes
    for i in range(psi.shape[1]):
        psi[at - 1, i] = psi[at, i] - h * rate[at, i]
        rate[at - 1, i] = rate[at, i]
        for c in range(dpsi.shape[1]):
            dpsi[at - 1, c, i] = dpsi[at, c, i] - h * drate[at, c, i]
            drate[at - 1, c, i] = drate[at, c, i]


@kernel()
def twist(design, cutting, tip_angles, nodes, steps):
    """Integrate torsion from the tip to the front plate.

    Args:
        design (tuple): See `assembly`.
        cutting (tuple): pieces, moments, directions, and the number of pieces, as `assembly.cut` fills them.
        tip_angles ((n,) float64): psi_i at the end of each tube, rad.
        nodes (tuple): s (N + 1,), psi and u in rad and rad/mm (N + 1, n), their derivatives by the tip angles
            of the first m tubes (N + 1, m, n); node 0 is at the front plate, node N at the tip.  Is filled.
        steps (tuple): Length in mm (N,) and the piece (N,) int64 of each step.  Is filled.
    """
    pieces, moments, directions, count = cutting
    s, psi, rate, dpsi, drate = nodes
    lengths, piece_of = steps
    n, columns, at = tip_angles.shape[0], dpsi.shape[1], lengths.shape[0]
    work = np.zeros((SCRATCH_ROWS, columns + 1, n))
    pairs = np.zeros((n * (n - 1) // 2, PAIR_COLUMNS))
    s[at] = pieces[count - 1, FAR] if count > 0 else 0.0
    for i in range(n):
        psi[at, i], rate[at, i] = tip_angles[i], 0.0
        for c in range(columns):
            dpsi[at, c, i] = 1.0 if c == i else 0.0
            drate[at, c, i] = 0.0
    for k in range(count - 1, -1, -1):
        number = int(pieces[k, STEPS])
        bent = _pair_up(design[0], pieces, moments, directions, k, pairs)
        h = (pieces[k, FAR] - pieces[k, NEAR]) / number
        for m in range(number):
            at -= 1
            s[at] = pieces[k, NEAR] + (number - 1 - m) * h
            lengths[at], piece_of[at] = h, k
            if bent > 0:
                _step(nodes, at + 1, h, pairs, bent, work)
            else:
                _coast(nodes, at + 1, h)
