"""Patients of the published layouts."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from anatomy.base.errors import AnatomyError, FileError, FrameError
from anatomy.grid import Grid, Volume
from anatomy.io import load_patient, write_volume
from anatomy.io.patients import is_ct
from anatomy.patient import PatientImages
from tests.anatomy.io.label_maps import LABELS, add_label_table, label_map, require_same
from tests.anatomy.io.series import write_series

LOBES = {"lung_upper_lobe_left": "lung_left", "lung_lower_lobe_right": "lung_right"}
ABSENT_LOBES = tuple(
    f"There is no mask of the {name} lobe: what lies there is not lung."
    for name in ("right upper", "right middle", "left lower")
)


def cleared(volume: Volume) -> Volume:
    return Volume(grid=volume.grid, array=np.zeros_like(volume.array))


def test_a_med_rad_folder_is_understood(med_rad_folder, masks, grid):
    patient = load_patient(med_rad_folder)
    assert (patient.name, patient.kind, patient.wall, patient.warnings) == ("Patient7", "med-rad", None, ())
    require_same(patient.lumen, masks["lumen"])
    require_same(patient.vessels, masks["arteries"])
    require_same(patient.lung, masks["lung_left"], masks["lung_right"])
    require_same(patient.nodules, masks["nodule"])
    assert patient.grid.is_close(grid)
    assert patient.lumen.grid is patient.grid
    assert [point.tolist() for point in patient.targets_lps] == [[17.5, 6, 31]]
    assert patient.starts[0].tolist() == [[-1, 0, 0, 5], [0, 1, 0, -2], [0, 0, -1, 31], [0, 0, 0, 1]]
    content = (med_rad_folder / "target.txt").read_bytes()
    assert patient.sources["target.txt"] == hashlib.sha256(content).hexdigest()
    assert len(patient.sources) == 7


def test_a_mask_that_a_lung_does_not_have_is_named(med_rad_folder, masks):
    write_volume(med_rad_folder / "heart.nii.gz", masks["nodule"])
    (warning,) = load_patient(med_rad_folder).warnings
    assert warning.startswith("heart.nii.gz is not read")


def test_target_lies_in_the_nodule_only_if_both_are_flipped_alike(med_rad_folder):
    patient = load_patient(med_rad_folder)
    ijk = np.rint(patient.grid.ijk(patient.targets_lps[0])).astype(int)
    assert patient.nodules.array[tuple(ijk)]


def test_starts_come_in_the_order_of_their_numbers(med_rad_folder):
    start = (med_rad_folder / "start1.txt").read_text()
    for number in (10, 2):
        (med_rad_folder / f"start{number}.txt").write_text(start.replace("31", str(30 + number / 10)))
    heights = [pose[2, 3] for pose in load_patient(med_rad_folder).starts]
    assert heights == [31, 30.2, 31.0]


def test_points_outside_the_images_betray_a_wrong_frame(med_rad_folder):
    (med_rad_folder / "target.txt").write_text("500 0 30\n")
    with pytest.raises(FrameError, match="outside the images"):
        load_patient(med_rad_folder)


def test_nodule_and_fissures_may_be_absent_or_empty(med_rad_folder, masks):
    write_volume(med_rad_folder / "nodule.nii.gz", cleared(masks["nodule"]))
    (med_rad_folder / "fissures.nii.gz").unlink()
    patient = load_patient(med_rad_folder)
    assert patient.nodules is None and patient.fissures is None
    assert len(patient.warnings) == 1 and "nodule.nii.gz" in patient.warnings[0]


@pytest.mark.parametrize("name", ["bronchialTree", "vessels", "pleuralBoundary"])
def test_an_empty_mask_is_refused(med_rad_folder, masks, name):
    write_volume(med_rad_folder / f"{name}.nii.gz", cleared(masks["lumen"]))
    with pytest.raises(AnatomyError, match=rf"empty \({name}"):
        load_patient(med_rad_folder)


def test_a_missing_mask_is_refused(med_rad_folder):
    (med_rad_folder / "vessels.nii.gz").unlink()
    with pytest.raises(AnatomyError, match="no mask of the vessels"):
        load_patient(med_rad_folder)


def test_a_rounded_header_is_the_same_grid(med_rad_folder, masks):
    grid = masks["lumen"].grid
    rounded = Grid.from_spacing(grid.shape, grid.spacing_mm + [0, 0, 6e-5], grid.lps_from_ijk[:3, 3])
    write_volume(med_rad_folder / "vessels.nii.gz", Volume(grid=rounded, array=masks["arteries"].array))
    assert load_patient(med_rad_folder).vessels.grid.is_close(grid, 1e-5)


def test_a_truncated_mask_is_named(med_rad_folder):
    path = med_rad_folder / "vessels.nii.gz"
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(FileError, match=r"vessels\.nii\.gz"):
        load_patient(med_rad_folder)


def write_lobes(folder: Path, masks: dict[str, Volume]) -> None:
    for name, key in LOBES.items():
        write_volume(folder / f"{name}.nii.gz", masks[key])


def require_totalsegmentator(patient: PatientImages, masks: dict[str, Volume]) -> None:
    assert patient.kind == "totalsegmentator"
    require_same(patient.lumen, masks["lumen"])
    require_same(patient.wall, masks["wall"])
    require_same(patient.vessels, masks["arteries"], masks["veins"])
    lobes = masks["lung_left"].array | masks["lung_right"].array
    assert (patient.lung.array >= (lobes | patient.lumen.array | patient.vessels.array)).all()


def test_a_folder_of_structures_is_understood(tmp_path, masks):
    for value, key in ((1, "lumen"), (2, "wall"), (3, "arteries"), (4, "veins")):
        write_volume(tmp_path / f"{LABELS[value]}.nii.gz", masks[key])
    write_lobes(tmp_path, masks)
    patient = load_patient(tmp_path)
    require_totalsegmentator(patient, masks)
    assert patient.warnings == ABSENT_LOBES


def test_a_folder_of_older_versions_is_understood(tmp_path, masks):
    write_volume(tmp_path / "lung_vessels.nii.gz", masks["arteries"])
    write_volume(tmp_path / "lung_trachea_bronchia.nii.gz", masks["lumen"])
    write_lobes(tmp_path, masks)
    patient = load_patient(tmp_path)
    require_same(patient.lumen, masks["lumen"])
    require_same(patient.vessels, masks["arteries"])
    assert patient.wall is None


def test_vessels_of_older_versions_are_read_by_their_values(tmp_path, masks):
    test_a_folder_of_older_versions_is_understood(tmp_path, masks)
    for top in (0.9, 255.0):
        values = np.where(masks["arteries"].array, top, 0).astype(np.float32)
        values[0, 0, 0] = 0.1 if top < 1 else 0.0
        write_volume(tmp_path / "lung_vessels.nii.gz", Volume(grid=masks["lumen"].grid, array=values))
        require_same(load_patient(tmp_path).vessels, masks["arteries"])


def test_label_names_in_the_header_decide(tmp_path, masks):
    path = tmp_path / "segmentation.nii.gz"
    volume = label_map(masks)
    reordered = np.choose(volume.array, [0, 8, 7, 6, 5]).astype(np.uint8)
    write_volume(path, Volume(grid=volume.grid, array=reordered))
    add_label_table(path, {8: "lung_airways", 7: "lung_airways_wall", 6: "lung_arteries", 5: "lung_veins"})
    write_lobes(tmp_path, masks)
    patient = load_patient(tmp_path)
    require_totalsegmentator(patient, masks)
    assert patient.warnings == ABSENT_LOBES
    require_totalsegmentator(load_patient(path), masks)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("segmentation.json", {str(value): name for value, name in LABELS.items()}),
        ("labels.json", {name: value for value, name in LABELS.items()}),
        ("dataset.json", {"labels": {"background": 0, **{name: v for v, name in LABELS.items()}}}),
    ],
)
def test_label_names_in_a_sidecar_decide(tmp_path, masks, name, content):
    write_volume(tmp_path / "segmentation.nii.gz", label_map(masks))
    (tmp_path / name).write_text(json.dumps(content))
    write_lobes(tmp_path, masks)
    patient = load_patient(tmp_path)
    require_totalsegmentator(patient, masks)
    assert name in patient.sources


@pytest.mark.parametrize("name", ["lung_vessels.nii.gz", "anything.nii.gz"])
def test_without_names_the_published_table_is_used_and_said(tmp_path, masks, name):
    write_volume(tmp_path / name, label_map(masks))
    write_lobes(tmp_path, masks)
    patient = load_patient(tmp_path / name)
    require_totalsegmentator(patient, masks)
    assert len(patient.warnings) == 4 and "1 = lung_airways" in patient.warnings[0]


def test_labels_that_fit_two_published_tables_are_refused(tmp_path, masks):
    two = np.where(label_map(masks).array <= 2, label_map(masks).array, 0).astype(np.uint8)
    write_volume(tmp_path / "lung_vessels.nii.gz", Volume(grid=masks["lumen"].grid, array=two))
    write_lobes(tmp_path, masks)
    with pytest.raises(AnatomyError, match="no or several published tables"):
        load_patient(tmp_path)


def test_unknown_structures_and_ct_beside_are_ignored(tmp_path, masks, landmark):
    write_volume(tmp_path / "lung_vessels.nii.gz", label_map(masks))
    write_volume(tmp_path / "ct.nii.gz", landmark)
    write_volume(tmp_path / "liver.nii.gz", masks["nodule"])
    write_lobes(tmp_path, masks)
    require_totalsegmentator(load_patient(tmp_path), masks)


def test_a_sidecar_of_the_folder_does_not_name_the_values_of_a_ct(tmp_path, masks, grid):
    write_volume(tmp_path / "segmentation.nii.gz", label_map(masks))
    (tmp_path / "labels.json").write_text(json.dumps(LABELS))
    hounsfield = np.random.default_rng(0).integers(-1000, 1000, grid.shape).astype(np.int16)
    hounsfield[:, 0, 0] = 1
    write_volume(tmp_path / "ct.nii.gz", Volume(grid=grid, array=hounsfield))
    write_lobes(tmp_path, masks)
    require_totalsegmentator(load_patient(tmp_path), masks)


def test_the_gap_between_lobe_and_airway_counts_as_lung_but_not_the_mediastinum(tmp_path, grid, masks):
    lumen = masks["lumen"].array.copy()
    lobe = np.zeros_like(lumen)
    lobe[8:11, 1:9, 1:7] = True  # one voxel (i = 7) away from the lumen at i = 5, 6
    write_volume(tmp_path / "lung_airways.nii.gz", masks["lumen"])
    write_volume(tmp_path / "lung_vessels.nii.gz", Volume(grid=grid, array=masks["veins"].array))
    write_volume(tmp_path / "lung_left.nii.gz", Volume(grid=grid, array=lobe))
    lung = load_patient(tmp_path).lung.array
    assert lung[7, 4, 5], "the gap beside the airway"
    assert not lung[7, 8, 5], "far from the airway"
    assert not lung[4, 4, 5], "beside the airway, but away from any lobe"
    assert not lung[2:4].any(), "the other side"


def test_what_is_no_patient_is_refused(tmp_path):
    with pytest.raises(FileError, match="no patient at"):
        load_patient(tmp_path / "missing")
    with pytest.raises(FileError, match="no image at all"):
        load_patient(tmp_path)


def test_read_masks_cannot_be_written(med_rad_folder):
    patient = load_patient(med_rad_folder)
    with pytest.raises(ValueError, match="read-only"):
        patient.lumen.array[0, 0, 0] = True


@pytest.mark.data
@pytest.mark.parametrize("number", [1, 2])
def test_left_is_left_in_real_patients(data_dir, number):
    patient = load_patient(data_dir / "med-rad" / f"Patient{number}")
    i = np.nonzero(patient.lung.array[::4, ::4, ::4])[0] * 4
    x_lps = patient.grid.lps_from_ijk[0, 3] + patient.grid.lps_from_ijk[0, 0] * i
    middle = (x_lps.min() + x_lps.max()) / 2
    left, right = np.count_nonzero(x_lps > middle), np.count_nonzero(x_lps < middle)
    assert 0.5 * right < left < right, "the left lung makes room for the heart"
    assert near(patient, patient.nodules, patient.targets_lps[0])
    assert len(patient.starts) == 5
    assert all(near(patient, patient.lumen, pose[:3, 3]) for pose in patient.starts), "at the airway wall"


def near(patient: PatientImages, mask: Volume, point_lps: np.ndarray) -> bool:
    """Whether the mask has a voxel within four voxels of a point."""
    i, j, k = np.rint(patient.grid.ijk(point_lps)).astype(int)
    return bool(mask.array[i - 4 : i + 5, j - 4 : j + 5, k - 4 : k + 5].any())


def test_a_ct_is_told_from_a_patient(med_rad_folder: Path, masks: PatientImages, tmp_path: Path) -> None:
    grid = Grid.from_spacing((6, 5, 4), [1.0, 1.0, 2.0], [0.0, 0.0, 0.0])
    ct = Volume(grid=grid, array=np.where(np.arange(120).reshape(6, 5, 4) % 2, 40, -950).astype(np.int16))
    write_volume(tmp_path / "scan.nrrd", ct)
    write_volume(tmp_path / "labels.nrrd", Volume(grid=grid, array=np.ones(grid.shape, dtype=np.uint8)))
    write_series(tmp_path / "series", ct)
    assert is_ct(tmp_path / "scan.nrrd") and is_ct(tmp_path / "series")
    assert not is_ct(tmp_path / "labels.nrrd") and not is_ct(med_rad_folder) and not is_ct(tmp_path / "none")
    (tmp_path / "series" / "patient.toml").touch()
    assert not is_ct(tmp_path / "series")
