"""The tubes' centreline and its frames, laid from the front plate to the tip once torsion is known.

A pose is twelve numbers: rotation by rows, then position in mm.  In the Bishop frame the curvature is

    u = sum_i kb_i kappa_i (cos psi_i, sin psi_i, 0) / sum kb

where psi includes the direction of the precurvature.  A step is the Magnus expansion of order 4 on rigid
motions [Iserles2000]; where one tube alone is bent, curvature is constant in its frame, and the step exact.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from anatomy.kernels.compiling import inner_kernel
from stages.tube.kernels.assembly import BENT, BENT_TUBE, SOFTNESS

GAUSS = 0.5 - math.sqrt(3.0) / 6.0
COMMUTATOR = math.sqrt(3.0) / 12.0
SMALL_ANGLE2 = 1e-6
"""Below this square of an angle, series take the place of quotients that lose digits."""


@inner_kernel
def _exponential(w, v, out):
    """Write exp of the twist (w, v) as a pose."""
    a2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    if a2 < SMALL_ANGLE2:
        sine = 1.0 - a2 / 6.0 * (1.0 - a2 / 20.0)
        versine = 0.5 - a2 / 24.0 * (1.0 - a2 / 30.0)
        rest = 1.0 / 6.0 - a2 / 120.0 * (1.0 - a2 / 42.0)
    else:
        a = math.sqrt(a2)
        sine = math.sin(a) / a
        versine = 2.0 * (math.sin(0.5 * a) / a) ** 2
        rest = (1.0 - sine) / a2
    cx = w[1] * v[2] - w[2] * v[1]
    cy = w[2] * v[0] - w[0] * v[2]
    cz = w[0] * v[1] - w[1] * v[0]
    along = w[0] * v[0] + w[1] * v[1] + w[2] * v[2]
    out[0] = 1.0 - versine * (w[1] * w[1] + w[2] * w[2])
    out[1] = versine * w[0] * w[1] - sine * w[2]
    out[2] = versine * w[0] * w[2] + sine * w[1]
    out[3] = versine * w[0] * w[1] + sine * w[2]
    out[4] = 1.0 - versine * (w[0] * w[0] + w[2] * w[2])
    out[5] = versine * w[1] * w[2] - sine * w[0]
    out[6] = versine * w[0] * w[2] - sine * w[1]
    out[7] = versine * w[1] * w[2] + sine * w[0]
    out[8] = 1.0 - versine * (w[0] * w[0] + w[1] * w[1])
    out[9] = v[0] + versine * cx + rest * (w[0] * along - a2 * v[0])
    out[10] = v[1] + versine * cy + rest * (w[1] * along - a2 * v[1])
    out[11] = v[2] + versine * cz + rest * (w[2] * along - a2 * v[2])


@inner_kernel
def _compose(a, b, out):
    """Write the pose `a b`."""
    for r in range(3):
        for c in range(3):
            out[3 * r + c] = a[3 * r] * b[c] + a[3 * r + 1] * b[3 + c] + a[3 * r + 2] * b[6 + c]
        out[9 + r] = a[3 * r] * b[9] + a[3 * r + 1] * b[10] + a[3 * r + 2] * b[11] + a[9 + r]


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
def _curvature(softness, moments, directions, psi):
    """Return the curvature (x, y) of the centreline in its Bishop frame, 1/mm."""
    x = y = 0.0
    for i in range(psi.shape[0]):
        if moments[i] != 0.0:
            angle = psi[i] + directions[i]
            x += moments[i] * math.cos(angle)
            y += moments[i] * math.sin(angle)
    return softness * x, softness * y


@inner_kernel
def _between(share, h, psi0, rate0, psi1, rate1, out):
    """Interpolate angles within a step by the cubic through angles and rates at its ends."""
    t2, t3 = share * share, share * share * share
    a = 1.0 - 3.0 * t2 + 2.0 * t3
    b = (share - 2.0 * t2 + t3) * h
    d = (t3 - t2) * h
    for i in range(psi0.shape[0]):
        out[i] = a * psi0[i] + b * rate0[i] + (1.0 - a) * psi1[i] + d * rate1[i]


@inner_kernel
def _magnus(h, ux1, uy1, ux2, uy2, twist):
    """Write the twist (w, v) of a step of length `h` with curvatures u1 and u2 at its Gauss points."""
    k = COMMUTATOR * h * h
    twist[0] = 0.5 * h * (ux1 + ux2)
    twist[1] = 0.5 * h * (uy1 + uy2)
    twist[2] = k * (ux1 * uy2 - uy1 * ux2)
    twist[3] = k * (uy1 - uy2)
    twist[4] = k * (ux2 - ux1)
    twist[5] = h


@inner_kernel
def step_of(piece, moments, directions, length, psi0, rate0, psi1, rate1, begin, end, twist, angles, out):
    """Write the motion along the share from `begin` to `end` of a step, as a pose."""
    h = (end - begin) * length
    if piece[BENT] == 1.0:
        i = int(piece[BENT_TUBE])
        kappa = piece[SOFTNESS] * moments[i]
        twist[0] = h * kappa * math.cos(directions[i])
        twist[1] = h * kappa * math.sin(directions[i])
        twist[2] = h * rate0[i]
        twist[3] = twist[4] = 0.0
        twist[5] = h
        _exponential(twist[:3], twist[3:], out[1])
        out[2, 0] = out[2, 4] = out[2, 8] = 1.0
        out[2, 1] = out[2, 2] = out[2, 3] = out[2, 5] = out[2, 6] = out[2, 7] = 0.0
        out[2, 9] = out[2, 10] = out[2, 11] = 0.0
        turned(out[2], psi0[i] + begin * length * rate0[i], out[3])
        _compose(out[3], out[1], out[2])
        turned(out[2], -psi0[i] - end * length * rate0[i], out[0])
        return
    _between(begin + GAUSS * (end - begin), length, psi0, rate0, psi1, rate1, angles)
    ux1, uy1 = _curvature(piece[SOFTNESS], moments, directions, angles)
    _between(end - GAUSS * (end - begin), length, psi0, rate0, psi1, rate1, angles)
    ux2, uy2 = _curvature(piece[SOFTNESS], moments, directions, angles)
    _magnus(h, ux1, uy1, ux2, uy2, twist)
    _exponential(twist[:3], twist[3:], out[0])


@numba.njit(cache=True)
def lay(cutting, nodes, steps, poses):
    """Fill `poses` (N + 1, 12) with the Bishop frame of every node; the first is the identity."""
    pieces, moments, directions, _count = cutting
    _s, psi, rate, _dpsi, _drate = nodes
    lengths, _dlengths, piece_of = steps
    twist = np.zeros(6)
    angles = np.zeros(psi.shape[1])
    motion = np.zeros((4, 12))
    for m in range(12):
        poses[0, m] = 1.0 if m in (0, 4, 8) else 0.0
    for at in range(lengths.shape[0]):
        k = piece_of[at]
        step_of(
            pieces[k], moments[k], directions[k], lengths[at], psi[at], rate[at], psi[at + 1], rate[at + 1],
            0.0, 1.0, twist, angles, motion,
        )  # fmt: skip
        _compose(poses[at], motion[0], poses[at + 1])


@numba.njit(cache=True)
def frame_at(cutting, nodes, steps, poses, arc_length, pose, angles, rates):
    """Write pose (12,), psi (n,) and u (n,) of the tubes at one arc length between front plate and tip."""
    pieces, moments, directions, _count = cutting
    s, psi, rate, _dpsi, _drate = nodes
    lengths, _dlengths, piece_of = steps
    at = min(max(np.searchsorted(s, arc_length, "right") - 1, 0), lengths.shape[0] - 1)
    k = piece_of[at]
    h = lengths[at]
    share = min(max((arc_length - s[at]) / h, 0.0), 1.0)
    twist = np.zeros(6)
    motion = np.zeros((4, 12))
    step_of(
        pieces[k], moments[k], directions[k], h, psi[at], rate[at], psi[at + 1], rate[at + 1],
        0.0, share, twist, angles, motion,
    )  # fmt: skip
    _compose(poses[at], motion[0], pose)
    _between(share, h, psi[at], rate[at], psi[at + 1], rate[at + 1], angles)
    for i in range(psi.shape[1]):
        slope = 6.0 * share * (1.0 - share) * (psi[at + 1, i] - psi[at, i]) / h
        rates[i] = slope + (1.0 - share) * (1.0 - 3.0 * share) * rate[at, i]
        rates[i] += share * (3.0 * share - 2.0) * rate[at + 1, i]
