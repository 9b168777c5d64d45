"""How much each voxel of the lung looks like a vessel: multi-scale vesselness [Fu2018, sec. IV-A.3]."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.typed import Float, Float32, Int16, Mask
from anatomy.segmentation.scale_space import ScaleSpace

ALPHA, BETA, C_HU = 0.5, 0.5, 70.0
"""Sensitivity to plates and to blobs; Hessian of 39 % of the greatest response [Fu2018]."""


def vesselness(hu: Int16 | Float32, lung: Mask, spacing_mm: ArrayLike, *, threads: int = 0) -> Float32:
    """Return the greatest response over the scales that apply at each voxel [Fu2018, eqs. 3-5].

    Parameters
    ----------
    hu : (ni, nj, nk) int16 or float32
        The CT in Hounsfield units.
    lung : (ni, nj, nk) bool
        Lungs with their vessels; the distance to its surface decides which scales apply.
    spacing_mm : (3,) float64
        Voxel size along i, j, k.
    threads : int
        0 for all processors; the result does not depend on it.

    Returns
    -------
    (ni, nj, nk) float32
        In [0, 1], Fortran-contiguous; 0 outside the lung.

    Raises
    ------
    GridMismatchError, AnatomyError
        If the shapes differ; if the lung is empty.
    """
    space = ScaleSpace.of(hu, lung, spacing_mm, threads=threads)
    best = np.zeros(space.hu.shape, dtype=np.float32)
    settings = np.array([ALPHA, BETA, C_HU])
    for scale, (sigma, image) in enumerate(space.images()):
        add_vesselness_of(space, scale, sigma, image, settings, best)
    return space.whole(best, hu.shape)


def add_vesselness_of(
    space: ScaleSpace, scale: int, sigma: float, image: Float32, settings: Float, best: Float32
) -> None:
    """Raise `best` to the response at one scale; `settings` are alpha, beta, c."""
    from anatomy.segmentation.kernels.hessian import add_vesselness

    factors, index = space.hessian_factors(sigma), np.int64(scale)
    space.share(lambda a, b: add_vesselness(image, a, b, space.n_scales, index, factors, settings, best))
