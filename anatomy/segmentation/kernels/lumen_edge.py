"""The edge of the airway lumen: refined towards the wall, made connected by faces, and the wall around it.

Volumes are `(nk, nj, ni)`, C-contiguous, and voxels are named by their flat index.  Around the image lies a
border of three voxels of -1024 HU, in which there is no lumen: a voxel beside the lumen may lie in its first
layer, and the closing there looks two farther.  Lists of voxels are filled up to the returned count.  A voxel
is listed once, when its state changes, so a list as long as the image has room for all.
"""

import numpy as np

from anatomy.kernels.compiling import kernel, merged_kernel
from anatomy.segmentation.kernels.states import LUMEN

WALL = np.uint8(2)
REPLACING_HU = np.int16(0)
"""r: what the lumen is painted with before it is closed; a thick wall has it, too."""
AIR_HU = -1000.0


@merged_kernel
def closing_at(hu, state, at, row):
    """Close the image with lumen painted by a pixel and its four neighbours at a voxel; `row` steps a row."""
    least = np.int16(32767)
    for m in range(5):
        middle = at + cross(m, row)
        most = np.int16(-32768)
        for n in range(5):
            x = middle + cross(n, row)
            most = max(most, REPLACING_HU if state[x] == LUMEN else hu[x])
        least = min(least, most)
    return least


@kernel()
def cross(n, row):
    """Return the flat step to a pixel (0) or one of its four neighbours (1 to 4) in a slice."""
    if n == 0:
        return 0
    if n == 1:
        return 1
    if n == 2:
        return -1
    return row if n == 3 else -row


@kernel()
def refine_edge(hu, state, faces, row, least_depth, lung_hu, lumen, count):
    """Add the voxels beside the lumen that lie on its side of the wall's inner surface.

    The closing with painted lumen tells how bright the wall appears.  A voxel joins if it lies at least
    `least_depth` below that, and below the HU that the inner surface has: half-way from air to a wall that
    appears as bright as tissue, and the nearer to the peak the fainter the wall appears, because a thin wall
    is blurred into the lung behind it.  All voxels are judged before the first one joins.  None of the border
    does if `least_depth` is positive: there the closing is not above -1024 HU.

    Args:
        hu, state ((V,) int16, uint8): `state` is 0 or LUMEN.
        faces ((6,) int64): Flat steps to the neighbours that share a face.
        row (int): Flat step from one row of a slice to the next.
        least_depth (int): HU.
        lung_hu (float): Tissue of the lung.
        lumen ((V,) int64): Its first `count` entries list the lumen; what joins follows.

    Returns:
        int: The new count.

    Notes:
        A wall of the thickness w and 0 HU between air and lung, blurred by a Gaussian of sigma, has at its
        inner surface the share 0.93, 0.86, 0.76, 0.68, 0.57 of the way from air to its peak for w = 0.5, 1,
        1.5, 2, 3 sigma.  `1 - (peak - lung) / (2 (0 - lung))` gives 0.94, 0.84, 0.74, 0.67, 0.57.
    """
    known = count
    for s in range(known):
        for d in faces:
            at = lumen[s] + d
            if state[at] != 0:
                continue
            peak = np.float64(closing_at(hu, state, at, row))
            share = min(max(1.0 - 0.5 * (peak - lung_hu) / (REPLACING_HU - lung_hu), 0.5), 1.0)
            if peak - hu[at] >= least_depth and hu[at] - AIR_HU < share * (peak - AIR_HU):
                lumen[count] = at
                count += 1
                state[at] = WALL
    for s in range(known, count):
        state[lumen[s]] = LUMEN
    return count


