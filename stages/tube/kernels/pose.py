"""The tubes' centreline and its frames, laid from the front plate to the tip once torsion is known.

A pose is twelve numbers: rotation by rows, then position in mm.  In the Bishop frame the curvature is

    u = sum_i kb_i kappa_i (cos psi_i, sin psi_i, 0) / sum kb

where psi includes the direction of the precurvature.  A step is the Magnus expansion of order 4 on rigid
motions [Iserles2000]; where one tube alone is bent, curvature is constant in its frame, and the step exact.
"""

import math

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel
from stages.tube.kernels.assembly import BENT, BENT_TUBE, SOFTNESS

GAUSS = 0.5 - math.sqrt(3.0) / 6.0
COMMUTATOR = math.sqrt(3.0) / 12.0
SMALL_ANGLE2 = 1e-6
"""Below this square of an angle, series take the place of quotients that lose digits."""


@inner_kernel
def _exponential(twist, out, row):
    """Write exp of the twist, rotation and translation, as pose `out[row]`."""
    x, y, z = twist[0], twist[1], twist[2]
    u, v, w = twist[3], twist[4], twist[5]
    a2 = x * x + y * y + z * z
    if a2 < SMALL_ANGLE2:
        sine = 1.0 - a2 / 6.0 * (1.0 - a2 / 20.0)
        versine = 0.5 - a2 / 24.0 * (1.0 - a2 / 30.0)
        rest = 1.0 / 6.0 - a2 / 120.0 * (1.0 - a2 / 42.0)
    else:
        a = math.sqrt(a2)
        sine = math.sin(a) / a
        versine = 2.0 * (math.sin(0.5 * a) / a) ** 2
        rest = (1.0 - sine) / a2
    along = rest * (x * u + y * v + z * w)
    straight = 1.0 - rest * a2
    out[row, 0] = 1.0 - versine * (y * y + z * z)
    out[row, 1] = versine * x * y - sine * z
    out[row, 2] = versine * x * z + sine * y
    out[row, 3] = versine * x * y + sine * z
    out[row, 4] = 1.0 - versine * (x * x + z * z)
    out[row, 5] = versine * y * z - sine * x
    out[row, 6] = versine * x * z - sine * y
    out[row, 7] = versine * y * z + sine * x
    out[row, 8] = 1.0 - versine * (x * x + y * y)
    out[row, 9] = straight * u + versine * (y * w - z * v) + along * x
    out[row, 10] = straight * v + versine * (z * u - x * w) + along * y
    out[row, 11] = straight * w + versine * (x * v - y * u) + along * z


@inner_kernel
def _compose(a, i, b, out, k):
    """Write the pose `a[i] b[0]` to `out[k]`."""
    for r in range(3):
        x, y, z = a[i, 3 * r], a[i, 3 * r + 1], a[i, 3 * r + 2]
        out[k, 3 * r] = x * b[0, 0] + y * b[0, 3] + z * b[0, 6]
        out[k, 3 * r + 1] = x * b[0, 1] + y * b[0, 4] + z * b[0, 7]
        out[k, 3 * r + 2] = x * b[0, 2] + y * b[0, 5] + z * b[0, 8]
        out[k, 9 + r] = x * b[0, 9] + y * b[0, 10] + z * b[0, 11] + a[i, 9 + r]


@inner_kernel
def turned(pose, angle, out):
    """Write a pose turned about its own z by `angle`."""
    c, s = math.cos(angle), math.sin(angle)
    for r in range(3):
        x, y = pose[3 * r], pose[3 * r + 1]
        out[3 * r] = c * x + s * y
        out[3 * r + 1] = c * y - s * x
        out[3 * r + 2] = pose[3 * r + 2]
        out[9 + r] = pose[9 + r]


@inner_kernel
def curvature(cutting, k, share, h, psi, rate, at):
    """Return Bishop curvature (x, y) at a share of the step ahead of node `at`, 1/mm, angles on a cubic."""
    pieces, moments, directions, _count = cutting
    t2, t3 = share * share, share * share * share
    a = 1.0 - 3.0 * t2 + 2.0 * t3
    b = (share - 2.0 * t2 + t3) * h
    d = (t3 - t2) * h
    x = y = 0.0
    for i in range(psi.shape[1]):
        if moments[k, i] != 0.0:
            angle = a * psi[at, i] + b * rate[at, i] + (1.0 - a) * psi[at + 1, i] + d * rate[at + 1, i]
            angle += directions[k, i]
            x += moments[k, i] * math.cos(angle)
            y += moments[k, i] * math.sin(angle)
    return pieces[k, SOFTNESS] * x, pieces[k, SOFTNESS] * y


