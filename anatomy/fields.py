"""Clearance fields: the distance to a structure, exact at lattice points and bounded in between.

The corner of a voxel lattice nearest to a box of voxels is a corner of that box, so the distance
from every corner to a union of solid voxel boxes is the Euclidean distance transform of the set of
corners that touch the structure: exact, with voxels as solid boxes and any voxel size.
"""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import GridMismatchError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int, Mask, UInt16
from anatomy.grid import Grid, read_only
from anatomy.kernels import field as kernel
from anatomy.kernels.distance import NONE, fill_distances
from anatomy.morphology import Window, bounds, window

MAX_STORED = NONE
"""Distances from this on, 256 mm, are stored as it: no device looks so far."""

SOLID = 0.5
"""Obstacles are voxels as solid boxes."""
CENTRES = 0.0
"""Obstacles are the centres of their voxels."""

GEOMETRY_SHAPE = (3, 6)

LONGEST = 8192
"""Voxels along the longest side of a grid: the squares of more distances would not fit into 64 bits."""


def corner_geometry(grid: Grid, half_voxels: float = SOLID) -> Float:
    """Return the `(3, 6)` array by which kernels find a point in `grid`, see `anatomy.kernels.field`.

    Half the side of an obstacle is `half_voxels`: that of `SOLID` boxes or of `CENTRES`.
    """
    geometry = np.zeros((3, 6))
    geometry[:, :4] = grid.ijk_from_lps[:3]
    geometry[:, 3] += 0.5
    geometry[:, 4] = grid.spacing_mm**2
    geometry[:, 5] = half_voxels
    return read_only(geometry)


@frozen_record
class DistanceField:
    """The distance to a structure whose voxels are solid boxes, or count as their centres.

    Args:
        corners ((ni + 1, nj + 1, nk + 1) uint16, Fortran-contiguous): Distance at each voxel corner in 1/256
            mm, rounded down, at most 255.99 mm.
        geometry ((3, 6) float64): See `corner_geometry`.

    Raises:
        GridMismatchError: If the geometry has another shape: kernels would read beyond it.
    """

    name: str
    corners: UInt16
    geometry: Float

    def __post_init__(self) -> None:
        # One array type, memory-mapped or not, so that kernels are compiled once.
        object.__setattr__(self, "corners", read_only(np.asarray(self.corners)))
        object.__setattr__(self, "geometry", read_only(np.asarray(self.geometry)))
        if self.geometry.shape != GEOMETRY_SHAPE or self.corners.ndim != 3:
            raise GridMismatchError(
                f"The {self.name} field has a geometry of the shape {self.geometry.shape}",
                expected=f"{GEOMETRY_SHAPE} and three axes of corners",
                remedy="Make it with corner_geometry(grid)",
            )

    def lower_bound_mm(self, points_lps: ArrayLike) -> Float:
        """Return `(N,)` distances in mm that the true ones are never below, for `(N, 3)` LPS mm points.

        The bound and its derivation stand in `anatomy.kernels.field`.  Outside the grid it is 0.
        """
        points = np.ascontiguousarray(np.asarray(points_lps, dtype=np.float64).reshape(-1, 3))
        out = np.zeros(len(points))
        kernel.bounds_at(self.corners, self.geometry, points, out)
        return out


def touched_corners(mask: Mask) -> Mask:
    """Return the `(ni + 1, nj + 1, nk + 1)` corners that touch a voxel of `mask`."""
    corners: Mask = np.zeros(tuple(n + 1 for n in mask.shape), dtype=bool, order="F")
    ni, nj, nk = mask.shape
    for di in (0, 1):
        for dj in (0, 1):
            for dk in (0, 1):
                corners[di : di + ni, dj : dj + nj, dk : dk + nk] |= mask
    return corners


def distance_corners(mask: Mask, spacing_mm: ArrayLike, half_voxels: float = SOLID) -> UInt16:
    """Return the distance from voxel corners (`CENTRES`: centres) to a mask, in 1/256 mm rounded down."""
    touched = touched_corners(mask) if half_voxels == SOLID else np.asarray(mask, order="F")
    near: UInt16 = ~touched * np.uint16(NONE)
    # A voxel that is as large as distances can be is as far as can be told from the next one.
    sides = np.minimum(np.asarray(spacing_mm, dtype=np.float64), NONE / kernel.UNITS_PER_MM + 1.0)
    # The largest voxel has sides of 2**16 to 2**17 steps, so that the squares of all distances fit.
    shift = min(17 - math.ceil(math.log2(float(sides.max()))), 40)
    # Smaller by a share that is more than places of points are off: no distance is too long, and with what is
    # rounded none is too short by two of the steps in which it is stored.
    squares = np.floor((sides * 2.0**shift) ** 2 * (1.0 - 2.0**-32)).astype(np.int64)
    if max(near.shape) > LONGEST + 1 or squares.min() < 1 << 16:
        raise GridMismatchError(
            f"A grid of {near.shape} corners has voxels of {np.asarray(spacing_mm).tolist()} mm",
            expected=f"at most {LONGEST} voxels a side, whose sides differ by less than a factor of 256",
            remedy="Resample the masks to voxels that are nearly cubes",
        )
    fill_distances(near, squares, shift - round(math.log2(kernel.UNITS_PER_MM)))
    return near


