"""An image between its voxels: linear, or by cubic splines that stay between the two voxels beside them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from anatomy.base.typed import Array, Float

REACH = 12
"""Voxels farther than so many from a place weigh less than 1e-6 in its spline."""


def between(values: Array, places: Sequence[Float], *, cubic: bool = True) -> Array:
    """Return an image at the nodes of another grid whose axes are parallel.

    A cubic spline swings beyond its voxels at sharp edges: it draws dark rims around vessels.  It is cut off
    at the values of the two voxels beside a place, axis by axis.  Axes whose places are voxels are copied.

    Parameters
    ----------
    values : (ni, nj, nk)
        float32 if any axis is interpolated.
    places : three (N,) float64
        Where along each axis, in voxels; beyond the ends the image goes on as it ends.
    cubic : bool
        Else linear.

    Returns
    -------
    (Ni, Nj, Nk) of the same dtype, Fortran-contiguous
    """
    planes = values.T
    across = np.zeros((len(planes), len(places[1]), len(places[0])), dtype=values.dtype)
    for k, plane in enumerate(planes):
        across[k] = _along(_along(plane, places[1], cubic).T, places[0], cubic).T
    return np.asfortranarray(_along(across, places[2], cubic).T)


def _along(values: Array, places: Float, cubic: bool) -> Array:
    """Return an image at places along its first axis."""
    last = len(values) - 1
    first = np.clip(np.floor(places), 0, last).astype(np.int64)
    if (first == places).all():
        return values[first]
    second, shares = np.minimum(first + 1, last), np.clip(places - first, 0.0, 1.0)
    terms = _coefficients(values) if cubic else values
    found = np.zeros((len(places), *values.shape[1:]), dtype=values.dtype)
    for n, (below, above, share) in enumerate(zip(first, second, shares, strict=True)):
        for step, weight in _weights(float(share), cubic):
            at = abs(int(below) + step)
            found[n] += np.float32(weight) * terms[max(2 * last - at, 0) if at > last else at]
        if cubic:
            least, most = np.minimum(values[below], values[above]), np.maximum(values[below], values[above])
            np.clip(found[n], least, most, out=found[n])
    return found


def _coefficients(values: Array) -> Array:
    """Return the coefficients of the cubic splines along the first axis."""
    from scipy.ndimage import spline_filter1d

    return np.asarray(spline_filter1d(values, 3, axis=0, output=np.float32))


def _weights(t: float, cubic: bool) -> list[tuple[int, float]]:
    """Return steps and weights of voxels, or of coefficients of the spline, a share `t` beyond one."""
    if not cubic:
        return [(0, 1.0 - t), (1, t)]
    s = 1.0 - t
    return [
        (-1, s**3 / 6.0),
        (0, (4.0 - 6.0 * t**2 + 3.0 * t**3) / 6.0),
        (1, (4.0 - 6.0 * s**2 + 3.0 * s**3) / 6.0),
        (2, t**3 / 6.0),
    ]