@kernel()
def fill_gaps(hu, state, shape, reach, dark_hu, lumen, count):
    """Add to the lumen what lies between two of its voxels along an axis and is as dark as air on average.

    Slices with noise or streaks leave such gaps in the open lumen.  `shape` and `reach` are (3,) int64: at
    most `reach - 1` voxels are bridged along each axis, none beyond the image.  Returns the new count.
    """
    s = 0
    filled = -1
    while s < count or count > filled:
        if s == count:
            filled, s = count, 0
        step = 1
        for axis in range(2, -1, -1):
            room = shape[axis] - lumen[s] // step % shape[axis]
            total = 0.0
            for n in range(1, min(reach[axis] + 1, room)):
                at = lumen[s] + n * step
                if state[at] != LUMEN:
                    total += hu[at]
                    continue
                if n > 1 and total < dark_hu * (n - 1):
                    for m in range(1, n):
                        state[lumen[s] + m * step] = LUMEN
                        lumen[count] = lumen[s] + m * step
                        count += 1
                break
            step *= shape[axis]
        s += 1
    return count


@kernel()
def join_corners(hu, state, shape, lumen, count):
    """Add the darkest voxels between voxels of the lumen that touch by an edge or corner alone.

    Two voxels that differ by one along two or three axes get a path of faces between them, which lies in the
    box of the two and so not in the border.  `lumen` is `(V,)` int64.  Returns the new count.
    """
    steps = np.zeros(3, dtype=np.int64)
    known = count
    for s in range(known):
        here = lumen[s]
        for dk in range(-1, 2):
            for dj in range(-1, 2):
                for di in range(-1, 2):
                    if (dk != 0) + (dj != 0) + (di != 0) < 2:
                        continue
                    steps[0] = dk * shape[1] * shape[2]
                    steps[1] = dj * shape[2]
                    steps[2] = di
                    if here > here + steps.sum() or state[here + steps.sum()] != LUMEN:
                        continue
                    count = _corner_path(hu, state, here, steps, lumen, count)
    return count


@merged_kernel
def _corner_path(hu, state, here, steps, lumen, count):
    """Join a voxel to `here + sum of steps` by the face-connected path whose brightest voxel is darkest."""
    best = np.int32(1 << 20)
    first = 0
    second = 0
    for a in range(3):
        for b in range(3):
            c = 3 - a - b
            if a == b or steps[a] == 0 or (steps[b] == 0 and steps[c] != 0):
                continue
            one = here + steps[a]
            two = one + steps[b] if steps[c] != 0 else one
            worst = max(
                np.int32(-2000) if state[one] == LUMEN else np.int32(hu[one]),
                np.int32(-2000) if state[two] == LUMEN else np.int32(hu[two]),
            )
            if worst < best:
                best = worst
                first = one
                second = two
    for at in (first, second):
        if state[at] != LUMEN:
            state[at] = LUMEN
            lumen[count] = at
            count += 1
    return count


@kernel()
def grow_wall(hu, state, near, lumen, count, layers, least_hu, greatest_difference, wall):
    """Mark the wall: all neighbours of the lumen, then layers of voxels like those already in it.

    A voxel joins a further layer if it is above `least_hu` and differs from every neighbour in the wall so
    far by less than `greatest_difference`.  Only the first layer reaches into the border, which is below
    `least_hu`.  Returns the number of voxels listed in `wall`, `(V,)` int64.
    """
    size = 0
    for s in range(count):
        for d in near:
            at = lumen[s] + d
            if state[at] == 0:
                state[at] = WALL
                wall[size] = at
                size += 1
    first = 0
    for _ in range(layers):
        last = size
        for s in range(first, last):
            for d in near:
                at = wall[s] + d
                if state[at] != 0 or hu[at] <= least_hu:
                    continue
                alike = True
                for e in near:
                    if state[at + e] == WALL and abs(np.int32(hu[at + e]) - hu[at]) >= greatest_difference:
                        alike = False
                        break
                if alike:
                    state[at] = WALL + 1
                    wall[size] = at
                    size += 1
        for s in range(last, size):
            state[wall[s]] = WALL
        first = last
    return size
