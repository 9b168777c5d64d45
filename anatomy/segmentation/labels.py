"""Lungs and other masks made by other programs or by hand, in place of a step of the segmentation."""

from collections.abc import Iterable, Mapping

import numpy as np

from anatomy.base.errors import AnatomyError
from anatomy.base.typed import Array, Float, Int32, Mask, UInt8
from anatomy.grid import Grid, Volume
from anatomy.lobes import LEFT_LOWER, LEFT_UPPER, RIGHT_LOWER, RIGHT_MIDDLE, RIGHT_UPPER
from anatomy.morphology import bounds, distance_mm, window
from anatomy.segmentation.coarse import CoarseCt
from anatomy.sides import grow_sides

RIGHT, LEFT = 1, 2
NUMBERINGS: Mapping[str, tuple[int, ...]] = {
    "our own": (RIGHT_UPPER, RIGHT_MIDDLE, RIGHT_LOWER, LEFT_UPPER, LEFT_LOWER),
    "lungmask": (LEFT_UPPER, LEFT_LOWER, RIGHT_UPPER, RIGHT_MIDDLE, RIGHT_LOWER),
}
"""The lobes that the labels 1 to 5 mean: of this program, and of lungmask's model LTRCLobes (0.2)."""
FIRST_OF_TOTAL = 10
"""TotalSegmentator's task total (2.x) has the lobes in the order of lungmask, from this label on."""


def lung_labels(left: Mask, right: Mask) -> UInt8:
    """Return the label map of two lungs: 1 right, 2 left, as lungmask has them."""
    labels = np.zeros(left.shape, dtype=np.uint8, order="F")
    labels[right] = RIGHT
    labels[left] = LEFT
    return labels


def sides_of(volume: Volume, name: str) -> tuple[Mask, Mask]:
    """Return the left and the right lung of a label map or mask.

    The values may be 1 right, 2 left (lungmask, and our own files); those of lobes, see `lobe_numbers`; or
    one value for both lungs, which are then told apart by their shape.  One lung alone is the left one if its
    value is 2, else the right one.  Raises AnatomyError if there is no lung, other values occur, or they are
    on the wrong side.
    """
    values = {float(v) for v in np.unique(volume.array)} - {0.0}
    if not values:
        raise AnatomyError(
            f"{name} holds no lung",
            expected="voxels that are not zero",
            remedy="Give another mask with --lungs, or leave the option out",
        )
    if values == {RIGHT, LEFT}:
        left, right = volume.array == LEFT, volume.array == RIGHT
        if _middles(volume.grid, (left, right))[0, 0] < _middles(volume.grid, (left, right))[1, 0]:
            raise AnatomyError(
                f"{name} has label 1, the right lung, on the patient's left",
                expected="1 right and 2 left lung, as lungmask writes them, and a header that fits",
                remedy="Check whether the mask is mirrored, or exchange the labels",
            )
        return left, right
    if values <= set(range(1, FIRST_OF_TOTAL + 5)) and len(values) > 2:
        sides = sides_of_lobes(lobe_numbers(volume, name))
        return sides == LEFT, sides == RIGHT
    if len(values) == 1:
        left, right = _split_sides(np.asfortranarray(volume.array != 0), volume.grid)
        return (right, left) if values == {LEFT} and not left.any() else (left, right)
    raise AnatomyError(
        f"{name} holds the values {sorted(values)[:9]}",
        expected="1 right and 2 left lung, lobes 1 to 5, or one value for both lungs",
        remedy="Export the lungs again as one of these",
    )


def sides_of_lobes(lobes: Array) -> UInt8:
    """Return the label map of the lungs that lobes `(ni, nj, nk)` by our own numbers make up."""
    return lung_labels(lobes >= LEFT_UPPER, (lobes > 0) & (lobes <= RIGHT_LOWER))


