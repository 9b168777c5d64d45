"""Compiled kernel of how much of a nodule is in a tool.

The end of the devices is a point, the direction ahead and a normal across it, nine numbers in LPS mm; the
nodule lies `shift` (three numbers) from where it was planned.
"""

import math
from typing import NamedTuple

from anatomy.base.typed import Float, UInt8
from anatomy.kernels.compiling import borrowing_kernel, kernel


class Wanted(NamedTuple):
    """What of a nodule has to be in a tool.

    Args:
        target: (3,) float64, LPS mm.
        points ((K, 3) float64): Of the tool, in the frame of the last tip, +z ahead; one at its origin where
            the tip itself counts.
        weight: What each of the points stands for, in the unit of `least`.
        tissue ((X, Y, Z) uint8): 1 in the nodule; empty where the nodule is a ball about the target.
        geometry ((3, 4) float64): From LPS mm to voxels of it, of which number i spans i to i + 1.
        inner_mm, outer_mm: Distances from the target between which a ball counts.
        covered ((M, 3) float64): Points of the nodule, LPS mm from the target, where its share in the tool
            counts; each then stands for `weight`.  Else there are none.
        beyond_mm, half_mm, radius_mm: How far the tip lies beyond the middle of the tool, half its length,
            and its radius.
        tapers: Whether the tool is an ellipsoid.
        least: So much is enough.
    """

    target: Float
    points: Float
    weight: float
    tissue: UInt8
    geometry: Float
    inner_mm: float
    outer_mm: float
    covered: Float
    beyond_mm: float
    half_mm: float
    radius_mm: float
    tapers: bool
    least: float


@borrowing_kernel
def miss_of(wanted, shift, end):
    """Return how far the middle of the tool is from the target, mm."""
    back, target = wanted.beyond_mm, wanted.target
    dx = end[0] - back * end[3] - target[0] - shift[0]
    dy = end[1] - back * end[4] - target[1] - shift[1]
    dz = end[2] - back * end[5] - target[2] - shift[2]
    return math.sqrt(dx * dx + dy * dy + dz * dz)


@borrowing_kernel
def _covered(wanted, shift, end):
    """Return how many points of the nodule are in the tool."""
    x, y, z, tx, ty, tz, _nx, _ny, _nz = end
    target, back, found = wanted.target, wanted.beyond_mm, 0
    x, y, z = x - back * tx - target[0], y - back * ty - target[1], z - back * tz - target[2]
    x, y, z = x - shift[0], y - shift[1], z - shift[2]
    for k in range(wanted.covered.shape[0]):
        dx, dy, dz = wanted.covered[k, 0] - x, wanted.covered[k, 1] - y, wanted.covered[k, 2] - z
        ahead = dx * tx + dy * ty + dz * tz
        along = (ahead / wanted.half_mm) ** 2
        across = max(dx * dx + dy * dy + dz * dz - ahead * ahead, 0.0) / wanted.radius_mm**2
        found += along + across <= 1.0 if wanted.tapers else along <= 1.0 and across <= 1.0
    return found


@borrowing_kernel
def _seen(geometry, has_voxels, x, y, z, w):
    """Return a direction (w 0) or a point (w 1) in voxels of the nodule, or in mm where it is a ball."""
    if not has_voxels:
        return x, y, z
    g = geometry
    return (
        g[0, 0] * x + g[0, 1] * y + g[0, 2] * z + g[0, 3] * w,
        g[1, 0] * x + g[1, 1] * y + g[1, 2] * z + g[1, 3] * w,
        g[2, 0] * x + g[2, 1] * y + g[2, 2] * z + g[2, 3] * w,
    )


@borrowing_kernel
def tissue_taken(wanted, shift, end):
    """Return how much of the nodule is in the tool, in the unit of `least`."""
    if wanted.covered.shape[0] != 0:
        return _covered(wanted, shift, end) * wanted.weight
    x, y, z, tx, ty, tz, nx, ny, nz = end
    ni, nj, nk = wanted.tissue.shape
    target, points, has_voxels, found = wanted.target, wanted.points, ni != 0, 0
    # The frame of the tool is laid into the nodule once, not each of its points.
    x, y, z = x - shift[0], y - shift[1], z - shift[2]
    if not has_voxels:
        x, y, z = x - target[0], y - target[1], z - target[2]
    bx, by, bz = ty * nz - tz * ny, tz * nx - tx * nz, tx * ny - ty * nx
    x, y, z = _seen(wanted.geometry, has_voxels, x, y, z, 1.0)
    tx, ty, tz = _seen(wanted.geometry, has_voxels, tx, ty, tz, 0.0)
    nx, ny, nz = _seen(wanted.geometry, has_voxels, nx, ny, nz, 0.0)
    bx, by, bz = _seen(wanted.geometry, has_voxels, bx, by, bz, 0.0)
    for k in range(points.shape[0]):
        a, b, c = points[k, 0], points[k, 1], points[k, 2]
        u, v, w = x + a * nx + b * bx + c * tx, y + a * ny + b * by + c * ty, z + a * nz + b * bz + c * tz
        if has_voxels:
            inside = 0.0 <= u < ni and 0.0 <= v < nj and 0.0 <= w < nk
            found += inside and wanted.tissue[int(u), int(v), int(w)] != 0
        else:
            found += wanted.inner_mm <= math.sqrt(u * u + v * v + w * w) <= wanted.outer_mm
    return found * wanted.weight


@kernel()
def taken_at(wanted, frame):
    """Return how much of the nodule is in the tool, as planned, whose tip has a frame `(4, 4)`, LPS mm."""
    ahead = frame[0, 2], frame[1, 2], frame[2, 2]
    end = (frame[0, 3], frame[1, 3], frame[2, 3], *ahead, frame[0, 0], frame[1, 0], frame[2, 0])
    return tissue_taken(wanted, (0.0, 0.0, 0.0), end)


@kernel(nogil=True)
def taken_in(wanted, shifts, ends, moved, taken):
    """Note how much of nodules that lie `shifts` `(N, 3)` aside is in tools.

    Args:
        wanted: Wanted.
        shifts: (N, 3) float64, mm.
        ends ((N, 9) float64): Where tools are, before they are moved.
        moved ((12,) float64): Rotation, row by row, and shift in mm, LPS, by which all of them are moved.
        taken: (N,) float64.
    """
    m = moved
    for n in range(ends.shape[0]):
        x, y, z, tx, ty, tz, nx, ny, nz = ends[n]
        end = (
            x + m[9], y + m[10], z + m[11],
            m[0] * tx + m[1] * ty + m[2] * tz, m[3] * tx + m[4] * ty + m[5] * tz,
            m[6] * tx + m[7] * ty + m[8] * tz,
            m[0] * nx + m[1] * ny + m[2] * nz, m[3] * nx + m[4] * ny + m[5] * nz,
            m[6] * nx + m[7] * ny + m[8] * nz,
        )  # fmt: skip
        taken[n] = tissue_taken(wanted, (shifts[n, 0], shifts[n, 1], shifts[n, 2]), end)
