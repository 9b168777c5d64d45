"""Obstacles grown by whole voxels [Fu2018, sec. IV-B]: the paper's way, which proves nothing.

It stands for growing by a radius, but an ellipsoid of voxels is no ball, and the tip is not at the centre of
its voxel; so paths in grown obstacles are for comparison alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.typed import Int, Mask

ROUNDING = 1e-6
"""Relative: quotients and squared distances are whole numbers and fractions of small ones."""


def inflation_voxels(spacing_mm: ArrayLike, total_radius_mm: float) -> Int:
    """Return by how many voxels obstacles grow along i, j and k: `ceil(r_total / s_i)` [Fu2018, sec. IV-B].

    The spacing `(3,)` is that along i, j, k; the total radius is that of the needle and the safety margin.
    """
    quotient = total_radius_mm / np.asarray(spacing_mm, dtype=np.float64)
    return np.ceil(quotient * (1.0 - ROUNDING)).astype(np.int64)


def grown_by_voxels(mask: Mask, axes: Int) -> Mask:
    """Return the voxels within an ellipsoid of semi-axes `axes`, in voxels, about a voxel of `mask`."""
    import edt

    if not mask.any():
        return mask
    sides = tuple(float(1.0 / a) for a in axes)
    distance = edt.edt(np.asfortranarray(~mask), anisotropy=sides, order="F", black_border=False, parallel=1)
    return np.asarray(distance <= 1.0 + ROUNDING)
