"""Lungs and other masks made by other programs or by hand, in place of a step of the segmentation."""

from __future__ import annotations

import numpy as np

from anatomy.errors import AnatomyError
from anatomy.grid import Grid, Volume
from anatomy.morphology import bounds, window
from anatomy.segmentation.coarse import CoarseCt
from anatomy.sides import grow_sides
from anatomy.typed import Array, Int32, Mask, UInt8

RIGHT, LEFT = 1, 2
_LOBES_RIGHT, _LOBES_LEFT = (3, 4, 5), (1, 2)
"""Labels of lungmask's model of lobes: 1, 2 left upper and lower; 3, 4, 5 right upper, middle, lower."""


def lung_labels(left: Mask, right: Mask) -> UInt8:
    """Return the label map of two lungs: 1 right, 2 left, as lungmask has them."""
    labels = np.zeros(left.shape, dtype=np.uint8, order="F")
    labels[right] = RIGHT
    labels[left] = LEFT
    return labels


def sides_of(volume: Volume, name: str) -> tuple[Mask, Mask]:
    """Return the left and the right lung of a label map or mask.

    The values may be 1 right, 2 left (lungmask, and our own files); 1 to 5 for the lobes (lungmask
    LTRCLobes); or one value for both lungs, which are then told apart by their shape.  One lung alone is the
    left one if its value is 2, else the right one.

    Raises
    ------
    AnatomyError
        If there is no lung, or other values occur.
    """
    values = {float(v) for v in np.unique(volume.array)} - {0.0}
    if not values:
        raise AnatomyError(
            f"{name} holds no lung",
            expected="voxels that are not zero",
            remedy="Give another mask with --lungs, or leave the option out",
        )
    if values == {RIGHT, LEFT}:
        return volume.array == LEFT, volume.array == RIGHT
    if values <= {1, 2, 3, 4, 5} and len(values) > 2:
        return np.isin(volume.array, _LOBES_LEFT), np.isin(volume.array, _LOBES_RIGHT)
    if len(values) == 1:
        left, right = split_sides(np.asfortranarray(volume.array != 0), volume.grid)
        return (right, left) if values == {LEFT} and not left.any() else (left, right)
    raise AnatomyError(
        f"{name} holds the values {sorted(values)[:9]}",
        expected="1 right and 2 left lung, lobes 1 to 5, or one value for both lungs",
        remedy="Export the lungs again as one of these",
    )


def split_sides(mask: Mask, grid: Grid) -> tuple[Mask, Mask]:
    """Return the left and the right lung of a mask of both; one alone counts as right."""
    coarse = CoarseCt.of(Volume(grid=grid, array=mask.astype(np.int16)))
    tissue = np.asfortranarray(coarse.hu >= 0.5)
    sides = sides_from_right(tissue, coarse)
    if sides is None:
        return np.zeros_like(mask), mask
    nearest = _nearest(sides, coarse)
    low, high = np.zeros(3, dtype=np.int64), np.asarray(mask.shape)
    fine = coarse.to_ct(nearest, low, high)
    return mask & (fine == LEFT), mask & (fine == RIGHT)


def sides_from_right(tissue: Mask, coarse: CoarseCt) -> Int32 | None:
    """Label the right lung 1 and the left 2 over coarse voxels of lung; None if there are not two."""
    low, high = bounds(tissue)
    box = window(low, high)
    found = grow_sides(tissue[box], tissue[box], coarse.grid.lps_from_ijk[:3, :3])
    if found is None:
        return None
    means = [float(np.argwhere(found == label)[:, 0].mean()) for label in (1, 2)]
    sides = np.zeros(tissue.shape, dtype=np.int32, order="F")
    sides[box] = found if means[0] < means[1] else np.where(found > 0, 3 - found, 0)
    return sides


def _nearest(sides: Int32, coarse: CoarseCt) -> Array:
    """Give every coarse voxel the side that is nearest to it."""
    import edt

    distance = [
        edt.edt(np.asfortranarray(sides != side), anisotropy=coarse.spacing_mm, order="F")
        for side in (RIGHT, LEFT)
    ]
    return np.where(distance[0] <= distance[1], RIGHT, LEFT).astype(np.uint8)
