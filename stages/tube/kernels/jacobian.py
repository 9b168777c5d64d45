"""How the tip moves with tip angles and shifts of the tubes, exactly for the discrete steps.

A motion is a spatial twist (rotation, translation) in the frame of the front plate: a point p fixed to the
tubes moves by `rotation x p + translation`.
"""

import math

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from stages.tube.kernels.assembly import BENT, BENT_TUBE, SOFTNESS
from stages.tube.kernels.pose import COMMUTATOR, GAUSS, step_of

TERMS = 14
"""After so many terms of the exponential's derivative the rest is below rounding for a step of a radian."""


@inner_kernel
def _derivative_of_exponential(twist, change, out):
    """Write the motion that a change of a twist makes to its exponential, before the motion itself."""
    term = np.zeros(6)
    for m in range(6):
        term[m] = out[m] = change[m]
    for n in range(2, TERMS):
        a, b, c = term[0], term[1], term[2]
        d, e, f = term[3], term[4], term[5]
        term[0] = (twist[1] * c - twist[2] * b) / n
        term[1] = (twist[2] * a - twist[0] * c) / n
        term[2] = (twist[0] * b - twist[1] * a) / n
        term[3] = (twist[1] * f - twist[2] * e + twist[4] * c - twist[5] * b) / n
        term[4] = (twist[2] * d - twist[0] * f + twist[5] * a - twist[3] * c) / n
        term[5] = (twist[0] * e - twist[1] * d + twist[3] * b - twist[4] * a) / n
        for m in range(6):
            out[m] += term[m]


@inner_kernel
def _add_moved(pose, motion, total):
    """Add a motion, seen in a pose, to one seen from the front plate."""
    rx = pose[0] * motion[0] + pose[1] * motion[1] + pose[2] * motion[2]
    ry = pose[3] * motion[0] + pose[4] * motion[1] + pose[5] * motion[2]
    rz = pose[6] * motion[0] + pose[7] * motion[1] + pose[8] * motion[2]
    total[0] += rx
    total[1] += ry
    total[2] += rz
    total[3] += (
        pose[0] * motion[3] + pose[1] * motion[4] + pose[2] * motion[5] + pose[10] * rz - pose[11] * ry
    )
    total[4] += pose[3] * motion[3] + pose[4] * motion[4] + pose[5] * motion[5] + pose[11] * rx - pose[9] * rz
    total[5] += pose[6] * motion[3] + pose[7] * motion[4] + pose[8] * motion[5] + pose[9] * ry - pose[10] * rx


@inner_kernel
def _curvature_change(softness, moments, directions, share, h, dh, ends, changes, out):
    """Write curvature (x, y) at a share of a step and its change."""
    psi0, rate0, psi1, rate1 = ends
    dpsi0, drate0, dpsi1, drate1 = changes
    t2, t3 = share * share, share * share * share
    a = 1.0 - 3.0 * t2 + 2.0 * t3
    b = share - 2.0 * t2 + t3
    d = t3 - t2
    for m in range(4):
        out[m] = 0.0
    for i in range(psi0.shape[0]):
        if moments[i] == 0.0:
            continue
        angle = a * psi0[i] + (1.0 - a) * psi1[i] + h * (b * rate0[i] + d * rate1[i]) + directions[i]
        dangle = a * dpsi0[i] + (1.0 - a) * dpsi1[i] + h * (b * drate0[i] + d * drate1[i])
        dangle += dh * (b * rate0[i] + d * rate1[i])
        x = softness * moments[i] * math.cos(angle)
        y = softness * moments[i] * math.sin(angle)
        out[0] += x
        out[1] += y
        out[2] -= y * dangle
        out[3] += x * dangle


@merged_kernel
def _twist_change(softness, moments, directions, h, dh, ends, changes, first, second, out):
    """Write the change of a Magnus step's twist."""
    _curvature_change(softness, moments, directions, GAUSS, h, dh, ends, changes, first)
    _curvature_change(softness, moments, directions, 1.0 - GAUSS, h, dh, ends, changes, second)
    k = COMMUTATOR * h * h
    dk = 2.0 * COMMUTATOR * h * dh
    out[0] = 0.5 * (dh * (first[0] + second[0]) + h * (first[2] + second[2]))
    out[1] = 0.5 * (dh * (first[1] + second[1]) + h * (first[3] + second[3]))
    out[2] = dk * (first[0] * second[1] - first[1] * second[0])
    out[2] += k * (first[2] * second[1] + first[0] * second[3] - first[3] * second[0] - first[1] * second[2])
    out[3] = dk * (first[1] - second[1]) + k * (first[3] - second[3])
    out[4] = dk * (second[0] - first[0]) + k * (second[2] - first[2])
    out[5] = dh


@kernel()
def motions(cutting, nodes, steps, poses, moved):
    """Fill `moved` (columns, 6) with the tip's motion by each parameter of `torsion.twist`."""
    pieces, moments, directions, _count = cutting
    _s, psi, rate, dpsi, drate = nodes
    lengths, dlengths, piece_of = steps
    twist, change, local = np.zeros(6), np.zeros(6), np.zeros(6)
    first, second = np.zeros(4), np.zeros(4)
    motion = np.zeros((2, 12))
    moved[:] = 0.0
    for at in range(lengths.shape[0]):
        k = piece_of[at]
        piece = pieces[k]
        h = lengths[at]
        step_of(cutting, nodes, steps, at, 0.0, 1.0, twist, motion)
        i = int(piece[BENT_TUBE])
        for c in range(moved.shape[0]):
            dh = dlengths[at, c]
            if piece[BENT] == 1.0:
                # Along the arc of the one bent tube, then turned back by its torsion.
                change[:] = 0.0
                change[0] = dh / h * twist[0] - twist[1] * dpsi[at, c, i]
                change[1] = dh / h * twist[1] + twist[0] * dpsi[at, c, i]
                change[2] = dh * rate[at, i] + h * drate[at, c, i]
                change[5] = dh
                _derivative_of_exponential(twist, change, local)
                _add_moved(poses[at], local, moved[c])
                local[:] = 0.0
                local[2] = -change[2]
                _add_moved(poses[at + 1], local, moved[c])
            else:
                ends = (psi[at], rate[at], psi[at + 1], rate[at + 1])
                changes = (dpsi[at, c], drate[at, c], dpsi[at + 1, c], drate[at + 1, c])
                _twist_change(
                    piece[SOFTNESS], moments[k], directions[k], h, dh, ends, changes, first, second, change
                )
                _derivative_of_exponential(twist, change, local)
                _add_moved(poses[at], local, moved[c])
