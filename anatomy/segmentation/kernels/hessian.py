"""Responses of Hessian filters at the voxels of a smoothed image [Fu2018, sec. IV-A]."""

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from anatomy.segmentation.kernels.eigenvalues import eigenvalues

ZERO, ONE, HALF, QUARTER, TWO = (np.float64(x) for x in (0.0, 1.0, 0.5, 0.25, 2.0))


@inner_kernel
def second_differences(image, k, j, i, factors):
    """Return the entries ii, jj, kk, ij, ik, jk of the scaled Hessian by central differences, float64."""
    nk, nj, ni = image.shape
    k0, k1 = max(k - 1, 0), min(k + 1, nk - 1)
    j0, j1 = max(j - 1, 0), min(j + 1, nj - 1)
    i0, i1 = max(i - 1, 0), min(i + 1, ni - 1)
    twice = TWO * image[k, j, i]
    ii = factors[0] * (np.float64(image[k, j, i0]) + image[k, j, i1] - twice)
    jj = factors[1] * (np.float64(image[k, j0, i]) + image[k, j1, i] - twice)
    kk = factors[2] * (np.float64(image[k0, j, i]) + image[k1, j, i] - twice)
    ij = QUARTER * factors[3]
    ij *= (np.float64(image[k, j0, i0]) + image[k, j1, i1]) - (
        np.float64(image[k, j0, i1]) + image[k, j1, i0]
    )
    ik = QUARTER * factors[4]
    ik *= (np.float64(image[k0, j, i0]) + image[k1, j, i1]) - (
        np.float64(image[k0, j, i1]) + image[k1, j, i0]
    )
    jk = QUARTER * factors[5]
    jk *= (np.float64(image[k0, j0, i]) + image[k1, j1, i]) - (
        np.float64(image[k0, j1, i]) + image[k1, j0, i]
    )
    return ii, jj, kk, ij, ik, jk


@merged_kernel
def _vesselness(low, middle, high, strength, settings):
    """Return R(x; sigma) of eigenvalues by magnitude whose last two are negative [Fu2018, sec. IV-A.3]."""
    flat = middle / high
    blob = low * low / (middle * high)
    return (
        (ONE - np.exp(-flat * flat / (TWO * settings[0] * settings[0])))
        * np.exp(-blob / (TWO * settings[1] * settings[1]))
        * (ONE - np.exp(-strength / (TWO * settings[2] * settings[2])))
    )


@kernel(nogil=True)
def add_vesselness(image, first, last, n_scales, scale, factors, settings, best):
    """Raise `best` to R(x; sigma) in the planes `first <= k < last`, where more than `scale` scales apply.

    Args:
        image, best ((nk, nj, ni) float32): The image smoothed to sigma; the greatest response so far.
        n_scales ((nk, nj, ni) uint8): How many scales apply at a voxel; 0 outside the lung.
        factors ((6,) float64): sigma^2 / (h_a h_b) for ii, jj, kk, ij, ik, jk.
        settings ((3,) float64): alpha, beta, c.
    """
    for k in range(first, last):
        for j in range(image.shape[1]):
            for i in range(image.shape[2]):
                if n_scales[k, j, i] <= scale:
                    continue
                ii, jj, kk, ij, ik, jk = second_differences(image, k, j, i, factors)
                # The last two eigenvalues outweigh the first: both negative makes the trace negative.
                if ii + jj + kk >= ZERO:
                    continue
                strength = ii * ii + jj * jj + kk * kk + TWO * (ij * ij + ik * ik + jk * jk)
                # 1 - exp(-x) <= x bounds the response.
                if strength <= best[k, j, i] * TWO * settings[2] * settings[2]:
                    continue
                low, middle, high = eigenvalues(ii, jj, kk, ij, ik, jk)
                if middle < ZERO and high < ZERO:
                    response = np.float32(_vesselness(low, middle, high, strength, settings))
                    best[k, j, i] = max(best[k, j, i], response)


@kernel(nogil=True)
def add_large_response(
    image, hu, first, last, n_scales, scale, factors, reference, brightest, best, at_scale
):
    """Raise `best` to R_L(x; sigma) in the planes `first <= k < last`; note the scale in `at_scale`.

    As `add_vesselness`; `hu` is the unsmoothed image (int16), `reference` I_ref and `brightest` I_max in HU,
    `at_scale` uint8 the index of the scale of the greatest response.
    """
    for k in range(first, last):
        for j in range(image.shape[1]):
            for i in range(image.shape[2]):
                if n_scales[k, j, i] <= scale:
                    continue
                ii, jj, kk, ij, ik, jk = second_differences(image, k, j, i, factors)
                if ii + jj + kk >= ZERO:
                    continue
                weight = ONE / (reference - min(np.float64(hu[k, j, i]), brightest))
                strength = ii * ii + jj * jj + kk * kk + TWO * (ij * ij + ik * ik + jk * jk)
                # The middle eigenvalue has at most half of the sum of squares.
                if weight * np.sqrt(HALF * strength) <= best[k, j, i]:
                    continue
                low, middle, high = eigenvalues(ii, jj, kk, ij, ik, jk)
                if middle < ZERO and high < ZERO:
                    response = np.float32(-weight * middle)
                    if response > best[k, j, i]:
                        best[k, j, i] = response
                        at_scale[k, j, i] = scale
