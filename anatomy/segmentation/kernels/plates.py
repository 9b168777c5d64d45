"""Plates in a smoothed image: how much each voxel is one, and the sheets that they make together."""

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from anatomy.segmentation.kernels.eigenvalues import eigenvalues
from anatomy.segmentation.kernels.hessian import second_differences

ZERO, ONE = np.float64(0.0), np.float64(1.0)


@inner_kernel
def _cross(a, b, c, d, e, f):
    return b * f - c * e, c * d - a * f, a * e - b * d


@merged_kernel
def _eigenvector(xx, yy, zz, xy, xz, yz, value):
    """Return the unit vector of a single eigenvalue: the longest cross product of two rows; 0 if none."""
    xx, yy, zz = xx - value, yy - value, zz - value
    first = _cross(xx, xy, xz, xy, yy, yz)
    second = _cross(xx, xy, xz, xz, yz, zz)
    third = _cross(xy, yy, yz, xz, yz, zz)
    best, square = first, first[0] ** 2 + first[1] ** 2 + first[2] ** 2
    for other in (second, third):
        length = other[0] ** 2 + other[1] ** 2 + other[2] ** 2
        if length > square:
            best, square = other, length
    if square == ZERO:
        return ZERO, ZERO, ZERO
    scale = ONE / np.sqrt(square)
    return best[0] * scale, best[1] * scale, best[2] * scale


@kernel(nogil=True)
def plate_responses(image, where, strength, normal):
    """Fill strength and normal of bright plates at the voxels of `where`.

    The strength is |lambda_3| - |lambda_2| of the Hessian for lambda_3 < 0: a tube has none.

    Args:
        image ((nk, nj, ni) float32): Smoothed, with cubic voxels of 1.
        where: (nk, nj, ni) bool.
        strength: (nk, nj, ni) float32.
        normal ((3, nk, nj, ni) float32): Along i, j, k; no sense of direction.
    """
    factors = np.ones(6)
    for k in range(image.shape[0]):
        for j in range(image.shape[1]):
            for i in range(image.shape[2]):
                if not where[k, j, i]:
                    continue
                xx, yy, zz, xy, xz, yz = second_differences(image, k, j, i, factors)
                if xx + yy + zz >= ZERO:
                    continue
                _, middle, high = eigenvalues(xx, yy, zz, xy, xz, yz)
                found = -high - abs(middle)
                if found <= ZERO:
                    continue
                strength[k, j, i] = found
                along = _eigenvector(xx, yy, zz, xy, xz, yz, high)
                for axis in range(3):
                    normal[axis, k, j, i] = along[axis]


@kernel()
def grow_sheets(response, normal, least, cosine, sheet, stack):
    """Number the sheets from 1 on and return their sizes in voxels, that of number 0 being 0.

    Neighbours (26) of at least `least` belong together if the cosine between their normals is large.
    `response` is (nk, nj, ni) and `normal` (3, nk, nj, ni) float32; `sheet` (nk, nj, ni) int32 begins with
    zeros and gets the number of each voxel's sheet; `stack` (n,) int64 has room for every voxel of at least
    `least`.
    """
    nk, nj, ni = response.shape
    sizes = [0]
    for start in range(response.size):
        k, j, i = start // (nj * ni), start // ni % nj, start % ni
        if response[k, j, i] < least or sheet[k, j, i] > 0:
            continue
        number, size, top = len(sizes), 0, 1
        sheet[k, j, i], stack[0] = number, start
        while top > 0:
            top -= 1
            at = stack[top]
            size += 1
            k, j, i = at // (nj * ni), at // ni % nj, at % ni
            for c in range(max(k - 1, 0), min(k + 2, nk)):
                for b in range(max(j - 1, 0), min(j + 2, nj)):
                    for a in range(max(i - 1, 0), min(i + 2, ni)):
                        if sheet[c, b, a] > 0 or response[c, b, a] < least:
                            continue
                        turn = ZERO
                        for axis in range(3):
                            turn += normal[axis, k, j, i] * normal[axis, c, b, a]
                        if abs(turn) >= cosine:
                            sheet[c, b, a], stack[top] = number, (c * nj + b) * ni + a
                            top += 1
        sizes.append(size)
    return np.array(sizes)
