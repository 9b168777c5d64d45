"""Clearance fields: the distance to a structure, exact at lattice points and bounded in between.

The corner of a voxel lattice nearest to a box of voxels is a corner of that box, so the distance
from every corner to a union of solid voxel boxes is the Euclidean distance transform of the set of
corners that touch the structure: exact, with voxels as solid boxes and any voxel size.
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import GridMismatchError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Mask, UInt16
from anatomy.grid import Grid, read_only
from anatomy.kernels import field as kernel
from anatomy.kernels.distance import NONE, fill_distances

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
    fill_distances(near, squares, shift)
    return near


def distance_field(name: str, mask: Mask, grid: Grid, half_voxels: float = SOLID) -> DistanceField:
    """Make the field of the distance to `mask`, a bool array on `grid`, as `SOLID` boxes or `CENTRES`."""
    corners = distance_corners(mask, grid.spacing_mm, half_voxels)
    return DistanceField(name=name, corners=corners, geometry=corner_geometry(grid, half_voxels))
