"""What a person corrected by hand: over the masks, kept with the patient, and renewed as if built anew."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from anatomy.base.errors import FileError
from anatomy.build import Reused, build_lung
from anatomy.corrections import AIRWAY, FISSURE, NODULE, TISSUE, VESSEL, with_corrections
from anatomy.grid import Grid, Volume
from anatomy.io.corrections import corrected, corrections_file, read_corrections, write_corrections
from anatomy.io.inputs import input_hashes
from anatomy.io.patients import load_patient
from anatomy.lung import Lung
from anatomy.patient import MASKS, PatientImages
from anatomy.phantom import Phantom, write_phantom
from tests.anatomy.toys import toy


def at(images: PatientImages, *boxes: tuple[tuple[int, ...], tuple[int, ...], int]) -> Volume:
    """Return corrections that say something in boxes of voxels."""
    values = np.zeros(images.grid.shape, dtype=np.uint8, order="F")
    for low, high, code in boxes:
        values[tuple(map(slice, low, high))] = code
    return Volume(grid=images.grid, array=values)


def box_in(mask: np.ndarray, size: int = 2) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return a small box around the middle one of the voxels of a mask."""
    voxels = np.argwhere(mask)
    middle = voxels[len(voxels) // 2]
    return tuple(np.maximum(middle - size, 0).tolist()), tuple((middle + size + 1).tolist())


def assert_same(one: Lung, other: Lung) -> None:
    """Fail unless two lungs are the same voxel by voxel."""
    assert one.key == other.key
    assert one.warnings == other.warnings
    assert np.array_equal(one.labels, other.labels)
    assert one.fields.keys() == other.fields.keys()
    for name, field in one.fields.items():
        assert np.array_equal(field.corners, other.fields[name].corners), name
    assert np.array_equal(one.lumen_depth.corners, other.lumen_depth.corners)
    assert np.array_equal(one.lumen_depth.geometry, other.lumen_depth.geometry)
    for each in fields(one.tree):
        value = getattr(one.tree, each.name)
        if isinstance(value, np.ndarray):
            assert np.array_equal(value, getattr(other.tree, each.name)), each.name


@pytest.mark.parametrize(("role", "code"), [("vessels", VESSEL), ("nodules", NODULE), ("fissures", FISSURE)])
def test_what_is_painted_is_that_structure_and_no_other(small_phantom: Phantom, role: str, code: int) -> None:
    images = small_phantom.images
    tissue = images.lung.array & ~images.lumen.array & ~images.wall.array & ~images.vessels.array
    low, high = box_in(tissue)
    found = with_corrections(images, at(images, (low, high, code)))
    box = tuple(map(slice, low, high))
    for each in ("lumen", "vessels", "fissures", "nodules"):
        assert bool(getattr(found, each).array[box].all()) == (each == role), each
        outside = getattr(found, each).array.copy()
        outside[box] = False
        before = getattr(images, each).array.copy()
        before[box] = False
        assert np.array_equal(outside, before), each
    assert "corrected the masks by hand" in found.warnings[-1]


def test_erased_lumen_takes_its_wall_along_and_what_is_left_is_closed(small_phantom: Phantom) -> None:
    images = small_phantom.images
    assert images.wall is not None
    lumen, wall = images.lumen.array, images.wall.array
    end = np.argwhere(lumen)[:, 2].min()
    values = np.zeros(images.grid.shape, dtype=np.uint8, order="F")
    cut = end + 12
    values[:, :, :cut][lumen[:, :, :cut]] = TISSUE
    found = with_corrections(images, Volume(grid=images.grid, array=values))
    assert found.wall is not None
    assert not (found.lumen.array & (values == TISSUE)).any()
    below = found.wall.array[:, :, : cut - 4]
    assert np.count_nonzero(below) < 0.1 * np.count_nonzero(wall[:, :, : cut - 4])
    opened = found.lumen.array[:, :, cut] & (lumen | wall)[:, :, cut - 1]
    assert opened.any()
    assert found.wall.array[:, :, cut - 1][opened].all(), "the end of what is left is walled"


def test_added_lumen_gets_a_wall(small_phantom: Phantom) -> None:
    images = small_phantom.images
    assert images.wall is not None
    free = images.lung.array & ~images.lumen.array & ~images.wall.array & ~images.vessels.array
    low, high = box_in(free)
    found = with_corrections(images, at(images, (low, high, AIRWAY)))
    assert found.wall is not None
    around = tuple(slice(a - 1, b + 1) for a, b in zip(low, high, strict=True))
    assert (found.wall.array[around] | found.lumen.array[around]).all()


def test_a_few_painted_fissures_never_count_as_all(small_phantom: Phantom) -> None:
    """A patient without fissures stays one whose fissures nobody knows."""
    images = replace(small_phantom.images, fissures=None)
    found = with_corrections(images, at(images, (*box_in(images.lung.array), FISSURE)))
    assert found.fissures is None
    assert "are not used" in found.warnings[-1]


def test_corrections_of_another_box_of_the_same_voxels_are_placed(small_phantom: Phantom) -> None:
    images = small_phantom.images
    low, high = box_in(images.lung.array)
    whole = at(images, (low, high, VESSEL))
    part = Volume(
        grid=whole.grid.crop(low, high), array=np.asfortranarray(whole.array[tuple(map(slice, low, high))])
    )
    one, other = with_corrections(images, whole), with_corrections(images, part)
    for role in MASKS:
        assert np.array_equal(getattr(one, role).array, getattr(other, role).array)


def test_erased_obstacles_of_the_cost_map_may_be_passed_at_the_highest_cost() -> None:
    images = toy()
    cost = np.where(images.vessels.array, np.inf, 0.0).astype(np.float32)
    images = replace(images, cost=Volume(grid=images.grid, array=np.asfortranarray(cost)))
    low, high = box_in(images.vessels.array, 0)
    found = with_corrections(images, at(images, (low, high, TISSUE)))
    assert found.cost is not None
    assert found.cost.array[low] == 1.0
    assert np.count_nonzero(np.isinf(found.cost.array)) == np.count_nonzero(np.isinf(cost)) - 1


@pytest.mark.parametrize("code", [TISSUE, AIRWAY, VESSEL, FISSURE, NODULE])
def test_a_corrected_lung_is_the_same_however_little_of_it_is_made_again(
    small_phantom: Phantom, code: int
) -> None:
    images = small_phantom.images
    first = build_lung(images)
    reused = Reused(images, first)
    assert_same(build_lung(images, reused=reused), first)
    edge = images.lumen.array if code == TISSUE else images.lung.array
    for size in (1, 2):
        changed = with_corrections(images, at(images, (*box_in(edge, size), code)))
        assert_same(build_lung(changed, reused=reused), build_lung(changed))
    assert_same(build_lung(images, reused=reused), first)


def test_strokes_one_after_the_other_make_the_lung_that_is_built_anew(small_phantom: Phantom) -> None:
    """Each lung is made of the one before: painted, erased, taken back, and painted over something else."""
    images = small_phantom.images
    tissue = images.lung.array & ~images.lumen.array & ~images.vessels.array
    assert images.wall is not None
    assert images.nodules is not None
    vessel, free = box_in(images.vessels.array, 4), box_in(tissue & ~images.wall.array, 3)
    reused = Reused(images, build_lung(images))
    made: list[tuple[tuple[int, ...], tuple[int, ...], int]] = []
    for stroke in (
        (*vessel, TISSUE), (*free, VESSEL), (*box_in(images.nodules.array), TISSUE), (*free, NODULE),
        (*vessel, FISSURE), (*box_in(images.lumen.array, 1), VESSEL), None,
    ):  # fmt: skip
        made = made[:-1] if stroke is None else [*made, stroke]
        changed = with_corrections(images, at(images, *made))
        renewed, anew = build_lung(changed, reused=reused), build_lung(changed)
        assert_same(renewed, anew)
        for name in ("nodules", "cost", "nodule_labels"):
            one, other = getattr(renewed, name), getattr(anew, name)
            assert (one is None) == (other is None)
            assert one is None or np.array_equal(one.array, other.array)
        assert renewed.findings == anew.findings
        reused.take(changed, renewed)


def test_corrections_are_kept_with_the_patient(small_phantom: Phantom, tmp_path: Path) -> None:
    write_phantom(small_phantom, tmp_path)
    images, hashes = load_patient(tmp_path), input_hashes(tmp_path)
    low, high = box_in(images.lung.array)
    corrections, file = at(images, (low, high, VESSEL)), corrections_file(tmp_path)
    write_corrections(file, corrections)
    kept = read_corrections(file)
    assert kept.array.size < 1000, "no larger than what was painted"
    found = load_patient(tmp_path)
    assert found.vessels.array[tuple(map(slice, low, high))].all()
    assert found.sources == input_hashes(tmp_path)
    assert found.sources != hashes
    assert corrected(images, tmp_path).sources == found.sources
    write_corrections(file, at(images))
    assert not file.exists()
    assert load_patient(tmp_path).sources == images.sources


def test_a_file_of_other_values_is_refused(tmp_path: Path) -> None:
    from anatomy.io.images import write_volume

    grid = Grid.from_spacing((3, 3, 3), [1.0, 1.0, 1.0], [0.0, 0.0, 0.0])
    write_volume(
        tmp_path / "painted.nii.gz", Volume(grid=grid, array=np.full((3, 3, 3), 9, np.uint8, order="F"))
    )
    with pytest.raises(FileError, match="values from 9 to 9"):
        read_corrections(tmp_path / "painted.nii.gz")
