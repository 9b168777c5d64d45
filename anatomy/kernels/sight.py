"""Rays within a structure: they say how far it goes on, and which is its last voxel."""

import math

import numpy as np

from anatomy.kernels.compiling import kernel


@kernel()
def follow_rays(labels, geometry, bits, starts, rays, most_mm, away_mm, ends):
    """Follow rays `(N, 3)` from `starts` (N, 3) to the first voxel without `bits`, or the border of the grid.

    `away_mm` (N,) becomes the exact length up to it, 0 for a start without them, at most `most_mm`;
    `ends` (N,) becomes the label of the last voxel before it, 0 if there is none.
    """
    here, step, along, each = np.zeros(3, np.int64), np.zeros(3, np.int64), np.zeros(3), np.zeros(3)
    for n in range(rays.shape[0]):
        for axis in range(3):
            place, speed = geometry[axis, 3], 0.0
            for m in range(3):
                place += geometry[axis, m] * starts[n, m]
                speed += geometry[axis, m] * rays[n, m]
            here[axis] = math.floor(place)
            step[axis] = 1 if speed > 0.0 else -1
            each[axis] = abs(1.0 / speed) if speed != 0.0 else math.inf
            border = here[axis] + 1 - place if speed > 0.0 else place - here[axis]
            along[axis] = border * each[axis] if speed != 0.0 else math.inf
        length, last = 0.0, 0
        while length < most_mm:
            i, j, k = here[0], here[1], here[2]
            if not (0 <= i < labels.shape[0] and 0 <= j < labels.shape[1] and 0 <= k < labels.shape[2]):
                break
            if not labels[i, j, k] & bits:
                break
            last = int(labels[i, j, k])
            axis = int(np.argmin(along))
            length = along[axis]
            along[axis] += each[axis]
            here[axis] += step[axis]
        away_mm[n] = min(length, most_mm)
        ends[n] = last
