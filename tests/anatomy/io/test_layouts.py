"""Folders of public data sets, as made by hand: each is read, or refused with what a stranger can act on."""

from __future__ import annotations

import gzip
import shutil
from pathlib import Path

import numpy as np
import pytest

from anatomy.base.errors import AnatomyError, FileError, FrameError, LungaccessError
from anatomy.grid import Grid, Volume
from anatomy.io import load_patient, write_volume
from anatomy.io.ct_cases import ct_case
from anatomy.io.inputs import input_hashes
from anatomy.io.liver import is_liver, load_liver
from anatomy.lobes import LOBES, fissures_between, lobe_named

SHORT = {"RUL": 1, "RML": 2, "RLL": 3, "LUL": 4, "LLL": 5}
TOTAL = {
    "lung_upper_lobe_right": 1,
    "lung_middle_lobe_right": 2,
    "lung_lower_lobe_right": 3,
    "lung_upper_lobe_left": 4,
    "lung_lower_lobe_left": 5,
}


def box(grid: Grid, start: tuple[int, int, int], stop: tuple[int, int, int]) -> Volume:
    array = np.zeros(grid.shape, dtype=bool)
    array[tuple(slice(a, b) for a, b in zip(start, stop, strict=True))] = True
    return Volume(grid=grid, array=array)


@pytest.fixture
def lobes(grid: Grid) -> dict[int, Volume]:
    """Five blocks: the right lung at small i, upper over lower lobes."""
    return {
        1: box(grid, (1, 5, 4), (5, 9, 7)),
        2: box(grid, (1, 1, 4), (5, 5, 7)),
        3: box(grid, (1, 1, 1), (5, 9, 4)),
        4: box(grid, (7, 1, 4), (11, 9, 7)),
        5: box(grid, (7, 1, 1), (11, 9, 4)),
    }


@pytest.fixture
def respiratory(tmp_path: Path, masks: dict[str, Volume], lobes: dict[int, Volume]) -> Path:
    folder = tmp_path / "Patient3"
    folder.mkdir()
    for name, number in SHORT.items():
        write_volume(folder / f"{name}.nii.gz", lobes[number])
    write_volume(folder / "BronchialTree.nii.gz", masks["lumen"])
    write_volume(folder / "vessels.nii.gz", masks["arteries"])
    return folder


def test_lobes_are_lungs_and_have_fissures_between_them(respiratory, lobes):
    patient = load_patient(respiratory)
    union = np.logical_or.reduce([lobe.array for lobe in lobes.values()])
    assert (patient.lung.array >= union).all() and patient.kind == "med-rad"
    fissures = patient.fissures.array
    # Both sides of every border within a lung, nothing else: of left and right none.
    assert fissures[1:5, 1:9, 3:5].all() and fissures[1:5, 4:6, 4:7].all() and fissures[7:11, 1:9, 3:5].all()
    assert not fissures[1:5, 1:9, 1:3].any() and not fissures[7:11, 1:9, 5:7].any()
    assert any("are taken as fissures" in said for said in patient.warnings)
    for number, lobe in lobes.items():
        assert (patient.lobes.array[lobe.array] == number).all(), LOBES[number]


@pytest.mark.parametrize("grown", [0, 1])
def test_no_step_leads_from_lobe_to_lobe_past_the_fissure(lobes, grid, grown):
    numbers = np.zeros(grid.shape, dtype=np.uint8)
    for number, lobe in lobes.items():
        numbers[lobe.array] = number
    if grown:
        numbers = np.random.default_rng(2).integers(0, 6, grid.shape).astype(np.uint8)
    fissures = fissures_between(numbers)
    for axis in range(3):
        a, b = (np.moveaxis(numbers, axis, 0)[part] for part in (slice(None, -1), slice(1, None)))
        free = ~np.moveaxis(fissures, axis, 0)
        crossed = free[:-1] & free[1:] & (a > 0) & (b > 0) & (a != b) & ((a <= 3) == (b <= 3))
        assert not crossed.any()


def test_a_stated_fissure_mask_wins_over_lobes(respiratory, masks):
    write_volume(respiratory / "fissures.nii.gz", masks["fissures"])
    assert (load_patient(respiratory).fissures.array == masks["fissures"].array).all()


