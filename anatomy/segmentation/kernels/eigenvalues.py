"""Eigenvalues of symmetric 3x3 matrices in closed form."""

import numpy as np

from anatomy.kernels.compiling import inner_kernel

THIRD_TURN = np.float64(2.0 * np.pi / 3.0)
ALL_EQUAL = np.float64(1e-12)
"""A spread of the eigenvalues below this share of the largest entry has no angle that could be trusted."""
ZERO, HALF, ONE, TWO, THREE = (np.float64(x) for x in (0.0, 0.5, 1.0, 2.0, 3.0))


@inner_kernel
def eigenvalues(xx, yy, zz, xy, xz, yz):
    """Return the three eigenvalues of a symmetric matrix, sorted by magnitude, float64.

    The trigonometric solution for the matrix less a third of its trace, scaled by its largest entry so that
    tiny and huge matrices neither underflow nor overflow.  The angle comes from an arc cosine, which loses
    half the digits where two eigenvalues meet: the error is below 1e-7 of the largest entry.
    """
    scale = max(max(abs(xx), abs(yy), abs(zz)), max(abs(xy), abs(xz), abs(yz)))
    if scale == ZERO:
        return ZERO, ZERO, ZERO
    xx, yy, zz, xy, xz, yz = xx / scale, yy / scale, zz / scale, xy / scale, xz / scale, yz / scale
    mean = (xx + yy + zz) / THREE
    a, b, c = xx - mean, yy - mean, zz - mean
    spread = np.sqrt((a * a + b * b + c * c + TWO * (xy * xy + xz * xz + yz * yz)) / (TWO * THREE))
    if spread < ALL_EQUAL:
        return scale * mean, scale * mean, scale * mean
    half_det = HALF * (a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz))
    angle = np.arccos(min(ONE, max(-ONE, half_det / (spread * spread * spread)))) / THREE
    high = mean + TWO * spread * np.cos(angle)
    low = mean + TWO * spread * np.cos(angle + THIRD_TURN)
    middle = THREE * mean - high - low
    # `middle` lies between the others: only its place among the magnitudes is open.
    first, last = (high, low) if abs(high) <= abs(low) else (low, high)
    if abs(middle) < abs(first):
        first, middle = middle, first
    elif abs(middle) > abs(last):
        middle, last = last, middle
    return scale * first, scale * middle, scale * last
