"""The airway from a CT: its kernels against naive ones, leaks, and the phantom."""

from __future__ import annotations

from dataclasses import replace

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from anatomy.base.errors import AnatomyError, GridMismatchError
from anatomy.base.typed import Int16, Mask
from anatomy.grid import Grid, Volume
from anatomy.phantom import Phantom, make_phantom
from anatomy.segmentation import growing
from anatomy.segmentation.airway import Airways, local_minima_map, scale_of, segment_airway
from anatomy.segmentation.growing import LEVEL_RATIO, levels
from anatomy.segmentation.kernels import local_minima as kernel
from anatomy.segmentation.kernels.lumen_edge import grow_wall, join_corners
from anatomy.segmentation.kernels.neighbours import box_offsets
from anatomy.segmentation.kernels.states import LUMEN
from anatomy.segmentation.lungs import Lungs
from anatomy.segmentation.scan_warnings import airway_warnings, cut_off, tree_or_error

CROSS = ndimage.generate_binary_structure(2, 1)
FACES = ndimage.generate_binary_structure(3, 1)
FULL = np.ones((3, 3, 3), dtype=bool)
AIR, WALL, TISSUE, LUNG = -1000, -100, 40, -860
POCKET_MM3 = 12 * 11 * 26
VOXEL_MM = 1.0
"""That of the phantom."""

images = hnp.arrays(
    np.int16,
    st.tuples(st.integers(1, 9), st.integers(1, 9)),
    elements=st.one_of(st.integers(-3, 3), st.integers(-1024, 3071)),
)


def eroded(image: Int16) -> Int16:
    return ndimage.minimum_filter(image, footprint=CROSS, mode="constant", cval=32767)


def dilated(image: Int16) -> Int16:
    return ndimage.maximum_filter(image, footprint=CROSS, mode="constant", cval=-32768)


def reconstructed(marker: Int16, mask: Int16) -> Int16:
    """Iterate the paper's equation to its end."""
    while True:
        lower = np.maximum(eroded(marker), mask)
        if np.array_equal(lower, marker):
            return marker
        marker = lower


def naive_depth(image: Int16, scale: int) -> Int16:
    closed = image
    for _ in range(scale):
        closed = dilated(closed)
    for _ in range(scale):
        closed = eroded(closed)
    return reconstructed(closed, image) - image


def depth(image: Int16, scale: int) -> Int16:
    out = np.zeros_like(image)
    queue = np.zeros(image.size + 1, dtype=np.int32)
    waiting = np.zeros(image.shape, dtype=bool)
    kernel.depth_slice(image, scale, np.zeros((2, *image.shape), np.int16), queue, waiting, out)
    assert not waiting.any()
    return out


@pytest.mark.slow
@settings(max_examples=200, deadline=None)
@given(images, st.data())
def test_reconstruction_is_the_limit_of_the_iteration(image: Int16, data: st.DataObject) -> None:
    above = data.draw(hnp.arrays(np.int16, image.shape, elements=st.integers(0, 2000)))
    marker = image + above
    wanted = reconstructed(marker, image)
    queue = np.zeros(image.size + 1, dtype=np.int32)
    kernel.reconstruct_slice(marker, image, queue, np.zeros(image.shape, dtype=bool))
    np.testing.assert_array_equal(marker, wanted)


@settings(max_examples=150, deadline=None)
@given(images, st.integers(1, 5))
def test_depth_is_closing_reconstruction_difference(image: Int16, scale: int) -> None:
    np.testing.assert_array_equal(depth(image, scale), naive_depth(image, scale))


@settings(max_examples=100, deadline=None)
@given(images, st.integers(1, 5))
def test_the_largest_scale_is_the_maximum_over_all(image: Int16, largest: int) -> None:
    every = [naive_depth(image, scale) for scale in range(1, largest + 1)]
    np.testing.assert_array_equal(depth(image, largest), np.max(every, axis=0))


def test_smoothing_is_the_mean_of_five() -> None:
    image = np.arange(30, dtype=np.int16).reshape(5, 6) ** 2
    out = np.zeros_like(image)
    kernel.smooth_slice(image, out)
    around = [image[2, 3], image[1, 3], image[3, 3], image[2, 2], image[2, 4]]
    assert out[2, 3] == int(np.floor(np.mean(around) + 0.5))
    assert out[0, 0] == int(np.floor(np.mean([image[0, 0], image[0, 1], image[1, 0]]) + 0.5))