@inner_kernel
def step_of(cutting, nodes, steps, at, begin, end, twist, out):
    """Write the motion along the share from `begin` to `end` of the step ahead of node `at` to `out[0]`.

    `out` is (2, 12); `twist` (6,) gets the twist whose exponential it is, but for a turn about its own z by
    the torsion of the one bent tube, where there is one.
    """
    pieces, moments, directions, _count = cutting
    psi, rate = nodes[1], nodes[2]
    lengths, piece_of = steps
    k = piece_of[at]
    h = (end - begin) * lengths[at]
    twist[:] = 0.0
    twist[5] = h
    if pieces[k, BENT] == 1.0:
        i = int(pieces[k, BENT_TUBE])
        kappa = pieces[k, SOFTNESS] * moments[k, i]
        angle = psi[at, i] + begin * lengths[at] * rate[at, i] + directions[k, i]
        twist[0] = h * kappa * math.cos(angle)
        twist[1] = h * kappa * math.sin(angle)
        twist[2] = h * rate[at, i]
        _exponential(twist, out, 1)
        turned(out[1], -twist[2], out[0])
        return
    if pieces[k, BENT] != 0.0:
        ux1, uy1 = curvature(cutting, k, begin + GAUSS * (end - begin), lengths[at], psi, rate, at)
        ux2, uy2 = curvature(cutting, k, end - GAUSS * (end - begin), lengths[at], psi, rate, at)
        c = COMMUTATOR * h * h
        twist[0] = 0.5 * h * (ux1 + ux2)
        twist[1] = 0.5 * h * (uy1 + uy2)
        twist[2] = c * (ux1 * uy2 - uy1 * ux2)
        twist[3] = c * (uy1 - uy2)
        twist[4] = c * (ux2 - ux1)
    _exponential(twist, out, 0)


@kernel()
def lay(cutting, nodes, steps, poses):
    """Fill `poses` (N + 1, 12) with the Bishop frame of every node; the first is the identity."""
    twist, motion = np.zeros(6), np.zeros((2, 12))
    for m in range(12):
        poses[0, m] = 1.0 if m in (0, 4, 8) else 0.0
    for at in range(steps[0].shape[0]):
        step_of(cutting, nodes, steps, at, 0.0, 1.0, twist, motion)
        _compose(poses, at, motion, poses, at + 1)


@kernel()
def frames_at(cutting, nodes, steps, poses, arc_lengths, found, angles, rates):
    """Fill poses (M, 12), psi and u (M, n) at arc lengths (M,) between front plate and tip."""
    s, psi, rate, _dpsi, _drate = nodes
    lengths = steps[0]
    twist, motion = np.zeros(6), np.zeros((2, 12))
    for m in range(arc_lengths.shape[0]):
        at = min(max(np.searchsorted(s, arc_lengths[m], "right") - 1, 0), lengths.shape[0] - 1)
        h = lengths[at]
        t = min(max((arc_lengths[m] - s[at]) / h, 0.0), 1.0)
        step_of(cutting, nodes, steps, at, 0.0, t, twist, motion)
        _compose(poses, at, motion, found, m)
        a = 1.0 - t * t * (3.0 - 2.0 * t)
        for i in range(psi.shape[1]):
            angles[m, i] = a * psi[at, i] + (1.0 - a) * psi[at + 1, i]
            angles[m, i] += h * t * (1.0 - t) * ((1.0 - t) * rate[at, i] - t * rate[at + 1, i])
            rates[m, i] = 6.0 * t * (1.0 - t) * (psi[at + 1, i] - psi[at, i]) / h
            rates[m, i] += (1.0 - t) * (1.0 - 3.0 * t) * rate[at, i]
            rates[m, i] += t * (3.0 * t - 2.0) * rate[at + 1, i]
