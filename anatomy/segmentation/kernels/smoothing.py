"""Separable symmetric smoothing of an image in place, plane by plane."""

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel


@inner_kernel
def _weighted_rows(rows, weights, centre, out):
    """Fill `out` with `weights[0] rows[centre] + sum weights[n] (rows[centre - n] + rows[centre + n])`.

    Rows before the first and after the last are those at the border.  Both neighbours at a distance are
    added before they are weighted: a mirrored image gives the mirrored result bit for bit.
    """
    last = rows.shape[0] - 1
    middle = rows[centre]
    for i in range(out.shape[0]):
        out[i] = weights[0] * middle[i]
    for n in range(1, weights.shape[0]):
        weight = weights[n]
        before, after = rows[max(centre - n, 0)], rows[min(centre + n, last)]
        for i in range(out.shape[0]):
            out[i] += weight * (before[i] + after[i])


@merged_kernel
def _along_row(padded, weights, out):
    """The same along one row; `padded` holds it with `len(weights) - 1` values more at each end."""
    radius = weights.shape[0] - 1
    size = out.shape[0]
    middle = padded[radius : radius + size]
    for i in range(size):
        out[i] = weights[0] * middle[i]
    for n in range(1, weights.shape[0]):
        weight = weights[n]
        before, after = padded[radius - n : radius - n + size], padded[radius + n : radius + n + size]
        for i in range(size):
            out[i] += weight * (before[i] + after[i])


@kernel(nogil=True)
def smooth_in_planes(image, first, last, row_weights, column_weights):
    """Smooth `first <= k < last` of `(nk, nj, ni)` float32 along i, then j, by weights, centre first."""
    nj, ni = image.shape[1], image.shape[2]
    radius = row_weights.shape[0] - 1
    padded = np.zeros(ni + 2 * radius, dtype=np.float32)
    rows = np.zeros((nj, ni), dtype=np.float32)
    for k in range(first, last):
        for j in range(nj):
            row = image[k, j]
            padded[:radius] = row[0]
            padded[radius : radius + ni] = row
            padded[radius + ni :] = row[ni - 1]
            _along_row(padded, row_weights, rows[j])
        for j in range(nj):
            _weighted_rows(rows, column_weights, j, image[k, j])


@kernel(nogil=True)
def smooth_across_planes(image, first, last, weights):
    """Smooth the rows `first <= j < last` of all planes of `image` `(nk, nj, ni)` float32 along k."""
    nk, ni = image.shape[0], image.shape[2]
    rows = np.zeros((nk, ni), dtype=np.float32)
    for j in range(first, last):
        for k in range(nk):
            rows[k] = image[k, j]
        for k in range(nk):
            _weighted_rows(rows, weights, k, image[k, j])
