"""Masks on grids of their own: crops, other voxels, other orders of axes, headers that may be wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from anatomy.base.errors import AnatomyError, FrameError
from anatomy.grid import Grid, Volume
from anatomy.io import load_patient, write_volume
from anatomy.io.masks import SHIFT_TOLERANCE, covers_same_voxels, place, union_grid

GRID = Grid.from_spacing((8, 7, 6), [2.0, 1.5, 1.0], [-5.0, 3.0, 40.0])


def crop_of(volume: Volume, start: tuple[int, int, int], stop: tuple[int, int, int]) -> Volume:
    box = tuple(slice(a, b) for a, b in zip(start, stop, strict=True))
    return Volume(grid=volume.grid.crop(start, stop), array=volume.array[box])


def turned(grid: Grid, order: tuple[int, int, int], signs: tuple[int, int, int]) -> Grid:
    """The same voxels with their axes in another order and direction."""
    step = np.zeros((4, 4))
    step[3, 3] = 1.0
    for axis, (source, sign) in enumerate(zip(order, signs, strict=True)):
        step[source, axis] = sign
        if sign < 0:
            step[source, 3] = grid.shape[source] - 1
    return Grid(shape=tuple(grid.shape[n] for n in order), lps_from_ijk=grid.lps_from_ijk @ step)


@given(st.integers(0, 2**32 - 1), st.tuples(*[st.integers(-3, 4)] * 3), st.tuples(*[st.integers(1, 9)] * 3))
def test_a_box_of_the_same_voxels_keeps_every_voxel_in_its_place(seed, start, shape):
    source = GRID.crop(start, np.add(start, shape))
    array = np.random.default_rng(seed).random(source.shape) < 0.4
    found = place(array, source, GRID, solid=True)
    assert not found.is_resampled
    voxels = np.argwhere(array)
    at = voxels + start
    inside = ((at >= 0) & (at < GRID.shape)).all(axis=1)
    expected = np.zeros(GRID.shape, dtype=bool)
    expected[tuple(at[inside].T)] = True
    assert (found.array == expected).all()
    assert (found.n_voxels, found.n_lost) == (len(voxels), int((~inside).sum()))


@pytest.mark.parametrize(
    ("order", "signs"), [((1, 2, 0), (1, 1, 1)), ((2, 1, 0), (-1, 1, 1)), ((0, 2, 1), (1, -1, 1))]
)
def test_another_order_of_axes_changes_no_place(order, signs):
    source = turned(GRID, order, signs)
    assert covers_same_voxels(source, GRID)
    array = np.random.default_rng(1).random(source.shape) < 0.3
    found = place(array, source, GRID)
    assert not found.is_resampled and not found.n_lost
    lps = np.sort(source.lps(np.argwhere(array)).round(6), axis=0)
    assert (np.sort(GRID.lps(np.argwhere(found.array)).round(6), axis=0) == lps).all()


@given(st.integers(0, 2**32 - 1), st.floats(0.3, 3.0), st.floats(-0.9, 0.9))
def test_no_voxel_of_an_obstacle_is_lost_in_other_voxels(seed, scale, turn):
    """The centre of each obstacle voxel lies in an obstacle, and so does each centre inside one.

    Each axis that parts from one of the grid by less than `SHIFT_TOLERANCE` over the image counts as parallel
    to it: a centre that is nearer to a face than two of them shift it may belong to either voxel.
    """
    rng = np.random.default_rng(seed)
    cos, sin = np.cos(turn), np.sin(turn)
    matrix = np.eye(4)
    matrix[:3, :3] = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) * scale * GRID.spacing_mm
    matrix[:3, 3] = GRID.lps(rng.uniform(-1, 3, 3))
    source = Grid(shape=(7, 6, 5), lps_from_ijk=matrix)
    array = rng.random(source.shape) < 0.2
    found = place(array, source, GRID, solid=True)
    centres = source.lps(np.argwhere(array))
    centres = centres[GRID.contains(centres)]
    assert found.array[tuple(np.floor(GRID.ijk(centres) + 0.5).astype(int).T)].all()
    targets = np.argwhere(np.ones(GRID.shape))
    ijk = source.ijk(GRID.lps(targets)) + 0.5
    at = np.floor(ijk).astype(int)
    firmly = (np.abs(ijk - np.rint(ijk)) > 2 * SHIFT_TOLERANCE).all(axis=1)
    held = ((at >= 0) & (at < source.shape)).all(axis=1) & firmly
    held[held] = array[tuple(at[held].T)]
    assert found.array[tuple(targets[held].T)].all()


def test_free_space_is_not_widened_by_finer_voxels():
    fine = Grid.from_spacing((32, 28, 24), GRID.spacing_mm / 4, GRID.lps_from_ijk[:3, 3])
    array = np.zeros(fine.shape, dtype=bool)
    array[5, 5, 5] = True  # no centre of a coarse voxel lies in it
    assert not place(array, fine, GRID).array.any()
    assert place(array, fine, GRID, solid=True).array.sum() == 1


def test_the_common_grid_reaches_as_far_as_its_parts_but_not_to_another_body():
    upper = GRID.crop((0, 0, 4), (8, 7, 9))
    assert union_grid(GRID, [("lungs", upper)]).shape == (8, 7, 9)
    assert union_grid(GRID, [("lungs", GRID)]) is GRID
    far = Grid.from_spacing((8, 7, 6), GRID.spacing_mm, [500.0, 500.0, 900.0])
    with pytest.raises(FrameError, match="lungs lies apart"):
        union_grid(GRID, [("lungs", far)])


def load_with(folder: Path, name: str, volume: Volume) -> tuple[object, list[str]]:
    write_volume(folder / f"{name}.nii.gz", volume)
    patient = load_patient(folder)
    return patient, [said for said in patient.warnings if said.startswith(name)]


def test_a_cropped_fissure_mask_is_placed_and_its_box_stated(med_rad_folder, masks, grid):
    whole = load_patient(med_rad_folder).fissures
    patient, said = load_with(med_rad_folder, "fissures", crop_of(masks["fissures"], (7, 4, 0), (12, 7, 4)))
    assert (patient.fissures.array == whole.array).all() and patient.grid.is_close(grid)
    assert len(said) == 1
    assert "covers 5 x 3 x 4 of the 12 x 10 x 8 voxels, from (7, 4, 0) on" in said[0]
    assert "Beyond it no fissure is known, so that none is avoided" in said[0]


def test_a_crop_that_cuts_a_structure_says_that_it_may_go_on(med_rad_folder, masks):
    _, said = load_with(med_rad_folder, "vessels", crop_of(masks["arteries"], (0, 0, 0), (12, 10, 5)))
    assert "It reaches 1 of its 6 faces" in said[0] and "no vessel is known" in said[0]


def test_a_mask_that_reaches_out_of_the_images_loses_that_part_with_a_number(med_rad_folder, masks, grid):
    wide = Volume(grid=grid.crop((-4, 0, 0), (12, 10, 8)), array=np.ones((16, 10, 8), dtype=bool))
    patient, said = load_with(med_rad_folder, "nodule", wide)
    assert patient.nodules.array.all()
    assert "320 of its 1280 voxels (25 %) lie outside the images" in said[0]


def test_an_optional_mask_outside_the_images_is_absent_and_a_needed_one_refused(med_rad_folder, masks, grid):
    away = grid.crop((40, 0, 0), (45, 4, 4))
    far = Volume(grid=away, array=np.ones(away.shape, dtype=bool))
    patient, said = load_with(med_rad_folder, "fissures", far)
    assert patient.fissures is None and "lies outside the images" in said[0]
    with pytest.raises(AnatomyError, match=r"vessels is empty.*vessels\.nii\.gz lies outside the images"):
        load_with(med_rad_folder, "vessels", far)


def test_a_mask_of_equal_size_elsewhere_is_placed_by_its_header_and_doubted(med_rad_folder, masks, grid):
    array = masks["nodule"].array
    moved = Volume(grid=grid.crop((-7, 0, 0), (5, 10, 8)), array=array)
    patient, said = load_with(med_rad_folder, "nodule", moved)
    assert (np.argwhere(patient.nodules.array) == [[2, 6, 4]]).all()
    assert "as many voxels as bronchialTree.nii.gz" in said[0] and "(-35.0, 0.0, 0.0) mm away" in said[0]
    assert "By its header 100 % of it lie in the lungs, voxel by voxel 100 %" in said[0]


def test_lungs_that_reach_beyond_the_airway_file_are_kept_whole(med_rad_folder, masks):
    whole = load_patient(med_rad_folder)
    write_volume(med_rad_folder / "bronchialTree.nii.gz", crop_of(masks["lumen"], (4, 3, 2), (8, 6, 8)))
    patient = load_patient(med_rad_folder)
    for role in ("lumen", "lung", "vessels"):
        a, b = getattr(whole, role), getattr(patient, role)
        assert (a.grid.lps(np.argwhere(a.array)) == b.grid.lps(np.argwhere(b.array))).all(), role


def test_a_mask_in_other_voxels_says_by_how_much_borders_moved(med_rad_folder, masks, grid):
    coarse = Grid.from_spacing((6, 5, 4), grid.spacing_mm * 2, grid.lps((0.5, 0.5, 0.5)))
    _, said = load_with(
        med_rad_folder, "fissures", Volume(grid=coarse, array=np.ones(coarse.shape, dtype=bool))
    )
    assert "borders moved by up to 6.7 mm" in said[0]


@pytest.mark.slow
@pytest.mark.data
def test_a_crop_of_published_fissures_gives_the_same_fissures(data_dir, tmp_path):
    """As in a folder of the collection whose fissures begin at voxel (28, 46, 100)."""
    from anatomy.io import read_mask

    folder = data_dir / "med-rad" / "Patient1"
    for path in folder.iterdir():
        (tmp_path / path.name).symlink_to(path)
    fissures = read_mask(folder / "fissures.nii.gz")
    (tmp_path / "fissures.nii.gz").unlink()
    start, stop = (28, 46, 100), (480, 300, 460)
    write_volume(tmp_path / "fissures.nii.gz", crop_of(fissures, start, stop))
    patient = load_patient(tmp_path)
    box = tuple(slice(a, b) for a, b in zip(start, stop, strict=True))
    expected = np.zeros_like(fissures.array)
    expected[box] = fissures.array[box]
    assert (patient.fissures.array == expected).all()
    said = " ".join(patient.warnings)
    assert "fissures.nii.gz was placed by its header" in said and "from (28, 46, 100) on" in said