def test_a_gap_between_lobes_is_bridged_and_a_slip_of_the_pen_is_no_lobe(respiratory, lobes, grid):
    narrow = box(grid, (7, 1, 1), (11, 9, 3))
    narrow.array.flags.writeable = True
    array = narrow.array.copy()
    array[1, 1, 1] = True  # a voxel of the left lower lobe in the right lung
    write_volume(respiratory / "LLL.nii.gz", Volume(grid=grid, array=array))
    patient = load_patient(respiratory)
    assert patient.lobes.array[1, 1, 1] != 5
    assert any("1 voxels of the mask of the left lower lobe lie apart" in said for said in patient.warnings)


@pytest.mark.parametrize(
    "name",
    [
        "BronchialTree.gz",
        "bronchialtree.nii.gz",
        "Bronchial_Tree.nii",
        "EXACT09_CASE18_BronchialTree_Def0.nii.gz",
        "bronchialTree.nrrd",
    ],
)
def test_a_bronchial_tree_is_known_by_any_usual_spelling(respiratory, masks, name):
    expected = load_patient(respiratory).lumen.array
    (respiratory / "BronchialTree.nii.gz").unlink()
    if name.endswith(".gz") and not name.endswith(".nii.gz"):
        write_volume(respiratory / "tmp.nii.gz", masks["lumen"])
        (respiratory / "tmp.nii.gz").rename(respiratory / name)
    else:
        write_volume(respiratory / name, masks["lumen"])
    assert (load_patient(respiratory).lumen.array == expected).all()
    assert name in input_hashes(respiratory)


def test_a_gz_that_holds_no_image_is_left_alone(respiratory):
    (respiratory / "notes.gz").write_bytes(gzip.compress(b"not an image" * 100))
    (respiratory / "broken.gz").write_bytes(b"\x1f\x8b")
    assert load_patient(respiratory).lobes is not None


def test_lobes_of_totalsegmentator_and_of_own_masks_mean_the_same(tmp_path, masks, lobes, respiratory):
    expected = load_patient(respiratory)
    total, own = tmp_path / "total", tmp_path / "own"
    for folder in (total, own):
        folder.mkdir()
        for name, number in TOTAL.items():
            write_volume(folder / f"{name}.nii.gz", lobes[number])
    write_volume(total / "lung_trachea_bronchia.nii.gz", masks["lumen"])
    write_volume(total / "lung_vessels.nii.gz", masks["arteries"])
    write_volume(own / "a.nii.gz", masks["lumen"])
    write_volume(own / "v.nii.gz", masks["arteries"])
    files = ", ".join(f'"{name}.nii.gz"' for name in TOTAL)
    own_text = f'lumen = "a.nii.gz"\nvessels = "v.nii.gz"\nlung = [{files}]\n'
    (own / "patient.toml").write_text(own_text)
    table = ", ".join(f'"{LOBES[number]}" = "{name}.nii.gz"' for name, number in TOTAL.items())
    for path in (total, own):
        patient = load_patient(path)
        for role in ("lung", "lobes", "fissures"):
            assert (getattr(patient, role).array == getattr(expected, role).array).all(), (path, role)
    (own / "patient.toml").write_text(f'lumen = "a.nii.gz"\nvessels = "v.nii.gz"\nlobes = {{ {table} }}\n')
    assert (load_patient(own).lobes.array == expected.lobes.array).all()
    (own / "patient.toml").write_text(
        'lumen = "a.nii.gz"\nvessels = "v.nii.gz"\nlobes = { "spleen" = "a.nii" }\n'
    )
    with pytest.raises(LungaccessError, match="names a lobe 'spleen'"):
        load_patient(own)


@pytest.mark.parametrize(
    "name", ["lung", "left", "upper", "liver", "lul2", "left_right_upper_lobe", "left_middle"]
)
def test_other_names_are_no_lobe(name):
    assert lobe_named(name) == 0


# --- paths of a patient.toml -----------------------------------------------------------------------


def test_absolute_and_relative_paths_may_stand_side_by_side(tmp_path, masks, monkeypatch):
    for folder in ("here", "there"):
        (tmp_path / folder).mkdir()
    write_volume(tmp_path / "here" / "lumen.nii.gz", masks["lumen"])
    write_volume(tmp_path / "there" / "vessels.nii.gz", masks["arteries"])
    write_volume(tmp_path / "here" / "lung.nii.gz", masks["lung_left"])
    there = (tmp_path / "there" / "vessels.nii.gz").as_posix()
    (tmp_path / "here" / "patient.toml").write_text(
        f'lumen = "lumen.nii.gz"\nvessels = "{there}"\nlung = "lung.nii.gz"\n'
    )
    monkeypatch.chdir(tmp_path)
    patients = [load_patient(path) for path in ("here", tmp_path / "here", "here/patient.toml")]
    for patient in patients:
        assert (patient.vessels.array == masks["arteries"].array).all()
        assert {"here/lumen.nii.gz", "there/vessels.nii.gz"} <= set(patient.sources)
    assert set(input_hashes("here")) == set(input_hashes(tmp_path / "here"))


