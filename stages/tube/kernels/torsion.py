"""Torsion of nested precurved tubes, integrated from tip to base [Rucker2010], [Dupont2010].

With the Bishop frame of the centreline, tube i is turned by the angle psi_i and twisted by u_i = psi_i', and

    u_i' = -(1 / kt_i) sum_j [kb_i kappa_i kb_j kappa_j / sum kb] sin(psi_j - psi_i)

where psi includes the direction of the precurvature, and u_i = 0 at the end of each tube.  Angles at the tip
are given, so this is an initial value problem; its derivatives are carried along.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from anatomy.kernels.compiling import inner_kernel
from stages.tube.kernels.assembly import FAR, FAR_OWNER, NEAR, NEAR_OWNER, SOFTNESS, STEPS

# Nystroem's method of order 5 for y'' = f(y) [Hairer1993, sec. II.14].
C2, C3 = 1.0 / 5.0, 2.0 / 3.0
A21 = 1.0 / 50.0
A31, A32 = -1.0 / 27.0, 7.0 / 27.0
A41, A42, A43 = 3.0 / 10.0, -2.0 / 35.0, 9.0 / 35.0
P1, P2, P3 = 14.0 / 336.0, 100.0 / 336.0, 54.0 / 336.0
R1, R2, R3, R4 = 14.0 / 336.0, 125.0 / 336.0, 162.0 / 336.0, 35.0 / 336.0


@inner_kernel
def _pull(torsional, softness, moments, directions, psi, dpsi, f, df):
    """Fill `f` (n,) with psi'' and `df` (columns, n) with its derivatives."""
    n = psi.shape[0]
    for i in range(n):
        f[i] = 0.0
    for c in range(df.shape[0]):
        for i in range(n):
            df[c, i] = 0.0
    for i in range(n):
        if moments[i] == 0.0:
            continue
        for j in range(i + 1, n):
            if moments[j] == 0.0:
                continue
            most = softness * moments[i] * moments[j]
            angle = psi[j] + directions[j] - psi[i] - directions[i]
            pull = most * math.sin(angle)
            stiffening = most * math.cos(angle)
            f[i] -= pull / torsional[i, 1]
            f[j] += pull / torsional[j, 1]
            for c in range(df.shape[0]):
                change = stiffening * (dpsi[c, j] - dpsi[c, i])
                df[c, i] -= change / torsional[i, 1]
                df[c, j] += change / torsional[j, 1]


@inner_kernel
def _step(torsional, softness, moments, directions, h, dh, psi, rate, dpsi, drate, new, work, dwork):
    """Take a step of -h; `new` gets (psi, rate, dpsi, drate) at its end.

    `rate` is along s, but the step goes down: its sign is turned where it enters and leaves.
    """
    n = psi.shape[0]
    columns = dh.shape[0]
    y = work[4]
    dy = dwork[4]
    _pull(torsional, softness, moments, directions, psi, dpsi, work[0], dwork[0])
    for stage in range(1, 4):
        c = C2 if stage == 1 else (C3 if stage == 2 else 1.0)
        a1 = A21 if stage == 1 else (A31 if stage == 2 else A41)
        a2 = 0.0 if stage == 1 else (A32 if stage == 2 else A42)
        a3 = A43 if stage == 3 else 0.0
        for i in range(n):
            y[i] = psi[i] - c * h * rate[i] + h * h * (a1 * work[0, i] + a2 * work[1, i] + a3 * work[2, i])
        for k in range(columns):
            for i in range(n):
                bent = a1 * work[0, i] + a2 * work[1, i] + a3 * work[2, i]
                dbent = a1 * dwork[0, k, i] + a2 * dwork[1, k, i] + a3 * dwork[2, k, i]
                dy[k, i] = dpsi[k, i] - c * (dh[k] * rate[i] + h * drate[k, i])
                dy[k, i] += 2.0 * h * dh[k] * bent + h * h * dbent
        _pull(torsional, softness, moments, directions, y, dy, work[stage], dwork[stage])
    for i in range(n):
        bent = P1 * work[0, i] + P2 * work[1, i] + P3 * work[2, i]
        turned = R1 * work[0, i] + R2 * work[1, i] + R3 * work[2, i] + R4 * work[3, i]
        new[0][i] = psi[i] - h * rate[i] + h * h * bent
        new[1][i] = rate[i] - h * turned
        for k in range(columns):
            dbent = P1 * dwork[0, k, i] + P2 * dwork[1, k, i] + P3 * dwork[2, k, i]
            dturned = R1 * dwork[0, k, i] + R2 * dwork[1, k, i] + R3 * dwork[2, k, i] + R4 * dwork[3, k, i]
            new[2][k, i] = dpsi[k, i] - dh[k] * rate[i] - h * drate[k, i]
            new[2][k, i] += 2.0 * h * dh[k] * bent + h * h * dbent
            new[3][k, i] = drate[k, i] - dh[k] * turned - h * dturned


@numba.njit(cache=True)
def twist(design, cutting, tip_angles, owners, nodes, steps):
    """Integrate torsion from the tip to the front plate.

    Parameters
    ----------
    design : tuple
        See `assembly`.
    cutting : tuple
        pieces, moments, directions, and the number of pieces, as `assembly.cut` fills them.
    tip_angles : (n,) float64
        psi_i at the end of each tube, rad.
    owners : (m,) int64
        Derivatives wanted: that by the tip angle of tube c is -1 - c, that by its shift is c.
    nodes : tuple
        s (N + 1,), psi and u in rad and rad/mm (N + 1, n), their derivatives (N + 1, m, n); node 0 is at
        the front plate, node N at the tip.  Is filled.
    steps : tuple
        Length in mm (N,), its derivatives (N, m), and the piece (N,) int64 of each step.  Is filled.
    """
    pieces, moments, directions, count = cutting
    s, psi, rate, dpsi, drate = nodes
    lengths, dlengths, piece_of = steps
    n = tip_angles.shape[0]
    columns = owners.shape[0]
    at = lengths.shape[0]
    work = np.zeros((5, n))
    dwork = np.zeros((5, columns, n))
    s[at] = pieces[count - 1, FAR] if count > 0 else 0.0
    for i in range(n):
        psi[at, i] = tip_angles[i]
        rate[at, i] = 0.0
        for c in range(columns):
            dpsi[at, c, i] = 1.0 if owners[c] == -1 - i else 0.0
            drate[at, c, i] = 0.0
    for k in range(count - 1, -1, -1):
        number = int(pieces[k, STEPS])
        h = (pieces[k, FAR] - pieces[k, NEAR]) / number
        for m in range(number):
            at -= 1
            s[at] = pieces[k, NEAR] + (number - 1 - m) * h
            lengths[at] = h
            piece_of[at] = k
            for c in range(columns):
                moved = 0.0
                if owners[c] >= 0:
                    moved += 1.0 if pieces[k, FAR_OWNER] == owners[c] else 0.0
                    moved -= 1.0 if pieces[k, NEAR_OWNER] == owners[c] else 0.0
                dlengths[at, c] = moved / number
            new = (psi[at], rate[at], dpsi[at], drate[at])
            _step(
                design[0], pieces[k, SOFTNESS], moments[k], directions[k], h, dlengths[at],
                psi[at + 1], rate[at + 1], dpsi[at + 1], drate[at + 1], new, work, dwork,
            )  # fmt: skip
