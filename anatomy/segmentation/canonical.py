"""Images in one order of voxels: what a segmentation makes does not depend on how a file stores its image."""

import numpy as np

from anatomy.base.typed import Float
from anatomy.grid import Grid, Volume

LAST_DIGIT = 5
"""Decimals of the header in mm: formats of files round it differently beyond, by 0.001 mm over an image."""


def canonical(volume: Volume) -> Volume:
    """Return an image with its voxels in the order right to left, front to back, feet to head.

    Only the order of the voxels changes: every voxel keeps its place in the patient, to `LAST_DIGIT`.
    An image in this order is returned as it is.
    """
    volume = _rounded(volume)
    order, flipped = towards_lps(volume.grid.lps_from_ijk[:3, :3])
    if order == (0, 1, 2) and not any(flipped):
        return volume
    array = np.flip(np.transpose(volume.array, order), axis=tuple(np.flatnonzero(flipped)))
    matrix = volume.grid.lps_from_ijk.copy()
    matrix[:3, :3] = matrix[:3, list(order)] * np.where(flipped, -1.0, 1.0)
    last = np.zeros(3)
    last[list(order)] = np.where(flipped, np.array(array.shape) - 1, 0)
    matrix[:3, 3] = volume.grid.lps(last)
    return _rounded(Volume(grid=Grid(shape=array.shape, lps_from_ijk=matrix), array=np.asfortranarray(array)))


def _rounded(volume: Volume) -> Volume:
    # Adding 0 makes -0 to 0, which are different bytes.
    matrix = np.round(volume.grid.lps_from_ijk, LAST_DIGIT) + 0.0
    if matrix.tobytes() == volume.grid.lps_from_ijk.tobytes():
        return volume
    return Volume(grid=Grid(shape=volume.grid.shape, lps_from_ijk=matrix), array=volume.array)


def towards_lps(axes: Float) -> tuple[tuple[int, int, int], tuple[bool, bool, bool]]:
    """Return which axis runs most nearly along x, y and z, and whether against it."""
    from scipy.optimize import linear_sum_assignment

    cosines = axes / np.linalg.norm(axes, axis=0)
    _, columns = linear_sum_assignment(-np.abs(cosines))
    x, y, z = (int(c) for c in columns)
    against = [bool(cosines[row, column] < 0) for row, column in enumerate((x, y, z))]
    return (x, y, z), (against[0], against[1], against[2])
