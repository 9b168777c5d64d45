"""Voxel grids and volumes in LPS millimetres, indexed `[i, j, k]`."""

from itertools import product
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from anatomy.base.errors import FrameError, GridMismatchError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Array, Bool, Float, Int

ORTHONORMAL_TOLERANCE = 1e-4
"""Headers store directions in single precision with six digits or so; grids have the nearest rotation."""


def read_only(array: Array) -> Array:
    """Return a view of `array` that cannot be written through."""
    view = array.view()
    view.flags.writeable = False
    return view


def freeze_arrays(record: object, *names: str, dtype: DTypeLike | None = None) -> None:
    """Make arrays of a frozen record read-only as it is made; with a dtype, copies of them."""
    for name in names:
        array = getattr(record, name)
        object.__setattr__(record, name, read_only(array if dtype is None else np.array(array, dtype=dtype)))


def transform_points(target_from_source: ArrayLike, points: ArrayLike) -> Float:
    """Map points `(..., 3)` through a 4x4 homogeneous matrix."""
    matrix = np.asarray(target_from_source, dtype=np.float64)
    return np.asarray(points, dtype=np.float64) @ matrix[:3, :3].T + matrix[:3, 3]


@frozen_record
class Grid:
    """A rectilinear voxel grid; integer `ijk` are voxel CENTRES.

    Args:
        shape ((3,) int): Number of voxels along i, j, k.
        lps_from_ijk ((4, 4) float64): Maps voxel indices to LPS mm.  Its columns must be orthogonal,
            right-handed and non-zero.

    Raises:
        FrameError: If the matrix is not finite, not affine, sheared, mirrored or of zero size.
    """

    shape: tuple[int, int, int]
    lps_from_ijk: Float

    def __post_init__(self) -> None:
        matrix = np.array(self.lps_from_ijk, dtype=np.float64)
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            raise FrameError(
                "A grid matrix is not a finite 4x4 matrix",
                expected="lps_from_ijk, which maps voxel indices to LPS mm",
                remedy="Check the image header",
            )
        # The last row of a homogeneous matrix is exact in every format.
        if not np.abs(matrix[3] - (0.0, 0.0, 0.0, 1.0)).max() <= 1e-9:
            raise FrameError(
                f"The last row of a grid matrix is {matrix[3].tolist()}",
                expected="[0, 0, 0, 1]",
                remedy="The matrix may be transposed: its last column holds the position of the first voxel",
            )
        columns = matrix[:3, :3]
        spacing = np.linalg.norm(columns, axis=0)
        if not (spacing > 0).all():
            raise FrameError(
                f"A grid has the voxel size {spacing.tolist()} mm",
                expected="three positive lengths",
                remedy="Check the spacing in the image header",
            )
        direction = columns / spacing
        if not np.abs(direction.T @ direction - np.eye(3)).max() <= ORTHONORMAL_TOLERANCE:
            raise FrameError(
                f"The axes of an image are not orthonormal: {np.round(direction, 4).tolist()}",
                expected="three perpendicular unit axes (no shear or gantry tilt)",
                remedy="Resample the image onto an orthogonal grid",
            )
        # Axes that differ by less are perpendicular up to the rounding of double precision.
        if np.abs(direction.T @ direction - np.eye(3)).max() > 1e-12:
            # Distances are computed as if the axes were perpendicular, so they are made so.
            left, _stretch, right = np.linalg.svd(direction)
            matrix[:3, :3] = left @ right * spacing
        if not np.linalg.det(direction) > 0:
            raise FrameError(
                "The axes of an image form a left-handed frame (determinant < 0)",
                expected="a right-handed frame",
                remedy="The image is mirrored: re-export it, or flip one axis of data and header",
            )
        object.__setattr__(self, "shape", tuple(int(n) for n in self.shape))
        object.__setattr__(self, "lps_from_ijk", read_only(matrix))

    @classmethod
    def from_spacing(cls, shape: ArrayLike, spacing_mm: ArrayLike, origin_lps: ArrayLike) -> Self:
        """Make a grid whose axes are the LPS axes; `origin_lps` is the centre of voxel 0, 0, 0."""
        matrix = np.eye(4)
        matrix[:3, :3] = np.diag(np.asarray(spacing_mm, dtype=np.float64))
        matrix[:3, 3] = origin_lps
        ni, nj, nk = (int(n) for n in np.asarray(shape))
        return cls(shape=(ni, nj, nk), lps_from_ijk=matrix)

    @classmethod
    def over(cls, low_lps: Float, high_lps: Float, spacing_mm: float) -> Self:
        """Make a grid of cubic voxels along LPS, whose centres reach from one corner `(3,)` to another."""
        return cls.from_spacing(np.ceil((high_lps - low_lps) / spacing_mm) + 1, (spacing_mm,) * 3, low_lps)

    @property
    def centres_lps(self) -> Float:
        """The middles of all voxels, `(ni, nj, nk, 3)`."""
        return self.lps(np.moveaxis(np.indices(self.shape), 0, -1))

    @property
    def spacing_mm(self) -> Float:
        """Voxel size along i, j, k, `(3,)` mm."""
        return np.asarray(np.linalg.norm(self.lps_from_ijk[:3, :3], axis=0))

    @property
    def ijk_from_lps(self) -> Float:
        """The inverse of `lps_from_ijk`, `(4, 4)`."""
        return np.asarray(np.linalg.inv(self.lps_from_ijk))

    @property
    def voxel_volume_mm3(self) -> float:
        """Volume of one voxel."""
        return float(np.prod(self.spacing_mm))

    def lps(self, ijk: ArrayLike) -> Float:
        """Map indices `(..., 3)` (fractions allowed) to LPS mm."""
        return transform_points(self.lps_from_ijk, ijk)

    def ijk(self, lps: ArrayLike) -> Float:
        """Map LPS mm `(..., 3)` to fractional indices."""
        return transform_points(self.ijk_from_lps, lps)

    @property
    def corners_lps(self) -> Float:
        """The middles of the eight voxels in the corners, `(8, 3)`."""
        return self.lps(list(product(*[(0, n - 1) for n in self.shape])))

    def voxels(self, lps: ArrayLike) -> Int:
        """Return the indices of the voxels that hold points `(..., 3)` LPS mm, beyond the grid as well."""
        return np.floor(self.ijk(lps) + 0.5).astype(np.int64)

    def values_at(self, array: Array, lps: ArrayLike, beyond: float) -> Array:
        """Return what an array `(ni, nj, nk)` holds at points `(..., 3)` LPS mm, `beyond` off the grid."""
        places = np.moveaxis(self.voxels(lps), -1, 0)
        # Axis by axis: of many points numpy.all over the last axis would take longer than all else.
        within = [(place >= 0) & (place < n) for place, n in zip(places, self.shape, strict=True)]
        inside = within[0] & within[1] & within[2]
        found = np.full(inside.shape, beyond, dtype=array.dtype)
        found[inside] = array[tuple(place[inside] for place in places)]
        return found

    def contains(self, lps: ArrayLike) -> Bool:
        """Tell which points `(..., 3)` lie in a voxel of the grid."""
        ijk = np.floor(self.ijk(lps) + 0.5)
        return np.asarray(((ijk >= 0) & (ijk < np.asarray(self.shape))).all(axis=-1))

    def crop(self, start: ArrayLike, stop: ArrayLike) -> "Grid":
        """Return the grid of voxels `start <= ijk < stop`; it may reach beyond this grid."""
        start = np.asarray(start, dtype=np.int64)
        shape = np.asarray(stop, dtype=np.int64) - start
        matrix = self.lps_from_ijk.copy()
        matrix[:3, 3] = self.lps(start)
        return Grid(shape=(int(shape[0]), int(shape[1]), int(shape[2])), lps_from_ijk=matrix)

    def window(self, points_lps: ArrayLike, border_mm: float) -> tuple[slice, slice, slice]:
        """Return slices of the box of voxels that lie within a border around points `(..., 3)` in LPS mm."""
        ijk = self.ijk(points_lps).reshape(-1, 3)
        border = border_mm / self.spacing_mm
        low = np.clip(np.floor(ijk.min(axis=0) - border).astype(int), 0, self.shape)
        high = np.clip(np.ceil(ijk.max(axis=0) + border).astype(int) + 1, 0, self.shape)
        i, j, k = (slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
        return i, j, k

    def box_distance_mm(self, voxels: ArrayLike, point_lps: ArrayLike) -> Float:
        """Return the distances `(N,)` in mm from a point `(3,)` LPS mm to voxels `(N, 3)` as solid boxes."""
        away = np.maximum(np.abs(np.asarray(voxels) - self.ijk(point_lps)) - 0.5, 0.0) * self.spacing_mm
        return np.asarray(np.linalg.norm(away, axis=1))

    def is_close(self, other: "Grid", tolerance_mm: float = 1e-2) -> bool:
        """Tell whether every voxel of the two grids agrees to `tolerance_mm`."""
        if self.shape != other.shape:
            return False
        return bool(np.abs(self.corners_lps - other.corners_lps).max() <= tolerance_mm)

    def require_same(self, other: "Grid", name: str) -> None:
        """Raise `GridMismatchError` unless `other`, the grid of `name`, is this grid."""
        if not self.is_close(other):
            raise GridMismatchError(
                f"The grid of {name} differs: {other.describe()}",
                expected=f"the grid of the other masks: {self.describe()}",
                remedy="Resample all masks of a patient onto one grid",
            )

    def describe(self) -> str:
        """Say shape, voxel size and the position of the first voxel in one line."""
        size = " x ".join(f"{s:.3f}" for s in self.spacing_mm)
        first = ", ".join(f"{x:.1f}" for x in self.lps_from_ijk[:3, 3])
        return f"{'x'.join(map(str, self.shape))} voxels of {size} mm, first at LPS ({first})"


@frozen_record
class Volume:
    """An image on a grid; `array[i, j, k]` lies Fortran-contiguous (i fastest) in memory.

    The array `(ni, nj, nk)` of any dtype (masks are bool) is made read-only and, if it is not, Fortran-
    contiguous.
    """

    grid: Grid
    array: Array

    def __post_init__(self) -> None:
        if self.array.shape != self.grid.shape:
            raise GridMismatchError(
                f"An array of shape {self.array.shape} was given for a grid of {self.grid.shape}",
                expected="equal shapes",
                remedy="Index arrays as [i, j, k]",
            )
        object.__setattr__(self, "array", read_only(np.asfortranarray(self.array)))

    def at(self, lps: ArrayLike, beyond: float) -> Array:
        """Return the values of the voxels that hold points `(..., 3)` LPS mm, `beyond` off the grid."""
        return self.grid.values_at(self.array, lps, beyond)