def lobe_numbers(volume: Volume, name: str) -> UInt8:
    """Return lobes by the numbers of `anatomy.lobes.LOBES`.

    Labels are 1 to 5 by one of `NUMBERINGS`, or 10 to 14 of TotalSegmentator's task total.  Which one it is,
    is told by where the lobes lie: right ones on the right, and upper ones above lower ones.  Raises
    AnatomyError if other values occur, or the lobes lie as in none of these.
    """
    values = sorted({int(v) for v in np.unique(volume.array)} - {0})
    first = FIRST_OF_TOTAL if values and values[0] >= FIRST_OF_TOTAL else 1
    fitting: tuple[int, ...] = ()
    if len(values) >= 2 and first <= values[0] and values[-1] <= first + 4:
        middles = _middles(volume.grid, [volume.array == value for value in values])
        known = (NUMBERINGS["lungmask"],) if first > 1 else tuple(NUMBERINGS.values())
        lobes = [[numbering[value - first] for value in values] for numbering in known]
        fitting = next((n for n, each in zip(known, lobes, strict=True) if _fits(each, middles)), ())
    if not fitting:
        raise AnatomyError(
            f"{name} holds the values {values[:9]}, which lie as the lobes of no known numbering do",
            expected="1 to 5 as this program or lungmask numbers them, or 10 to 14 of TotalSegmentator, with "
            "right lobes on the right and upper ones above lower ones",
            remedy="Check whether the mask is mirrored or upside down, and name its labels after their lobes",
        )
    table = np.zeros(first + 5, dtype=np.uint8)
    table[first:] = fitting
    return np.asfortranarray(table[volume.array.astype(np.int64)])


def _fits(lobes: list[int], middles: Float) -> bool:
    """Tell whether lobes lie where they belong, `middles` `(N, 3)` being LPS mm."""
    at = dict(zip(lobes, middles, strict=True))
    right = [place[0] for lobe, place in at.items() if lobe <= RIGHT_LOWER]
    left = [place[0] for lobe, place in at.items() if lobe > RIGHT_LOWER]
    above = [
        at[upper][2] > at[lower][2]
        for upper, lower in ((RIGHT_UPPER, RIGHT_LOWER), (LEFT_UPPER, LEFT_LOWER))
        if upper in at and lower in at
    ]
    return all(above) and max(right, default=-np.inf) < min(left, default=np.inf)


def _middles(grid: Grid, masks: Iterable[Mask]) -> Float:
    found = []
    for mask in masks:
        lines = [mask.sum(axis=axes) for axes in ((1, 2), (0, 2), (0, 1))]
        found.append([float(np.average(np.arange(len(line)), weights=line)) for line in lines])
    return np.asarray(grid.lps(np.array(found)))


def _split_sides(mask: Mask, grid: Grid) -> tuple[Mask, Mask]:
    """Return the left and the right lung of a mask of both; one alone counts as right."""
    coarse = CoarseCt.of(Volume(grid=grid, array=mask.astype(np.int16)))
    sides = sides_from_right(np.asfortranarray(coarse.hu >= 0.5), coarse)
    if sides is None:
        return np.zeros_like(mask), mask
    # Every coarse voxel has the side that is nearest to it.
    right, left = (distance_mm(sides != side, coarse.spacing_mm) for side in (RIGHT, LEFT))
    nearest = np.where(right <= left, RIGHT, LEFT).astype(np.uint8)
    fine = coarse.to_ct(nearest, np.zeros(3, dtype=np.int64), np.asarray(mask.shape))
    return mask & (fine == LEFT), mask & (fine == RIGHT)


def sides_from_right(tissue: Mask, coarse: CoarseCt) -> Int32 | None:
    """Label the right lung 1 and the left 2 over coarse voxels of lung; None if there are not two."""
    box = window(*bounds(tissue))
    found = grow_sides(tissue[box], tissue[box], coarse.grid.lps_from_ijk[:3, :3])
    if found is None:
        return None
    means = [float(np.argwhere(found == label)[:, 0].mean()) for label in (1, 2)]
    sides = np.zeros(tissue.shape, dtype=np.int32, order="F")
    sides[box] = found if means[0] < means[1] else np.where(found > 0, 3 - found, 0)
    return sides