def test_a_renamed_file_of_a_description_is_named(tmp_path, masks):
    write_volume(tmp_path / "airways.nii.gz", masks["lumen"])
    (tmp_path / "patient.toml").write_text('lumen = "airway.nii.gz"\nvessels = "v.nii"\nlung = "l.nii"\n')
    with pytest.raises(
        FileError, match=r"airway\.nii\.gz, which is not there.*Did you mean 'airways\.nii\.gz'"
    ):
        load_patient(tmp_path)


# --- livers and brains -----------------------------------------------------------------------------


@pytest.fixture
def liver(tmp_path: Path, grid: Grid) -> Path:
    """Masks of different numbers of slices, as in the collection."""
    folder = tmp_path / "Patient1"
    folder.mkdir()
    upper = grid.crop((0, 0, 2), (12, 10, 8))
    write_volume(folder / "liver.nii.gz", box(grid, (1, 1, 1), (11, 9, 7)))
    write_volume(folder / "hepaticvein.nii.gz", box(upper, (3, 2, 0), (4, 8, 4)))
    write_volume(folder / "portalVein.nii.gz", box(upper, (7, 2, 0), (8, 8, 4)))
    write_volume(folder / "HepaticArtery.nii", box(upper, (9, 2, 0), (10, 8, 2)))
    for number, place in ((1, (5, 5, 2)), (2, (2, 4, 2))):
        write_volume(folder / f"nodule{number}.nii.gz", box(upper, place, tuple(n + 1 for n in place)))
    (folder / "target1.txt").write_text("2.5\n-2\n31\n")
    (folder / "target1_start2.txt").write_text("1 0 0 -5\n0 -1 0 2\n0 0 -1 31\n0 0 0 1\n")
    (folder / "target1_start1.txt").write_text("1 0 0 -5\n0 -1 0 2\n0 0 -1 33\n0 0 0 1\n")
    return folder


def test_a_liver_is_placed_slice_by_slice_with_its_starts_and_targets(liver):
    images = load_liver(liver)
    assert images.grid.shape == (12, 10, 8)
    assert images.lumens["hepatic-vein"].array[3, 2, 2:6].all() and images.nodules.array.sum() == 2
    assert images.start_names == ("target1_start1", "target1_start2") and images.target_names == ("target1",)
    assert images.targets_lps[0].tolist() == [-2.5, 2.0, 31.0]
    assert any("covers 12 x 10 x 6 of the 12 x 10 x 8 voxels" in said for said in images.warnings)


def test_a_liver_is_no_lung_and_says_what_can_be_done(liver):
    with pytest.raises(FileError, match="is a liver of Med-RAD") as caught:
        load_patient(liver)
    assert "lungaccess needle" in caught.value.remedy and "--lumen portal-vein" in caught.value.remedy


def test_a_liver_without_one_of_its_vessels_is_refused_with_the_file_that_looks_like_it(liver):
    (liver / "portalVein.nii.gz").rename(liver / "portalVien.nii.gz")
    assert is_liver(liver)
    with pytest.raises(AnatomyError, match=r"no portalVein\. portalVien\.nii\.gz looks like portalVein"):
        load_liver(liver)


def test_a_brain_is_refused_in_words(tmp_path, masks):
    for name in ("brain", "ventricles", "vessels"):
        write_volume(tmp_path / f"{name}.nii.gz", masks["lumen"])
    with pytest.raises(FileError, match="brains are not planned for"):
        load_patient(tmp_path)


# --- folders that are nearly a patient -------------------------------------------------------------


def test_a_renamed_bronchial_tree_is_offered(med_rad_folder):
    (med_rad_folder / "bronchialTree.nii.gz").rename(med_rad_folder / "bronchial_tre.nii.gz")
    with pytest.raises(
        AnatomyError, match=r"bronchial_tre\.nii\.gz looks like bronchialTree\.nii\.gz"
    ) as caught:
        load_patient(med_rad_folder)
    assert "patient.toml" in caught.value.remedy and "docs/" not in str(caught.value)


