"""The finer voxels of a CT: where they lie, what the image holds there, and how masks come onto them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from anatomy.base.errors import GridMismatchError, SettingsError
from anatomy.grid import Grid, Volume
from anatomy.segmentation.box import Box, between
from anatomy.segmentation.folder import onto_grid
from anatomy.segmentation.lungs import Lungs

THICK = Grid.from_spacing((40, 36, 30), (0.8, 0.8, 3.0), (-10.0, 5.0, 100.0))


def ball(grid: Grid, radius_mm: float) -> np.ndarray:
    """Return the voxels whose middles lie in a ball about the middle of the grid."""
    points = grid.lps(np.moveaxis(np.indices(grid.shape), 0, -1))
    return np.linalg.norm(points - grid.lps((np.array(grid.shape) - 1) / 2), axis=-1) <= radius_mm


def lungs_of(mask: np.ndarray) -> Lungs:
    nothing = np.zeros_like(mask)
    seed = np.argwhere(mask)[0]
    return Lungs(left=mask, right=nothing, trachea_seed_ijk=seed, central_airway=nothing, threshold_hu=-500.0)


def test_finer_voxels_share_the_edges_of_the_image_and_are_nearly_cubes() -> None:
    lattice = Box.whole(THICK, 0.75).lattice
    assert lattice.shape == (40, 36, 120)
    assert lattice.spacing_mm == pytest.approx((0.8, 0.8, 0.75))
    ends = np.array([(-0.5, -0.5, -0.5), np.array(lattice.shape) - 0.5])
    assert lattice.lps(ends) == pytest.approx(THICK.lps(np.array([(-0.5,) * 3, np.array(THICK.shape) - 0.5])))


def test_a_ct_of_voxels_as_asked_is_only_cut() -> None:
    rng = np.random.default_rng(0)
    ct = Volume(grid=THICK, array=rng.integers(-1000, 400, THICK.shape).astype(np.int16))
    box = Box.whole(THICK, 3.0).part((2, 3, 4), (20, 21, 22))
    assert box.lattice is THICK
    np.testing.assert_array_equal(box.image(ct).array, ct.array[2:20, 3:21, 4:22])
    np.testing.assert_array_equal(box.sampled(ct.array), ct.array[2:20, 3:21, 4:22])


def test_the_image_is_a_cubic_spline_that_stays_between_its_voxels() -> None:
    rng = np.random.default_rng(1)
    values = rng.normal(size=(6, 5, 20)).astype(np.float32)
    places = [np.arange(6.0), np.arange(5.0), np.linspace(0.0, 19.0, 58)]
    found = between(values, places)
    below = np.floor(places[2]).astype(int)
    pair = values[:, :, below], values[:, :, np.minimum(below + 1, 19)]
    spline = ndimage.map_coordinates(
        values.astype(float), np.stack(np.meshgrid(*places, indexing="ij")), order=3, mode="mirror"
    )
    np.testing.assert_allclose(found, np.clip(spline, np.minimum(*pair), np.maximum(*pair)), atol=2e-6)
    assert (found != spline).any()
    edge = np.where(np.arange(20) < 10, -860.0, 40.0).astype(np.float32)
    across = between(np.broadcast_to(edge, (1, 1, 20)).copy(), [np.zeros(1), np.zeros(1), places[2]])
    assert across.min() == -860.0 and across.max() == 40.0


def test_lungs_between_thick_slices_are_smooth() -> None:
    """A ball keeps its surface, where slices as they are make steps of half a slice."""
    box = Box.whole(THICK, 0.75).part((0, 0, 0), (40, 36, 120))
    found = box.lungs(lungs_of(ball(THICK, 12.0))).left
    truth = ball(box.grid, 12.0)
    far = sum(ndimage.distance_transform_edt(part, sampling=0.78) for part in (truth, ~truth))
    assert far[found != truth].max() < 1.6
    wrong = np.count_nonzero(box.sampled(ball(THICK, 12.0)) != truth)
    assert np.count_nonzero(found != truth) < 0.6 * wrong


def test_the_box_holds_the_lungs_and_goes_back_to_the_ct() -> None:
    lung = ball(THICK, 9.0)
    box = Box.whole(THICK, 0.75).around(lungs_of(lung))
    assert (box.on_ct(box.sampled(lung)) == lung).all()
    grid = box.grid
    assert grid.contains(THICK.lps(np.argwhere(lung))).all()
    seed = grid.lps(box.lungs(lungs_of(lung)).trachea_seed_ijk)
    assert np.abs(seed - THICK.lps(np.argwhere(lung)[0])).max() <= 1.5


def test_masks_on_either_voxels_are_placed_and_others_refused() -> None:
    box = Box.whole(THICK, 0.75).part((1, 2, 30), (30, 31, 90))
    mask = ball(THICK, 10.0)
    np.testing.assert_array_equal(box.placed(Volume(grid=THICK, array=mask), "m"), box.sampled(mask))
    finer = ball(box.grid, 8.0)
    np.testing.assert_array_equal(box.placed(Volume(grid=box.grid, array=finer), "m"), finer)
    whole = Box.whole(THICK, 0.75)
    back = whole.placed_on_ct(Volume(grid=box.grid, array=box.sampled(mask)), "m").array
    np.testing.assert_array_equal(back[2:29, 3:30, 8:22], mask[2:29, 3:30, 8:22])
    other = Grid.from_spacing((9, 9, 9), (1.1, 1.1, 1.1), (0.3, 0.0, 0.0))
    for place in (box.placed, whole.placed_on_ct):
        with pytest.raises(GridMismatchError, match="m are not those of the CT"):
            place(Volume(grid=other, array=np.ones(other.shape, dtype=bool)), "m")


@pytest.mark.parametrize("voxel_mm", [0.0, 0.1, 5.0, float("nan")])
def test_voxels_of_an_impossible_size_are_refused(voxel_mm: float) -> None:
    with pytest.raises(SettingsError, match="Voxels of"):
        Box.whole(THICK, voxel_mm)


def test_an_image_is_placed_by_its_voxels() -> None:
    grid = Grid.from_spacing((10, 11, 12), (1.0, 2.0, 3.0), (0, 0, 0))
    part = Volume(grid=grid.crop((-2, 3, 4), (5, 20, 9)), array=np.ones((7, 17, 5), dtype=np.uint8))
    placed = onto_grid(part, grid, "part").array
    assert placed[:5, 3:, 4:9].all()
    assert placed.sum() == 5 * 8 * 5
    matrix = part.grid.lps_from_ijk.copy()
    matrix[0, 3] += 0.3
    shifted = Grid(shape=part.grid.shape, lps_from_ijk=matrix)
    with pytest.raises(GridMismatchError):
        onto_grid(Volume(grid=shifted, array=part.array), grid, "part")