def renewed_corners(
    before: UInt16, solid: Callable[[Window], Mask], changed: Window, spacing_mm: ArrayLike
) -> tuple[UInt16, Window]:
    """Return what `distance_corners` makes of a mask of which a window has changed, and where it differs.

    `before` are the distances before the change, and `solid` returns the voxels of a window of the mask.
    """
    spacing, shape = np.asarray(spacing_mm, dtype=np.float64), np.array(before.shape)
    first, last = (np.array([getattr(axis, end) for axis in changed]) for end in ("start", "stop"))
    low, high = _reach_of_change(before, first, last, spacing)
    box, inner = window(low, high), window(first - low, last + 1 - low)
    corners: UInt16 = np.array(before, order="F")
    part, points = corners[box], np.zeros(high - low, dtype=np.bool_, order="F")
    start = np.maximum(first - 1, 0)
    around = touched_corners(solid(window(start, np.minimum(last + 1, shape - 1))))
    touched = around[window(first - start, last + 1 - start)]
    points[inner] = (part[inner] == 0) & ~touched
    if points.any():
        # Where the nearest corner is gone, all that may be the nearest now is measured.
        near = bounds(distance_corners(points, spacing, CENTRES) <= part)
        begin, end, most, reach_mm = low + near[0], low + near[1], 0, -1.0
        while most >= reach_mm * kernel.UNITS_PER_MM - 2.0:
            reach_mm = (max(most, int(part[window(*near)].max())) + 3.0) / kernel.UNITS_PER_MM
            pad = np.ceil(reach_mm / spacing).astype(np.int64) + 1
            start, stop = np.maximum(begin - pad, 0), np.minimum(end - 1 + pad, shape - 1)
            found = distance_corners(solid(window(start, stop)), spacing)[window(begin - start, end - start)]
            most = int(found.max())
        part[window(*near)] = found
    points[inner] = touched
    np.minimum(part, distance_corners(points, spacing, CENTRES), out=part)
    return corners, box


def _reach_of_change(before: UInt16, first: Int, last: Int, spacing: Float) -> tuple[Int, Int]:
    """Return the first and the last but one of the corners beyond which a change makes no difference.

    Let `p` lie outside a box around the change, and let the obstacle that is nearest to it before or after,
    but not both, lie in the change.  Where the straight line between the two leaves the box, the change is as
    near as the nearest obstacle before.  So a box holds all that differs if on its faces the change is
    farther, by a diagonal of a voxel for the way to the next corner and back.
    """
    shape, pads, wider = np.array(before.shape), np.full((2, 3), 8), np.ones((2, 3), dtype=np.bool_)
    while wider.any():
        low, high = np.maximum(first - pads[0], 0), np.minimum(last + pads[1] + 1, shape)
        squares = [
            (np.maximum(np.maximum(a - at, at - b), 0) * side) ** 2
            for a, b, at, side in zip(first, last, map(np.arange, low, high), spacing, strict=True)
        ]
        wider[...] = False
        for axis, end in np.ndindex(3, 2):
            at = (low[axis], high[axis] - 1)[end]
            if 0 < at < shape[axis] - 1:
                face = before[window(low, high)].take([at - low[axis]], axis)
                i, j, k = (each[[-end]] if n == axis else each for n, each in enumerate(squares))
                away_mm = np.sqrt(i[:, None, None] + j[:, None] + k) - float(np.linalg.norm(spacing))
                wider[end, axis] = (away_mm * kernel.UNITS_PER_MM <= face + 2.0).any()
        pads += wider * (pads // 2)
    return low, high


def distance_field(name: str, mask: Mask, grid: Grid, half_voxels: float = SOLID) -> DistanceField:
    """Make the field of the distance to `mask`, a bool array on `grid`, as `SOLID` boxes or `CENTRES`."""
    corners = distance_corners(mask, grid.spacing_mm, half_voxels)
    return DistanceField(name=name, corners=corners, geometry=corner_geometry(grid, half_voxels))
