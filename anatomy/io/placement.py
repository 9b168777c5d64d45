"""A mask on a grid of its own, placed on the grid of the other masks by its own header."""

from itertools import product

import numpy as np

from anatomy.base.errors import FrameError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Array, Bool, Float, Int
from anatomy.grid import Grid, transform_points

SHIFT_TOLERANCE = 0.05
"""Largest deviation of voxels that count as the same, in voxels: headers are rounded to some digits."""
LARGEST_GROWTH = 4.0
"""A box that holds two masks of one body is not larger than this many times the larger of them."""


@frozen_record
class Placed:
    """An image on the grid it was placed on.

    Args:
        array: With the fill value beyond the image.
        n_voxels, n_lost: How many voxels of the image are not zero, and how many of these lie outside the
            grid.
        is_resampled: Whether the voxels of the two grids do not coincide.
    """

    array: Array
    n_voxels: int
    n_lost: int
    is_resampled: bool


def place(array: Array, source: Grid, target: Grid, *, solid: bool = False, fill: float = 0) -> Placed:
    """Place an image on another grid by the nearest position.

    Args:
        array ((ni, nj, nk), of any type): The image on `source`.
        solid: Whether every voxel that is not zero must remain: a voxel of the grid is also set if the centre
            of one lies in it, so that thin obstacles leave no holes in coarser voxels.
        fill: The value beyond the image.
    """
    target_from_source = target.ijk_from_lps @ source.lps_from_ijk
    source_from_target = source.ijk_from_lps @ target.lps_from_ijk
    placed = np.full(target.shape, fill, dtype=array.dtype, order="F")
    order = _axis_order(target_from_source, source.shape)
    if order is None:
        _sample_obliquely(array, source_from_target, placed)
    else:
        _sample_along_axes(array, source_from_target, order, placed)
    voxels = np.argwhere(array)
    at = np.floor(transform_points(target_from_source, voxels) + 0.5).astype(np.int64)
    inside = ((at >= 0) & (at < np.array(target.shape))).all(axis=1)
    is_resampled = order is None or not _is_whole(target_from_source, source.shape)
    if solid and is_resampled:
        placed[tuple(at[inside].T)] = array[tuple(voxels[inside].T)]
    return Placed(
        array=placed,
        n_voxels=len(voxels),
        n_lost=int(len(voxels) - np.count_nonzero(inside)),
        is_resampled=is_resampled,
    )


def union_grid(reference: Grid, others: list[tuple[str, Grid]]) -> Grid:
    """Return the voxels of `reference` continued to the box that holds the other grids as well.

    Raises:
        FrameError: If one of them lies so far away that its header, or that of the reference, must be wrong.
    """
    low, high = np.zeros(3), np.array(reference.shape, dtype=np.float64)
    for name, grid in others:
        if reference.is_close(grid):
            continue
        first, last = box_in(reference, grid)
        low, high = np.minimum(low, first), np.maximum(high, last)
        largest = max(np.prod(grid.shape), np.prod(reference.shape))
        finer = max(1.0, grid.voxel_volume_mm3 / reference.voxel_volume_mm3)
        if not np.prod(high - low) <= LARGEST_GROWTH * largest * finer:
            raise FrameError(
                f"{name} lies apart from the other masks: its header says {grid.describe()}",
                expected=f"a place near {reference.describe()}",
                remedy="Check the header of this file, and whether it belongs to the same patient",
            )
    start, stop = np.floor(low + SHIFT_TOLERANCE), np.ceil(high - SHIFT_TOLERANCE)
    if not start.any() and (stop == reference.shape).all():
        return reference
    return reference.crop(start, stop)


def box_in(reference: Grid, grid: Grid) -> tuple[Float, Float]:
    """Return where a grid begins and ends `(3,)`, in voxels of the reference: `low <= ijk < high`."""
    corners = np.array(list(product(*((-0.5, n - 0.5) for n in grid.shape))))
    ijk = reference.ijk(grid.lps(corners)) + 0.5
    return np.asarray(ijk.min(axis=0)), np.asarray(ijk.max(axis=0))


def covers_same_voxels(grid: Grid, other: Grid) -> bool:
    """Tell whether two grids have the same voxels, in whatever order their axes run."""
    target_from_source = other.ijk_from_lps @ grid.lps_from_ijk
    if _axis_order(target_from_source, grid.shape) is None or not _is_whole(target_from_source, grid.shape):
        return False
    low, high = box_in(other, grid)
    return bool(max(np.abs(low).max(), np.abs(high - other.shape).max()) <= SHIFT_TOLERANCE)


def _axis_order(target_from_source: Float, shape: tuple[int, ...]) -> Int | None:
    """Return which axis of the source runs along each axis of the target; None if axes are oblique."""
    axes = np.abs(target_from_source[:3, :3])
    order = np.argmax(axes, axis=1)
    rest = axes.copy()
    rest[np.arange(3), order] = 0.0
    if len(set(order.tolist())) < 3 or (rest * np.array(shape)).max() > SHIFT_TOLERANCE:
        return None
    return np.asarray(order, dtype=np.int64)


def _is_whole(target_from_source: Float, shape: tuple[int, ...]) -> bool:
    """Tell whether voxels coincide, in whatever order the axes run."""
    corners = np.array(list(product(*((0, n - 1) for n in shape))))
    at = transform_points(target_from_source, corners)
    sizes = np.abs(target_from_source[:3, :3]).max(axis=0)
    steps = np.abs(sizes - 1.0) * np.array(shape)
    return bool(max(np.abs(at - np.rint(at)).max(), steps.max()) <= SHIFT_TOLERANCE)


def _sample_along_axes(array: Array, source_from_target: Float, order: Int, placed: Array) -> None:
    turned = array.transpose(tuple(order))
    index: list[Int] = []
    where: list[Bool] = []
    for axis, source_axis in enumerate(order):
        step, offset = source_from_target[source_axis, axis], source_from_target[source_axis, 3]
        at = np.floor(step * np.arange(placed.shape[axis]) + offset + 0.5).astype(np.int64)
        inside = (at >= 0) & (at < turned.shape[axis])
        index.append(at[inside])
        where.append(inside)
    if all(len(at) for at in index):
        placed[np.ix_(*where)] = turned[np.ix_(*index)]


def _sample_obliquely(array: Array, source_from_target: Float, placed: Array) -> None:
    """Sample plane by plane: the positions of all voxels at once would fill the memory."""
    i, j = np.indices(placed.shape[:2])
    for k in range(placed.shape[2]):
        plane = np.stack([i, j, np.full_like(i, k)], axis=-1)
        at = np.floor(transform_points(source_from_target, plane) + 0.5).astype(np.int64)
        inside = ((at >= 0) & (at < np.array(array.shape))).all(axis=-1)
        placed[:, :, k][inside] = array[tuple(at[inside].T)]
