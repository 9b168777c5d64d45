"""The tubes' centreline and its frames, laid from the front plate to the tip once torsion is known.

A pose is twelve numbers: rotation by rows, then position in mm.  In the Bishop frame the curvature is

    u = sum_i kb_i kappa_i (cos psi_i, sin psi_i, 0) / sum kb

where psi includes the direction of the precurvature.  A step is the Magnus expansion of order 4 on rigid
motions [Iserles2000]; where one tube alone is bent, curvature is constant in its frame, and the step exact.
"""

import math

import numpy as np

from anatomy.kernels.compiling import borrowing_kernel, inlined_kernel, kernel, merged_kernel
from stages.tube.kernels.assembly import BENT, BENT_TUBE, SOFTNESS

GAUSS = 0.5 - math.sqrt(3.0) / 6.0
COMMUTATOR = math.sqrt(3.0) / 12.0
SMALL_ANGLE2 = 1e-6
"""Below this square of an angle, series take the place of quotients that lose digits."""


@inlined_kernel
def _exponential(x, y, z, u, v, w):
    """Return exp of a twist, rotation (x, y, z) and translation (u, v, w), as a pose."""
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
    return (
        1.0 - versine * (y * y + z * z), versine * x * y - sine * z, versine * x * z + sine * y,
        versine * x * y + sine * z, 1.0 - versine * (x * x + z * z), versine * y * z - sine * x,
        versine * x * z - sine * y, versine * y * z + sine * x, 1.0 - versine * (x * x + y * y),
        straight * u + versine * (y * w - z * v) + along * x,
        straight * v + versine * (z * u - x * w) + along * y,
        straight * w + versine * (x * v - y * u) + along * z,
    )  # fmt: skip


@merged_kernel
def _compose(a, i, b, out, k):
    """Write the pose `a[i] b` to `out[k]`."""
    for r in range(3):
        x, y, z = a[i, 3 * r], a[i, 3 * r + 1], a[i, 3 * r + 2]
        out[k, 3 * r] = x * b[0] + y * b[3] + z * b[6]
        out[k, 3 * r + 1] = x * b[1] + y * b[4] + z * b[7]
        out[k, 3 * r + 2] = x * b[2] + y * b[5] + z * b[8]
        out[k, 9 + r] = x * b[9] + y * b[10] + z * b[11] + a[i, 9 + r]


@borrowing_kernel
def turned(pose, angle):
    """Return a pose turned about its own z by `angle`."""
    c, s = math.cos(angle), math.sin(angle)
    return (
        c * pose[0] + s * pose[1], c * pose[1] - s * pose[0], pose[2],
        c * pose[3] + s * pose[4], c * pose[4] - s * pose[3], pose[5],
        c * pose[6] + s * pose[7], c * pose[7] - s * pose[6], pose[8],
        pose[9], pose[10], pose[11],
    )  # fmt: skip


@borrowing_kernel
def put_pose(out, pose):
    """Write a pose to `out`."""
    for m in range(12):
        out[m] = pose[m]


@borrowing_kernel
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


@borrowing_kernel
def step_of(cutting, nodes, steps, at, begin, end):
    """Return the motion along the share from `begin` to `end` of the step ahead of node `at`."""
    pieces, moments, directions, _count = cutting
    psi, rate = nodes[1], nodes[2]
    lengths, piece_of = steps
    k = piece_of[at]
    h = (end - begin) * lengths[at]
    if pieces[k, BENT] == 1.0:
        i = int(pieces[k, BENT_TUBE])
        kappa = pieces[k, SOFTNESS] * moments[k, i]
        angle = psi[at, i] + begin * lengths[at] * rate[at, i] + directions[k, i]
        x, y, z = h * kappa * math.cos(angle), h * kappa * math.sin(angle), h * rate[at, i]
        return turned(_exponential(x, y, z, 0.0, 0.0, h), -z)
    x1 = y1 = x2 = y2 = 0.0
    if pieces[k, BENT] != 0.0:
        x1, y1 = curvature(cutting, k, begin + GAUSS * (end - begin), lengths[at], psi, rate, at)
        x2, y2 = curvature(cutting, k, end - GAUSS * (end - begin), lengths[at], psi, rate, at)
    c = COMMUTATOR * h * h
    return _exponential(
        0.5 * h * (x1 + x2), 0.5 * h * (y1 + y2), c * (x1 * y2 - y1 * x2), c * (y1 - y2), c * (x2 - x1), h
    )


@kernel(_nrt=False)
def lay(cutting, nodes, steps, poses):
    """Fill `poses` (N + 1, 12) with the Bishop frame of every node; the first is the identity."""
    for m in range(12):
        poses[0, m] = 1.0 if m in (0, 4, 8) else 0.0
    for at in range(steps[0].shape[0]):
        _compose(poses, at, step_of(cutting, nodes, steps, at, 0.0, 1.0), poses, at + 1)


@kernel(_nrt=False)
def frames_at(cutting, nodes, steps, poses, arc_lengths, found, angles, rates):
    """Fill poses (M, 12), psi and u (M, n) at arc lengths (M,) between front plate and tip."""
    s, psi, rate, _dpsi, _drate = nodes
    lengths = steps[0]
    for m in range(arc_lengths.shape[0]):
        at = min(max(np.searchsorted(s, arc_lengths[m], "right") - 1, 0), lengths.shape[0] - 1)
        h = lengths[at]
        t = min(max((arc_lengths[m] - s[at]) / h, 0.0), 1.0)
        _compose(poses, at, step_of(cutting, nodes, steps, at, 0.0, t), found, m)
        a = 1.0 - t * t * (3.0 - 2.0 * t)
        for i in range(psi.shape[1]):
            angles[m, i] = a * psi[at, i] + (1.0 - a) * psi[at + 1, i]
            angles[m, i] += h * t * (1.0 - t) * ((1.0 - t) * rate[at, i] - t * rate[at + 1, i])
            rates[m, i] = 6.0 * t * (1.0 - t) * (psi[at + 1, i] - psi[at, i]) / h
            rates[m, i] += (1.0 - t) * (1.0 - 3.0 * t) * rate[at, i]
            rates[m, i] += t * (3.0 * t - 2.0) * rate[at + 1, i]