def test_missing_vessels_are_named_with_what_else_is_there(med_rad_folder):
    (med_rad_folder / "vessels.nii.gz").rename(med_rad_folder / "something.nii.gz")
    with pytest.raises(AnatomyError, match=r"no mask of the vessels.*unknown name: something\.nii\.gz"):
        load_patient(med_rad_folder)


def test_a_target_of_another_frame_is_told_so(med_rad_folder):
    (med_rad_folder / "target.txt").write_text("25 15 31\n")
    assert load_patient(med_rad_folder).targets_lps[0].tolist() == [-25, -15, 31]
    (med_rad_folder / "target.txt").write_text("25 500 31\n")
    with pytest.raises(FrameError, match="outside the images"):
        load_patient(med_rad_folder)


def test_the_folder_of_patients_lists_them(med_rad_folder):
    shutil.copytree(med_rad_folder, med_rad_folder.parent / "Patient8")
    with pytest.raises(FileError, match="it holds 2: Patient7, Patient8") as caught:
        load_patient(med_rad_folder.parent)
    assert str(med_rad_folder) in caught.value.remedy


def test_lobes_of_the_task_total_alone_name_the_task_that_is_missing(tmp_path, lobes):
    for name, number in TOTAL.items():
        write_volume(tmp_path / f"{name}.nii.gz", lobes[number])
    with pytest.raises(FileError, match="neither airways nor vessels") as caught:
        load_patient(tmp_path)
    assert "--task lung_vessels" in caught.value.remedy


# --- AeroPath and ATM'22 ---------------------------------------------------------------------------


def test_a_case_of_aeropath_says_what_it_lacks_and_how_it_is_made(tmp_path, landmark, masks):
    for number in (2, 11):
        case = tmp_path / f"{number}"
        case.mkdir()
        write_volume(case / f"{number}_CT_HR.nii.gz", landmark)
        write_volume(case / f"{number}_CT_HR_label_airways.nii.gz", masks["lumen"])
        write_volume(case / f"{number}_CT_HR_label_lungs.nii.gz", masks["lung_left"])
    with pytest.raises(FileError, match="case 11 of AeroPath: there are no masks of vessels") as caught:
        load_patient(tmp_path / "11")
    assert f"lungaccess segment {tmp_path / '11'} --out aeropath-11" in caught.value.remedy
    with pytest.raises(FileError, match="it holds 2: 2, 11"):
        load_patient(tmp_path)
    found = ct_case(tmp_path / "2")
    assert found.lungs == tmp_path / "2" / "2_CT_HR_label_lungs.nii.gz"


def test_a_case_of_atm_is_a_file_in_one_of_two_folders(tmp_path, landmark, masks):
    for folder, volume in (("imagesTr", landmark), ("labelsTr", masks["lumen"])):
        (tmp_path / folder).mkdir()
        for number in (1, 7):
            write_volume(tmp_path / folder / f"ATM_00{number}_0000.nii.gz", volume)
    label = tmp_path / "labelsTr" / "ATM_007_0000.nii.gz"
    with pytest.raises(FileError, match="case ATM_007 of ATM'22: there are no masks of vessels and lungs"):
        load_patient(label)
    assert ct_case(label).ct == tmp_path / "imagesTr" / "ATM_007_0000.nii.gz"
    for folder in (tmp_path, tmp_path / "imagesTr"):
        with pytest.raises(FileError, match=r"it holds 2: .*ATM_001_0000\.nii\.gz, .*ATM_007"):
            load_patient(folder)


# --- published folders -----------------------------------------------------------------------------


@pytest.mark.data
@pytest.mark.slow
def test_the_respiratory_part_loads_and_its_lobes_are_a_lung_apart(data_dir):
    patient = load_patient(data_dir / "med-rad-respiratory" / "Patient2")
    counts = np.bincount(patient.lobes.array.ravel())
    assert (counts[1:] > 500_000).all() and patient.fissures.array.any()
    touched = [number for number in LOBES if (patient.lobes.array[patient.fissures.array] == number).any()]
    assert touched == list(LOBES)


@pytest.mark.data
def test_the_published_liver_loads(data_dir):
    images = load_liver(data_dir / "med-rad-liver" / "Patient1")
    at = tuple(np.floor(images.grid.ijk(images.targets_lps[0]) + 0.5).astype(int))
    assert images.nodules.array[at] and len(images.starts) == 1
