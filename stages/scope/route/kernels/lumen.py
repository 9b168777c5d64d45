"""The lumen as a union of round cones, found through a grid of cells.

A cone is a row of eight numbers: a point of the centreline, the radius there, the next point and its radius.
It holds every ball whose centre lies between the two points and whose radius is interpolated linearly.  The
depth of a point in a cone, `radius - distance to the centre` of the best ball, is 1-Lipschitz, and so is
the depth in a union of cones, the largest of theirs.
"""

import math

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel

NOWHERE = -1.0e30
"""Depth of a point in no listed cone: below that of any point."""


@inner_kernel
def cone_depth(cones, e, x, y, z):
    """Return the depth of a point in cone `e` and the centre of its best ball."""
    px = x - cones[e, 0]
    py = y - cones[e, 1]
    pz = z - cones[e, 2]
    dx = cones[e, 4] - cones[e, 0]
    dy = cones[e, 5] - cones[e, 1]
    dz = cones[e, 6] - cones[e, 2]
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    rise = cones[e, 7] - cones[e, 3]
    if length <= abs(rise):
        # One of the balls holds the other.
        share = 1.0 if rise > 0.0 else 0.0
    else:
        slope = rise / length
        along = (px * dx + py * dy + pz * dz) / length
        aside = math.sqrt(max(px * px + py * py + pz * pz - along * along, 0.0))
        share = (along + aside * slope / math.sqrt(1.0 - slope * slope)) / length
        share = min(max(share, 0.0), 1.0)
    cx = cones[e, 0] + share * dx
    cy = cones[e, 1] + share * dy
    cz = cones[e, 2] + share * dz
    distance = math.sqrt((x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2)
    return cones[e, 3] + share * rise - distance, cx, cy, cz


@inner_kernel
def cell_of(index, x, y, z):
    """Return the number of the cell that holds a point, -1 outside; `index`: origin, cell size, shape."""
    i = math.floor((x - index[0]) / index[3])
    j = math.floor((y - index[1]) / index[3])
    k = math.floor((z - index[2]) / index[3])
    if not (0 <= i < index[4] and 0 <= j < index[5] and 0 <= k < index[6]):
        return -1
    return int((i * index[5] + j) * index[6] + k)


@inner_kernel
def deep_enough(cones, index, cell_start, cell_cones, hint, enough, x, y, z):
    """Return depth, centre of the ball and cone of the first cone found to hold a point `enough` deep.

    If none does, they are those of the best cone.  Where the point lies in no cone that is listed for its
    cell, the depth may be `NOWHERE`: it is exact where it is not negative, and never too large.  `hint` is a
    cone that is looked at first, -1 for none.
    """
    best, bx, by, bz, cone = NOWHERE, 0.0, 0.0, 0.0, -1
    if hint >= 0:
        best, bx, by, bz = cone_depth(cones, hint, x, y, z)
        cone = hint
        if best >= enough:
            return best, bx, by, bz, cone
    cell = cell_of(index, x, y, z)
    if cell >= 0:
        for at in range(cell_start[cell], cell_start[cell + 1]):
            depth, cx, cy, cz = cone_depth(cones, cell_cones[at], x, y, z)
            if depth > best:
                best, bx, by, bz, cone = depth, cx, cy, cz, cell_cones[at]
                if best >= enough:
                    break
    return best, bx, by, bz, cone


@inner_kernel
def depth_at(cones, index, cell_start, cell_cones, x, y, z):
    """Return the depth of a point in the lumen and the centre of its best ball, see `deep_enough`."""
    depth, cx, cy, cz, _cone = deep_enough(cones, index, cell_start, cell_cones, -1, math.inf, x, y, z)
    return depth, cx, cy, cz


@inner_kernel
def _cell_range(cones, index, e, axis):
    low = min(cones[e, axis] - cones[e, 3], cones[e, 4 + axis] - cones[e, 7])
    high = max(cones[e, axis] + cones[e, 3], cones[e, 4 + axis] + cones[e, 7])
    last = int(index[4 + axis]) - 1
    first = max(int(math.floor((low - index[axis]) / index[3])), 0)
    return range(first, min(int(math.floor((high - index[axis]) / index[3])), last) + 1)


@kernel()
def list_cells(cones, index):
    """Return, as two arrays of a compressed list, the cones whose box touches each cell."""
    n_cells = int(index[4] * index[5] * index[6])
    start = np.zeros(n_cells + 1, dtype=np.int64)
    for e in range(cones.shape[0]):
        for i in _cell_range(cones, index, e, 0):
            for j in _cell_range(cones, index, e, 1):
                for k in _cell_range(cones, index, e, 2):
                    start[int((i * index[5] + j) * index[6] + k) + 1] += 1
    for cell in range(n_cells):
        start[cell + 1] += start[cell]
    filled = start[:-1].copy()
    listed = np.zeros(start[n_cells], dtype=np.int64)
    for e in range(cones.shape[0]):
        for i in _cell_range(cones, index, e, 0):
            for j in _cell_range(cones, index, e, 1):
                for k in _cell_range(cones, index, e, 2):
                    cell = int((i * index[5] + j) * index[6] + k)
                    listed[filled[cell]] = e
                    filled[cell] += 1
    return start, listed


@kernel()
def depths_at(cones, index, cell_start, cell_cones, points, out):
    """Fill `out` (N,) with the depths of `points` (N, 3) in the lumen; outside, negative, by all cones."""
    for n in range(points.shape[0]):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        best = depth_at(cones, index, cell_start, cell_cones, x, y, z)[0]
        if best < 0.0:
            for e in range(cones.shape[0]):
                best = max(best, cone_depth(cones, e, x, y, z)[0])
        out[n] = best
