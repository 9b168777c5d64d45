"""The rigid motion of the devices with the airway around the scope's tip, and bounds of its rates.

F = I + share G is the deformation about the tip, G a mean gradient; devices turn by its rotation R in the
polar decomposition F = R U.  With K = R'G, R' d/dshare R = W solves W U + U W = K - K', so its axis w
solves (tr(U) I - U) w = axis of K - K'.
"""

import math
from typing import NamedTuple

import numpy as np

from anatomy.base.typed import Float
from anatomy.kernels.compiling import inner_kernel, kernel

POLAR_STEPS = 30
"""Newton's iteration for a polar factor doubles its digits with each step: six suffice near a rotation."""
CONVERGED = 1e-15


class Rigid(NamedTuple):
    """What carries the devices: place of the tip in the masks, its displacement, and the mean gradient.

    `centre` and `displacement` are `(3,)` LPS mm, `gradient` is `(3, 3)`.
    """

    centre: Float
    displacement: Float
    gradient: Float


@inner_kernel
def inverse_transposed(m, out):
    """Fill `out` (3, 3) with the transposed inverse of a matrix: its cofactors by its determinant."""
    for r in range(3):
        r1, r2 = (r + 1) % 3, (r + 2) % 3
        for c in range(3):
            c1, c2 = (c + 1) % 3, (c + 2) % 3
            out[r, c] = m[r1, c1] * m[r2, c2] - m[r1, c2] * m[r2, c1]
    det = m[0, 0] * out[0, 0] + m[0, 1] * out[0, 1] + m[0, 2] * out[0, 2]
    for r in range(3):
        for c in range(3):
            out[r, c] /= det


@kernel()
def turned(gradient, share, rotation, rate):
    """Fill `rotation` (3, 3) with R and `rate` (3, 3) with dR / dshare."""
    f = np.zeros((3, 3))
    for r in range(3):
        for c in range(3):
            f[r, c] = share * gradient[r, c] + (1.0 if r == c else 0.0)
            rotation[r, c] = f[r, c]
    inverse = np.zeros((3, 3))
    for _ in range(POLAR_STEPS):
        inverse_transposed(rotation, inverse)
        change = 0.0
        for r in range(3):
            for c in range(3):
                mean = 0.5 * (rotation[r, c] + inverse[r, c])
                change = max(change, abs(mean - rotation[r, c]))
                rotation[r, c] = mean
        if change <= CONVERGED:
            break
    u, k = np.zeros((3, 3)), np.zeros((3, 3))
    for r in range(3):
        for c in range(3):
            for m in range(3):
                u[r, c] += rotation[m, r] * f[m, c]
                k[r, c] += rotation[m, r] * gradient[m, c]
    trace = u[0, 0] + u[1, 1] + u[2, 2]
    for r in range(3):
        for c in range(3):
            f[r, c] = (trace if r == c else 0.0) - u[r, c]
    inverse_transposed(f, inverse)
    ax, ay, az = k[2, 1] - k[1, 2], k[0, 2] - k[2, 0], k[1, 0] - k[0, 1]
    wx = inverse[0, 0] * ax + inverse[1, 0] * ay + inverse[2, 0] * az
    wy = inverse[0, 1] * ax + inverse[1, 1] * ay + inverse[2, 1] * az
    wz = inverse[0, 2] * ax + inverse[1, 2] * ay + inverse[2, 2] * az
    for r in range(3):
        rate[r, 0] = rotation[r, 1] * wz - rotation[r, 2] * wy
        rate[r, 1] = rotation[r, 2] * wx - rotation[r, 0] * wz
        rate[r, 2] = rotation[r, 0] * wy - rotation[r, 1] * wx


@kernel()
def rate_bounds(gradient, share):
    """Return bounds of the norms of dR / dshare and of its derivative, for all shares up to `share` in size.

    With g the Frobenius norm of G and m = 1 - share g at most the least stretch, the equation for W gives
    norm(W) <= g / (sqrt(2) m); its derivative, of which the right side is at most
    2 g norm(W) + 2 norm(W) norm(dU), norm(dU) <= g + norm(W) (1 + share g), gives that of W'.
    """
    squares = 0.0
    for r in range(3):
        for c in range(3):
            squares += gradient[r, c] * gradient[r, c]
    g = math.sqrt(squares)
    left = 1.0 - share * g
    if left <= 0.0:
        return math.inf, math.inf
    w = g / (math.sqrt(2.0) * left)
    change = math.sqrt(2.0) * w * (2.0 * g + w * (1.0 + share * g)) / left
    return w, w * w + change


@kernel()
def carried(rigid, share, rotation, rate, x, y, z):
    """Return where a point of the devices is, and its velocity in mm a share."""
    cx, cy, cz = rigid.centre
    dx, dy, dz = rigid.displacement
    px, py, pz = x - cx, y - cy, z - cz
    qx = cx + share * dx + rotation[0, 0] * px + rotation[0, 1] * py + rotation[0, 2] * pz
    qy = cy + share * dy + rotation[1, 0] * px + rotation[1, 1] * py + rotation[1, 2] * pz
    qz = cz + share * dz + rotation[2, 0] * px + rotation[2, 1] * py + rotation[2, 2] * pz
    vx = dx + rate[0, 0] * px + rate[0, 1] * py + rate[0, 2] * pz
    vy = dy + rate[1, 0] * px + rate[1, 1] * py + rate[1, 2] * pz
    vz = dz + rate[2, 0] * px + rate[2, 1] * py + rate[2, 2] * pz
    return qx, qy, qz, vx, vy, vz