def test_map_of_slices_does_not_mix_them() -> None:
    rng = np.random.default_rng(1)
    hu = rng.integers(-1000, 100, (5, 30, 31)).astype(np.int16)
    spacing = np.array([3.0, 0.8, 0.8])
    whole = local_minima_map(hu, spacing, 0)
    for n in range(5):
        np.testing.assert_array_equal(local_minima_map(hu[n : n + 1], spacing, 0)[0], whole[n])


def test_scale_is_limited_in_pixels_and_mm() -> None:
    assert scale_of(np.array([0.5, 0.5])) == 12
    assert scale_of(np.array([1.6, 1.6])) == 5
    assert scale_of(np.array([20.0, 20.0])) == 1


def test_levels_fall_to_the_noise() -> None:
    steps = levels(60.0)
    assert (np.diff(steps) < 0).all()
    assert steps[-1] >= 60
    assert steps[-1] * LEVEL_RATIO < 62
    assert len(levels(900.0)) == 1


def test_corners_are_joined_through_the_darkest_voxels() -> None:
    state = np.zeros((5, 5, 5), dtype=np.uint8)
    state[1, 1, 1] = state[2, 2, 2] = LUMEN
    hu = np.zeros((5, 5, 5), dtype=np.int16)
    hu[1, 2, 1] = hu[1, 2, 2] = -500
    lumen = np.zeros(state.size, dtype=np.int64)
    lumen[:2] = np.flatnonzero(state)
    count = join_corners(hu.reshape(-1), state.reshape(-1), np.array(state.shape), lumen, 2)
    assert count == 4
    assert ndimage.label(state == LUMEN, FACES)[1] == 1
    assert state[1, 2, 1] == LUMEN
    assert state[1, 2, 2] == LUMEN


def test_wall_takes_all_neighbours_then_only_what_is_alike() -> None:
    shape = (13, 13, 13)
    hu = np.full(shape, LUNG, dtype=np.int16)
    hu[4:9, 4:9, 4:9] = 0
    hu[3, 6, 6] = 5
    hu[6, 3, 6] = 50
    state = np.zeros(shape, dtype=np.uint8)
    state[6, 6, 6] = LUMEN
    wall = np.zeros(state.size, dtype=np.int64)
    lumen = np.flatnonzero(state)
    near = box_offsets(np.array(shape), 1)
    size = grow_wall(hu.reshape(-1), state.reshape(-1), near, lumen, 1, 3, -600.0, 10.0, wall)
    expected = np.zeros(shape, dtype=bool)
    expected[4:9, 4:9, 4:9] = True
    expected[3, 6, 6] = True
    expected[6, 6, 6] = False
    np.testing.assert_array_equal(state == 2, expected)
    assert size == expected.sum()


# A made airway: a trachea that divides into two bronchi, in a block of lung.


