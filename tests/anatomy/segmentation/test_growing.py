"""The wall of the airway: many voxels of it for one of the lumen, and the end of the image."""

from __future__ import annotations

import numpy as np
import pytest

from anatomy.base.typed import Mask
from anatomy.segmentation.growing import AIR_HU, WALL_MM, Ground, Grown, grow
from anatomy.segmentation.kernels.growing import rings_of
from anatomy.segmentation.kernels.lumen_edge import fill_gaps

OLD_ROOM = 128
"""So many voxels for one of the lumen once seemed enough."""
TISSUE_HU = 0


def ground(shape: tuple[int, int, int], spacing_mm: float, hu: int, hole: tuple[int, int, int]) -> Ground:
    """Return a block of one HU with one voxel of air, and no minima to grow in."""
    image = np.full(shape, hu, dtype=np.int16)
    image[hole] = AIR_HU
    return Ground(
        hu=image,
        smooth=image.copy(),
        depth=np.zeros(shape, dtype=np.int16),
        lung=np.zeros(shape, dtype=np.bool_),
        spacing_mm=np.full(3, spacing_mm),
        lung_hu=-850.0,
        dark_hu=-900.0,
        least_depth=20.0,
    )


def grown_from(ground: Ground, hole: tuple[int, int, int]) -> Grown:
    start = np.zeros(ground.hu.shape, dtype=np.bool_)
    start[hole] = True
    return grow(ground, start)


def box(shape: tuple[int, int, int], middle: tuple[int, int, int], reach: int) -> Mask:
    """Return the voxels within `reach` steps of one, without it."""
    inside = np.zeros(shape, dtype=np.bool_)
    inside[tuple(slice(max(m - reach, 0), m + reach + 1) for m in middle)] = True
    inside[middle] = False
    return inside


@pytest.mark.parametrize("spacing_mm", [0.25, 0.4])
def test_all_of_a_thick_wall_has_room(spacing_mm: float) -> None:
    shape, middle = (41, 43, 45), (20, 21, 22)
    grown = grown_from(ground(shape, spacing_mm, TISSUE_HU, middle), middle)
    wall = box(shape, middle, 1 + int(np.ceil(WALL_MM / spacing_mm)))
    assert wall.sum() > 2 * OLD_ROOM
    assert grown.lumen.sum() == 1
    np.testing.assert_array_equal(grown.wall, wall)


@pytest.mark.parametrize("corner", [(0, 0, 0), (0, 24, 0), (22, 0, 26), (22, 24, 26)])
def test_the_end_of_the_image_is_the_end_of_the_wall(corner: tuple[int, int, int]) -> None:
    shape = (23, 25, 27)
    grown = grown_from(ground(shape, 0.5, TISSUE_HU, corner), corner)
    assert grown.lumen.sum() == 1
    assert grown.wall[box(shape, corner, 1)].all()
    assert box(shape, corner, 3).sum() <= grown.wall.sum()
    assert not (grown.wall & ~box(shape, corner, 5)).any()


@pytest.mark.parametrize("share", [0.05, 0.3, 0.6, 0.9])
def test_rings_of_a_piece_are_one_less_its_euler_characteristic(share: float) -> None:
    from skimage.measure import euler_number

    state = np.zeros((12, 13, 14), dtype=np.uint8)
    state[1:-1, 1:-1, 1:-1] = np.random.default_rng(0).random((10, 11, 12)) < share
    voxels = np.flatnonzero(state)
    rings = rings_of(state.reshape(-1), np.array(state.shape), np.uint8(1), voxels, len(voxels))
    assert rings == 1 - euler_number(state > 0, connectivity=3)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_gap_of_a_slice_is_filled_where_it_is_air_alone(axis: int) -> None:
    """Two slices across an open lumen are air by their HU, though the map of minima does not show them."""
    hu = np.full((20, 20, 20), TISSUE_HU, dtype=np.int16)
    lumen = np.zeros(hu.shape, dtype=np.bool_)
    tube = [slice(8, 13)] * 3
    tube[axis] = slice(3, 17)
    lumen[tuple(tube)] = True
    gap = [slice(None)] * 3
    gap[axis] = slice(9, 11)
    hole = np.zeros_like(lumen)
    hole[tuple(gap)] = True
    hole &= lumen
    for between_hu, filled in ((AIR_HU + 60, True), (-500, False)):
        hu[lumen] = AIR_HU
        hu[hole] = between_hu
        state, listed = (lumen & ~hole).astype(np.uint8), np.zeros(hu.size, dtype=np.int64)
        known = np.flatnonzero(state)
        listed[: len(known)] = known
        reach, shape = np.full(3, 5), np.array(hu.shape)
        count = fill_gaps(hu.reshape(-1), state.reshape(-1), shape, reach, -900.0, listed, len(known))
        np.testing.assert_array_equal(state > 0, lumen if filled else lumen & ~hole)
        assert count == np.count_nonzero(state) and len(set(listed[:count])) == count
