"""Masks of other programs: every published layout is read, and what is not of the CT is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from anatomy.base.errors import AnatomyError, FileError, GridMismatchError
from anatomy.base.typed import Array, Mask
from anatomy.grid import Grid, Volume
from anatomy.io import write_volume
from anatomy.io.own_masks import description_text, load_own_masks
from anatomy.phantom import Phantom
from anatomy.plausibility import CHECKS
from anatomy.segmentation.canonical import canonical
from anatomy.segmentation.labels import NUMBERINGS, lobe_numbers, sides_of
from anatomy.segmentation.pipeline import MADE_MASKS
from anatomy.segmentation.request import Given, GivenImages, read_given
from anatomy.segmentation.scan_warnings import FITS, misplaced, moved_by

TOTAL = (
    "lung_upper_lobe_left",
    "lung_lower_lobe_left",
    "lung_upper_lobe_right",
    "lung_middle_lobe_right",
    "lung_lower_lobe_right",
)
OF_TOTAL = (4, 5, 1, 2, 3)
"""The numbers of these lobes."""


@pytest.fixture(scope="module")
def ct(patient: Phantom) -> Volume:
    return canonical(patient.ct)


@pytest.fixture(scope="module")
def truth(patient: Phantom, ct: Volume) -> dict[str, Array]:
    images = patient.images
    assert images.wall is not None
    masks = {
        "airway": images.lumen.array,
        "airway_wall": images.wall.array & ~images.lumen.array,
        "vessels": images.vessels.array,
        "lungs": images.lung.array,
        "fissures": patient.mask("fissure"),
        "lobes": patient.lobes.array,
    }
    return {name: canonical(Volume(grid=patient.grid, array=mask)).array for name, mask in masks.items()}


def _write(path: Path, ct: Volume, array: Array) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_volume(path, Volume(grid=ct.grid, array=array.astype(np.uint8)))
    return path


def _read(image: str, path: Path, grid: Grid) -> Array:
    found = read_given({image: path}, None, grid)
    assert found.warnings == () and path.name.split("#")[0] in found.sources[image]
    return found.images[image].array


def _numbered(lobes: Array, numbers: dict[int, int]) -> Array:
    return np.select([lobes == lobe for lobe in numbers], list(numbers.values()), 0).astype(np.uint8)


def test_totalsegmentator_as_a_folder_of_masks(tmp_path: Path, ct: Volume, truth: dict[str, Array]) -> None:
    lung, vessels = tmp_path / "lung_vessels", truth["vessels"]
    half = np.indices(vessels.shape)[0] > vessels.shape[0] / 2
    _write(lung / "lung_airways.nii.gz", ct, truth["airway"])
    _write(lung / "lung_airways_wall.nii.gz", ct, truth["airway_wall"])
    _write(lung / "lung_arteries.nii.gz", ct, vessels & half)
    _write(lung / "lung_veins.nii.gz", ct, vessels & ~half)
    for name, lobe in zip(TOTAL, OF_TOTAL, strict=True):
        _write(lung / f"{name}.nii.gz", ct, truth["lobes"] == lobe)
    found = read_given({}, lung, ct.grid)
    assert set(found.images) == {"airway", "airway_wall", "vessels", "lungs", "lobes"}
    for name in ("airway", "airway_wall", "vessels", "lobes"):
        assert (found.images[name].array == truth[name]).all(), name
    left, right = sides_of(found.images["lungs"], "lungs")
    assert (left == (truth["lobes"] > 3)).all() and (right == ((truth["lobes"] > 0) & ~left)).all()
    assert "TotalSegmentator: lung_airways.nii.gz" in found.sources["airway"]
    assert (_read("vessels", lung, ct.grid) == vessels).all()
    with pytest.raises(FileError, match="holds no fissures, but"):
        read_given({"fissures": lung}, None, ct.grid)


def test_totalsegmentator_as_label_maps(tmp_path: Path, ct: Volume, truth: dict[str, Array]) -> None:
    four = truth["airway"] * np.uint8(1)
    four[truth["airway_wall"]], four[truth["vessels"]] = 2, 3
    four[truth["vessels"] & (np.indices(four.shape)[2] % 2 == 0)] = 4
    path = _write(tmp_path / "lung_vessels.nii.gz", ct, four)
    assert (_read("airway", path, ct.grid) == (four == 1)).all()
    assert (_read("vessels", path, ct.grid) == (four >= 3)).all()
    total = _numbered(truth["lobes"], dict(zip(OF_TOTAL, range(10, 15), strict=True)))
    plain = _write(tmp_path / "mine.nii.gz", ct, total)
    assert (_read("lobes", plain, ct.grid) == truth["lobes"]).all()
    named = _write(tmp_path / "named.nii.gz", ct, total)
    names = dict(zip(TOTAL, range(10, 15), strict=True))
    (tmp_path / "named.json").write_text(json.dumps(names))
    assert (_read("lobes", named, ct.grid) == truth["lobes"]).all()


def test_lobes_of_lungmask_are_told_from_our_own(tmp_path: Path, ct: Volume, truth: dict[str, Array]) -> None:
    for numbering in NUMBERINGS.values():
        labels = {lobe: label for label, lobe in enumerate(numbering, start=1)}
        path = _write(tmp_path / "lobes.nii.gz", ct, _numbered(truth["lobes"], labels))
        assert (_read("lobes", path, ct.grid) == truth["lobes"]).all()
        left, right = sides_of(Volume(grid=ct.grid, array=_read("lungs", path, ct.grid)), "lungs")
        assert (left == (truth["lobes"] > 3)).all() and (left | right == (truth["lobes"] > 0)).all()
    mirrored = Volume(grid=ct.grid, array=truth["lobes"][::-1])
    upside_down = Volume(grid=ct.grid, array=truth["lobes"][:, :, ::-1])
    for wrong in (mirrored, upside_down):
        with pytest.raises(AnatomyError, match="no known numbering.*mirrored or upside down"):
            lobe_numbers(wrong, "lobes.nii.gz")
    swapped = np.where(truth["lobes"] > 3, 1, 2) * (truth["lobes"] > 0)
    with pytest.raises(AnatomyError, match="label 1, the right lung, on the patient's left"):
        sides_of(Volume(grid=ct.grid, array=swapped), "lungs.nii.gz")


def test_lungs_are_told_by_their_labels_or_their_shape(ct: Volume, truth: dict[str, Array]) -> None:
    left, right = truth["lobes"] > 3, (truth["lobes"] > 0) & (truth["lobes"] < 4)
    ours = left * np.uint8(2) + right * np.uint8(1)
    for array in (ours, left | right):
        found = sides_of(Volume(grid=ct.grid, array=array), "lungs")
        for side, true in zip(found, (left, right), strict=True):
            assert np.count_nonzero(side != true) < 0.01 * np.count_nonzero(true)
    with pytest.raises(AnatomyError, match="values"):
        sides_of(Volume(grid=ct.grid, array=ours * np.uint8(9)), "lungs")
    with pytest.raises(AnatomyError, match="no lung"):
        sides_of(Volume(grid=ct.grid, array=np.zeros_like(ours)), "lungs")


def test_cases_of_aeropath_and_atm(tmp_path: Path, ct: Volume, truth: dict[str, Array]) -> None:
    case = tmp_path / "7"
    _write(case / "7_CT_HR.nii.gz", ct, truth["lungs"])
    _write(case / "7_CT_HR_label_airways.nii.gz", ct, truth["airway"])
    _write(case / "7_CT_HR_label_lungs.nii.gz", ct, truth["lungs"])
    found = read_given({"airway": case, "lungs": case}, None, ct.grid)
    assert (found.images["airway"].array == truth["airway"]).all()
    assert "AeroPath" in found.sources["airway"] and "AeroPath" in found.sources["lungs"]
    atm = _write(tmp_path / "labelsTr" / "ATM_001_0000.nii.gz", ct, truth["airway"])
    assert (_read("airway", atm, ct.grid) == truth["airway"]).all()


def test_labels_without_names_must_be_chosen(tmp_path: Path, ct: Volume, truth: dict[str, Array]) -> None:
    both = truth["airway"] + 2 * truth["vessels"].astype(np.uint8) * ~truth["airway"]
    path = _write(tmp_path / "both.nii.gz", ct, both)
    with pytest.raises(AnatomyError, match=r"holds the labels 1, 2, and it is not said which.*both.nii.gz#1"):
        read_given({"airway": path}, None, ct.grid)
    assert (_read("airway", Path(f"{path}#1"), ct.grid) == (both == 1)).all()
    assert (_read("vessels", Path(f"{path}#1,2"), ct.grid) == (both > 0)).all()
    with pytest.raises(FileError, match="names no labels"):
        read_given({"airway": Path(f"{path}#bronchi")}, None, ct.grid)
    assert len(Given(airway=Path(f"{path}#1"), vessels=path).hashes()) == 1
    for nameless in (tmp_path / "nowhere.nii.gz", tmp_path / "#1"):
        with pytest.raises(FileError, match=nameless.name):
            Given(lungs=nameless).hashes()


def test_other_voxels_are_carried_over_and_another_frame_is_refused(
    tmp_path: Path, ct: Volume, truth: dict[str, Array]
) -> None:
    coarse = Grid(shape=tuple(n // 2 for n in ct.grid.shape), lps_from_ijk=_scaled(ct.grid, 2.0))
    path = tmp_path / "coarse.nii.gz"
    write_volume(
        path, Volume(grid=coarse, array=truth["lungs"][::2, ::2, ::2][tuple(map(slice, coarse.shape))])
    )
    found: GivenImages = read_given({"lungs": path}, None, ct.grid)
    assert "2.50 mm, and was carried over" in found.warnings[0]
    both = np.count_nonzero(found.images["lungs"].array & truth["lungs"])
    assert both > 0.95 * np.count_nonzero(truth["lungs"])
    far, turned = ct.grid.lps_from_ijk.copy(), ct.grid.lps_from_ijk.copy()
    far[2, 3] += 150.0
    c, s = np.cos(0.1), np.sin(0.1)
    turned[:2, :3] = np.array([[c, -s], [s, c]]) @ turned[:2, :3]
    for matrix, words in ((far, "lie outside the CT"), (turned, "axes are turned")):
        grid = Grid(shape=ct.grid.shape, lps_from_ijk=matrix)
        write_volume(path, Volume(grid=grid, array=truth["airway"]))
        with pytest.raises(GridMismatchError, match=f"another frame than the CT: .*{words}"):
            read_given({"airway": path}, None, ct.grid)
    with pytest.raises(AnatomyError, match="its mask is empty"):
        read_given({"vessels": _write(path, ct, np.zeros(ct.grid.shape))}, None, ct.grid)


def _scaled(grid: Grid, factor: float) -> Array:
    matrix = grid.lps_from_ijk.copy()
    matrix[:3, :3] *= factor
    return matrix


def _judged(ct: Volume, truth: dict[str, Array], name: str, mask: Mask) -> tuple[bool, int]:
    failed, warnings = misplaced(ct, {name: mask}, truth["lungs"], truth["airway"])
    assert all(check.name in CHECKS for check in failed)
    return bool(failed), len(warnings)


@pytest.mark.parametrize("name", [*FITS, "lobes", "airway_wall"])
def test_masks_in_place_pass_without_a_word(ct: Volume, truth: dict[str, Array], name: str) -> None:
    assert _judged(ct, truth, name, truth[name]) == (False, 0)


@pytest.mark.parametrize("name", ["lungs", "airway", "vessels", "lobes"])
@pytest.mark.parametrize("shift", [(3, 0, 0), (0, 0, 3), (0, 8, 0), (0, 0, 40)])
def test_shifted_masks_are_refused(
    ct: Volume, truth: dict[str, Array], name: str, shift: tuple[int, int, int]
) -> None:
    assert _judged(ct, truth, name, np.roll(truth[name], shift, axis=(0, 1, 2)))[0]


@pytest.mark.parametrize("name", ["airway", "vessels", "fissures"])
def test_mirrored_masks_are_refused(ct: Volume, truth: dict[str, Array], name: str) -> None:
    assert _judged(ct, truth, name, truth[name][::-1])[0]


def test_what_holds_something_else_is_refused(ct: Volume, truth: dict[str, Array]) -> None:
    assert _judged(ct, truth, "airway", truth["vessels"])[0]
    assert _judged(ct, truth, "vessels", truth["airway"])[0]
    assert _judged(ct, truth, "lungs", truth["vessels"])[0]
    assert _judged(ct, truth, "airway_wall", np.roll(truth["airway_wall"], 12, axis=1))[0]
    assert _judged(ct, truth, "lobes", truth["lobes"] * (truth["lobes"] < 3))[
        0
    ]  # one lung and more are missing


def test_moving_a_step_of_brightness_changes_its_mean() -> None:
    """A half space of 100 HU beside one of -900 HU: a slab of 10 mm moved by 3 mm gains 30 % of 1000 HU."""
    hu = np.full((40, 20, 20), -900, dtype=np.int16)
    hu[20:] = 100
    slab = np.zeros(hu.shape, dtype=bool)
    slab[10:20, 5:15, 5:15] = True
    ct = Volume(grid=Grid.from_spacing(hu.shape, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)), array=hu)
    assert moved_by(ct, slab) == pytest.approx([0.0, 300.0, 0.0, 0.0, 0.0, 0.0])


def test_the_description_tells_what_came_from_elsewhere(
    tmp_path: Path, ct: Volume, truth: dict[str, Array]
) -> None:
    for name in ("airway", "airway_wall", "vessels", "lungs"):
        _write(tmp_path / f"{name}.nii.gz", ct, truth[name])
    sources = {"airway_wall": 'w "1".nii.gz', "vessels": "v.nii.gz (TotalSegmentator)"}
    text = description_text({"name": "P", **MADE_MASKS, "cost": "", "sources": sources})
    (tmp_path / "patient.toml").write_text(text)
    (said,) = [w for w in load_own_masks(tmp_path / "patient.toml").warnings if "took the place" in w]
    assert 'airway wall from w "1".nii.gz; vessels from v.nii.gz (TotalSegmentator)' in said