def made_airway(pocket: bool = False, hole: bool = False) -> tuple[Volume, Lungs, Mask]:
    """Return a CT of 1 mm with a trachea and two tubes; beside one a pocket of lung behind a hole."""
    shape = (90, 50, 110)
    x, y, z = np.indices(shape)
    rng = np.random.default_rng(4)
    hu = np.full(shape, LUNG, dtype=np.float64)
    lung = np.ones(shape, dtype=bool)
    body = (np.abs(x - 45) < 14) & (z > 60)
    lung &= ~body
    hu[body] = TISSUE
    trunk = ((x - 45) ** 2 + (y - 25) ** 2 <= 7**2) & (z > 62)
    left, right = (
        ((x - 45 - way * (66 - z) * 0.6) ** 2 + (y - 25) ** 2 <= 3**2) & (z < 67) & (z > 12)
        for way in (1, -1)
    )
    lumen = trunk | left | right
    shell = ndimage.binary_dilation(lumen, FACES, iterations=2) & ~lumen
    hu[shell] = np.maximum(hu[shell], WALL)
    if pocket:
        box = (slice(60, 76), slice(29, 44), slice(25, 55))
        filled = np.zeros(shape, dtype=bool)
        filled[box] = True
        inner = ndimage.binary_erosion(filled, FULL, iterations=2)
        free = filled & ~shell & ~lumen
        hu[free & ~inner] = TISSUE
        hu[free & inner] = LUNG
    if hole:
        hu[61:67, 25:34, 36:39] = np.minimum(hu[61:67, 25:34, 36:39], LUNG)
    hu[lumen] = AIR
    hu = ndimage.gaussian_filter(hu, 0.6) + 15.0 * rng.standard_normal(shape)
    grid = Grid.from_spacing(shape, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    lungs = Lungs(
        left=lung & (np.arange(90)[:, None, None] > 45),
        right=lung & (np.arange(90)[:, None, None] <= 45),
        trachea_seed_ijk=np.array([45, 25, 90]),
        central_airway=ndimage.binary_erosion(trunk, FACES),
        threshold_hu=-400.0,
    )
    return Volume(grid=grid, array=np.rint(hu).astype(np.int16)), lungs, lumen


def leak(airways: Airways, lumen: Mask) -> int:
    return int((airways.lumen & ~ndimage.binary_dilation(lumen, FULL)).sum())


def test_made_airway_is_found_to_its_ends_and_edges() -> None:
    ct, lungs, lumen = made_airway()
    airways = segment_airway(ct, lungs)
    inside = airways.lumen & lumen
    assert 2 * inside.sum() / (airways.lumen.sum() + lumen.sum()) > 0.9
    assert inside[:, :, 14].any()
    assert leak(airways, lumen) == 0
    assert airways.leak_mm3 == 0.0


def test_what_the_central_airway_holds_is_lumen_where_it_is_not_dark() -> None:
    ct, lungs, lumen = made_airway()
    x, y, z = np.indices(ct.grid.shape)
    blurred = lumen & ((x - 45) ** 2 + (y - 25) ** 2 <= 7**2) & (z > 63) & (z < 78)
    hu = np.where(blurred, np.maximum(ct.array, -882), ct.array).astype(np.int16)
    central = ndimage.binary_erosion(lumen & (z > 50), FACES)
    airways = segment_airway(
        Volume(grid=ct.grid, array=hu),
        replace(lungs, central_airway=central, trachea_seed_ijk=np.array([45, 25, 102])),
    )
    assert airways.lumen[blurred & central].all()
    assert cut_off(central, airways.lumen, ct.grid) == ()
    (warning,) = cut_off(central, airways.lumen & ((z > 77) | (z < 64)), ct.grid)
    assert "main bronchus" in warning and "not reached" in warning


def test_fat_beside_bright_vessels_is_no_lumen() -> None:
    ct, lungs, lumen = made_airway()
    x, y, z = np.indices(ct.grid.shape)
    hu = np.where((np.abs(x - 45) < 14) & (z > 60) & (ct.array > 0), 300, ct.array)
    fat = ((x - 45) ** 2 + (y - 37) ** 2 <= 4**2) & (z > 65) & ~lungs.mask
    hu[fat] = -92
    airways = segment_airway(Volume(grid=ct.grid, array=hu.astype(np.int16)), lungs)
    assert not (airways.lumen & fat).any()
    assert (airways.lumen & lumen)[:, :, 14].any()


@pytest.fixture(scope="module")
def beside_a_hole() -> Airways:
    ct, lungs, _ = made_airway(pocket=True, hole=True)
    return segment_airway(ct, lungs)


def test_leak_through_a_hole_in_the_wall_is_undone_where_it_is(beside_a_hole: Airways) -> None:
    airways = beside_a_hole
    _, _, lumen = made_airway(pocket=True, hole=True)
    assert airways.leak_mm3 > 0.1 * POCKET_MM3
    assert leak(airways, lumen) < 0.03 * lumen.sum()
    far = lumen & (np.arange(110) < 25)
    assert (airways.lumen & far).sum() > 0.8 * far.sum(), "both bronchi go on beyond the leak"


@pytest.mark.slow
def test_without_leak_control_the_pocket_is_filled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(growing, "WIDE_MM2", 1e9)
    monkeypatch.setattr(growing, "FRONT_SLACK_MM2", 1e9)
    ct, lungs, lumen = made_airway(pocket=True, hole=True)
    assert leak(segment_airway(ct, lungs), lumen) > 0.5 * POCKET_MM3


def test_hole_is_what_lets_growth_into_the_pocket() -> None:
    ct, lungs, lumen = made_airway(pocket=True)
    airways = segment_airway(ct, lungs)
    assert airways.leak_mm3 == 0.0
    assert leak(airways, lumen) == 0


@pytest.mark.slow
def test_result_does_not_depend_on_the_run_or_the_order_of_memory(beside_a_hole: Airways) -> None:
    ct, lungs, _ = made_airway(pocket=True, hole=True)
    again = segment_airway(Volume(grid=ct.grid, array=np.ascontiguousarray(ct.array)), lungs)
    floats = segment_airway(Volume(grid=ct.grid, array=ct.array.astype(np.float32)), lungs)
    for other in (again, floats):
        np.testing.assert_array_equal(beside_a_hole.lumen, other.lumen)
        np.testing.assert_array_equal(beside_a_hole.wall, other.wall)


def test_seed_outside_the_air_is_refused() -> None:
    ct, lungs, _ = made_airway()
    with pytest.raises(AnatomyError, match="no air at the seed"):
        segment_airway(ct, replace(lungs, trachea_seed_ijk=np.array([5, 5, 5])))


def test_lungs_of_another_grid_are_refused() -> None:
    ct, lungs, _ = made_airway()
    smaller = Volume(grid=ct.grid.crop((0, 0, 0), (90, 50, 100)), array=ct.array[:, :, :100])
    with pytest.raises(GridMismatchError):
        segment_airway(smaller, lungs)


@pytest.fixture(scope="module")
def patient() -> Phantom:
    return make_phantom(seed=2, spacing_mm=VOXEL_MM, size="small", noise_hu=25.0)


def stand_in_lungs(patient: Phantom) -> Lungs:
    """Make the lungs of a phantom from its truth."""
    inside = patient.lobes.array > 0
    lumen = patient.mask("lumen")
    central = ndimage.binary_opening(lumen, FULL, iterations=2)
    labels, _ = ndimage.label(central)
    central = labels == np.argmax(np.bincount(labels.ravel())[1:]) + 1
    top = int(np.flatnonzero(central.any(axis=(0, 1)))[-1]) - 10
    at = np.argwhere(central[:, :, top])
    middle = at[np.argmin(np.abs(at - at.mean(axis=0)).sum(axis=1))]
    x = patient.grid.lps(np.argwhere(np.ones(inside.shape, dtype=bool)))[:, 0].reshape(inside.shape)
    return Lungs(
        left=inside & (x > 0),
        right=inside & (x <= 0),
        trachea_seed_ijk=np.array([*middle, top]),
        central_airway=central,
        threshold_hu=-400.0,
    )


@pytest.fixture(scope="module")
def found(patient: Phantom) -> Airways:
    return segment_airway(patient.ct, stand_in_lungs(patient))


@pytest.mark.slow
def test_phantom_lumen_is_one_piece_of_faces(found: Airways) -> None:
    assert ndimage.label(found.lumen, FACES)[1] == 1


def test_phantom_wall_encloses_the_lumen(found: Airways) -> None:
    assert not (found.wall & found.lumen).any()
    around = ndimage.binary_dilation(found.lumen, FULL) & ~found.lumen
    assert not (around & ~found.wall).any()


def test_phantom_airways_of_more_than_three_voxels_are_found(patient: Phantom, found: Airways) -> None:
    lines = patient.centerlines["airway"]
    at = np.rint(patient.grid.ijk(lines.points_lps)).astype(int)
    inside = ((at >= 0) & (at < patient.grid.shape)).all(axis=1)
    near = ndimage.binary_dilation(found.lumen, FACES)[tuple(at[inside].T)]
    voxels = 2.0 * lines.radius_mm[inside] / VOXEL_MM
    assert (voxels >= 3.1).sum() > 500
    assert near[voxels >= 3.1].all()
    assert near[voxels >= 2.75].mean() > 0.94
    assert near.mean() > 0.75


def test_phantom_leakage(patient: Phantom, found: Airways) -> None:
    truth = patient.mask("lumen", "wall")
    assert (found.lumen & ~truth).sum() <= 0.03 * patient.mask("lumen").sum()


def test_warnings_name_a_cut_trachea_and_a_lung_without_airways() -> None:
    _, lungs, lumen = made_airway()
    short = lumen.copy()
    short[:, :, 78:] = False
    short[:40, :, :60] = False
    grid = Grid.from_spacing(lumen.shape, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    tree = tree_or_error(Volume(grid=grid, array=short))
    text = " ".join(airway_warnings(tree, lungs.left, lungs.right, grid))
    assert "right lung" in text or "No tree" in text
    assert "trachea" in text.lower()
