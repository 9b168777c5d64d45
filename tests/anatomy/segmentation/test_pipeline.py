"""From a CT to a patient folder: what is written, what is done again, what a person's corrections do."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import ndimage

from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import AnatomyError, FileError, GridMismatchError, SettingsError
from anatomy.grid import Grid, Volume
from anatomy.io import load_patient, read_volume
from anatomy.io.corrections import FOLDER
from anatomy.io.images import write_volume
from anatomy.lobes import BORDER, LEFT_LOWER, LEFT_UPPER, LOBES, RIGHT_LOWER, SEEN, UNKNOWN
from anatomy.phantom import LABELS, Phantom
from anatomy.segmentation.folder import STATE, SegmentationFolder, digest_of
from anatomy.segmentation.parts import RefusedError
from anatomy.segmentation.pipeline import Segmentation, read_ct, segment
from anatomy.segmentation.request import Given, SegmentationRequest
from anatomy.segmentation.scan_warnings import quality_of
from experiments.support.segmentation.hard_images import phantom_image, turned

pytestmark = pytest.mark.slow

ALL = ("lungs", "airway", "nodule", "vessels", "lobes", "cost map")
VOXEL_MM = 1.25
"""Those of the patient, so that nothing is interpolated, which tests of their own do."""
IMAGES = (
    "lungs",
    "central_airway",
    "airway",
    "airway_wall",
    "nodule",
    "vesselness",
    "vessels",
    "lobes",
    "fissures",
    "cost",
)


@pytest.fixture(scope="module")
def made(patient: Phantom, tmp_path_factory: pytest.TempPathFactory) -> Segmentation:
    folder = tmp_path_factory.mktemp("made")
    nodule = folder / "given-nodule.nii.gz"
    assert patient.images.nodules is not None
    write_volume(nodule, patient.images.nodules)
    return segment(_request(patient, folder / "patient", nodule_mask=nodule))


@pytest.fixture
def copy(made: Segmentation, tmp_path: Path) -> Path:
    """A folder that is up to date, to do things to."""
    return Path(shutil.copytree(made.folder, tmp_path / "patient"))


def _request(patient: Phantom, out: Path, **given: Any) -> SegmentationRequest:
    return SegmentationRequest(ct=patient.ct, out=out, name="P", given=Given(**given), voxel_mm=VOXEL_MM)


def _in_box(patient: Phantom, made: Segmentation, array: np.ndarray) -> np.ndarray:
    """Return the part of an image of the patient that a segmentation covers."""
    low = np.rint(patient.ct.grid.ijk(made.grid.lps((0, 0, 0)))).astype(int)
    return array[tuple(slice(a, a + n) for a, n in zip(low, made.grid.shape, strict=True))]


def _again(patient: Phantom, made: Segmentation, folder: Path) -> Segmentation:
    return segment(_same_request(patient, made, folder))


def _same_request(patient: Phantom, made: Segmentation, folder: Path) -> SegmentationRequest:
    return _request(patient, folder, nodule_mask=made.folder.parent / "given-nodule.nii.gz")


def _voxels(folder: Path) -> dict[str, str]:
    return {name: digest_of(read_volume(folder / f"{name}.nii.gz").array) for name in IMAGES}


def test_the_folder_is_a_patient(patient: Phantom, made: Segmentation) -> None:
    images = load_patient(made.folder)
    truth = patient.images
    assert images.name == "P"
    assert images.grid.is_close(made.grid) and made.grid.shape != patient.ct.grid.shape
    both = np.count_nonzero(images.lung.array & _in_box(patient, made, truth.lung.array))
    assert 2 * both / (np.count_nonzero(images.lung.array) + np.count_nonzero(truth.lung.array)) > 0.98
    assert images.cost is not None
    assert np.isinf(images.cost.array[~images.lung.array & (made.parts.nodule == 0)]).all()
    assert np.isinf(images.cost.array[images.lumen.array | images.vessels.array]).all()
    free = images.lung.array & ~np.isinf(images.cost.array)
    assert np.count_nonzero(free) > 0.8 * np.count_nonzero(images.lung.array)
    assert made.recomputed == ALL
    assert made.corrected == ()


def test_a_nodule_is_outlined_at_a_point_and_freed_of_vessel(
    patient: Phantom, made: Segmentation, copy: Path
) -> None:
    nodule = max(patient.nodules, key=lambda each: each.radius_mm)
    point = "lps:" + ",".join(f"{x:.2f}" for x in nodule.centre_lps)
    again = segment(_request(patient, copy, nodules=(point,)))
    assert again.recomputed == ("nodule", "vessels", "lobes", "cost map")
    centres = again.grid.lps(np.argwhere(again.parts.nodule))
    apart = np.linalg.norm(centres - nodule.centre_lps, axis=1)
    assert apart.max() < nodule.radius_mm + 2.0 * VOXEL_MM
    (size,) = quality_of(again.parts).nodules
    assert size.long_axis_mm == pytest.approx(2.0 * nodule.radius_mm, abs=2.0 * VOXEL_MM)
    assert not (again.parts.all_vessels & again.parts.nodule).any()
    assert np.isfinite(again.parts.cost[again.parts.nodule]).all()


def test_lobes_and_fissures_are_those_of_the_patient(patient: Phantom, made: Segmentation) -> None:
    images = load_patient(made.folder)
    assert images.lobes is not None and images.fissures is not None
    truth = _in_box(patient, made, patient.lobes.array) * (made.parts.left | made.parts.right)
    for number, name in LOBES.items():
        both = np.count_nonzero((images.lobes.array == number) & (truth == number))
        sizes = np.count_nonzero(images.lobes.array == number) + np.count_nonzero(truth == number)
        assert 2 * both / sizes > 0.95, name
    fissure = _in_box(patient, made, patient.mask("fissure"))
    far = ndimage.distance_transform_edt(~fissure, sampling=patient.grid.spacing_mm)
    assert np.median(far[made.parts.fissures == SEEN]) <= 1.5
    borders = made.parts.fissures[(made.parts.fissures == SEEN) | (made.parts.fissures == BORDER)]
    assert np.mean(borders == SEEN) > 0.8
    # Fissures lie in their band in 95 of 100 places, and the band fills a small part of the lungs.
    lungs = made.parts.left | made.parts.right
    assert np.mean(made.parts.fissures[fissure & lungs] > 0) >= 0.95
    assert np.mean(made.parts.fissures[lungs] > 0) < 0.12
    assert images.fissure_band is not None and (images.fissure_band.array == made.parts.fissures).all()
    assert (images.fissures.array == ((made.parts.fissures == SEEN) | (made.parts.fissures == BORDER))).all()
    assert not [said for said in images.warnings if "fissure" in said]


def test_lobes_that_are_not_known_are_not_claimed(patient: Phantom, made: Segmentation, copy: Path) -> None:
    """The lung without lobes has fissures of which nothing is known, and the other one keeps its own."""
    half = made.parts.lobes * made.parts.left
    (copy / "lobes.nii.gz").unlink()
    write_volume(copy / "lobes.seg.nrrd", Volume(grid=made.grid, array=half))
    again = _again(patient, made, copy)
    assert again.corrected == ("lobes",) and again.recomputed == ("lobes",)
    images = load_patient(copy)
    assert images.fissures is not None and images.fissure_band is not None and images.lobes is not None
    band = images.fissure_band.array
    assert (band[made.parts.right] == UNKNOWN).all() and not (band[made.parts.left] == UNKNOWN).any()
    assert images.fissures.array[made.parts.left].any() and not images.fissures.array[made.parts.right].any()


def test_the_nodule_is_the_target_and_no_vessel(patient: Phantom, made: Segmentation) -> None:
    images = load_patient(made.folder)
    assert images.nodules is not None
    assert not (images.vessels.array & images.nodules.array).any()
    assert len(images.targets_lps) == 1
    nearest = min(np.linalg.norm(images.targets_lps[0] - n.centre_lps) for n in patient.nodules)
    assert nearest < 2.0
    assert images.cost is not None
    assert np.isfinite(images.cost.array[images.nodules.array & ~made.parts.lumen & ~made.parts.wall]).all()


def test_the_record_says_what_was_made_from_what(made: Segmentation) -> None:
    record = json.loads((made.folder / STATE).read_text())
    assert set(record["images"]) >= set(IMAGES)
    assert record["provenance"]["lungaccess"]
    assert len(next(iter(record["provenance"]["given_files"].values()))) == 64


def test_nothing_is_done_twice(patient: Phantom, made: Segmentation, copy: Path) -> None:
    before = {path.name: path.stat().st_mtime_ns for path in copy.glob("*.nii.gz")}
    again = _again(patient, made, copy)
    assert again.recomputed == ()
    assert {path.name: path.stat().st_mtime_ns for path in copy.glob("*.nii.gz")} == before
    for name in ("left", "lumen", "all_vessels", "cost"):
        assert (getattr(again.parts, name) == getattr(made.parts, name)).all()


def test_the_same_ct_gives_the_same_images(patient: Phantom, made: Segmentation, tmp_path: Path) -> None:
    assert _voxels(_again(patient, made, tmp_path / "other").folder) == _voxels(made.folder)


def _cut_airway(made: Segmentation) -> np.ndarray:
    """The airway without its lowest part, as a person would erase a leak."""
    lumen = np.array(made.parts.lumen)
    lumen[:, :, : int(np.quantile(np.argwhere(lumen)[:, 2], 0.1))] = False
    return lumen


def test_a_corrected_mask_is_kept_and_only_what_follows_is_done_again(
    patient: Phantom, made: Segmentation, copy: Path
) -> None:
    cut = _cut_airway(made)
    write_volume(copy / "airway.nii.gz", Volume(grid=made.grid, array=cut))
    again = _again(patient, made, copy)
    assert again.corrected == ("airway",)
    assert again.recomputed == ("airway", "vessels", "lobes", "cost map")
    assert (again.parts.lumen == cut).all()
    assert (load_patient(copy).lumen.array == cut).all()
    assert np.isfinite(again.parts.cost[made.parts.lumen & ~cut & made.parts.left]).any()
    settled = _again(patient, made, copy)
    assert settled.recomputed == ()
    assert settled.corrected == ("airway",)


def test_taking_a_correction_back_restores_what_was_made(
    patient: Phantom, made: Segmentation, copy: Path
) -> None:
    write_volume(copy / "airway.nii.gz", Volume(grid=made.grid, array=_cut_airway(made)))
    _again(patient, made, copy)
    (copy / FOLDER / "airway.nii.gz").unlink()
    restored = _again(patient, made, copy)
    assert restored.corrected == ()
    assert _voxels(copy) == _voxels(made.folder)


def test_a_segmentation_of_slicer_over_a_part_of_the_image_is_taken(
    patient: Phantom, made: Segmentation, copy: Path
) -> None:
    lungs = made.parts.left * np.uint8(2) + made.parts.right * np.uint8(1)
    lungs[:, :, -60:] = 0
    low, high = (5, 5, 0), tuple(n - 5 for n in lungs.shape)
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    part = Volume(grid=made.grid.crop(low, high), array=lungs[box].copy())
    write_volume(copy / "lungs.seg.nrrd", part)
    again = _again(patient, made, copy)
    assert again.corrected == ("lungs",)
    assert again.recomputed == ("lungs", "airway", "vessels", "lobes", "cost map")
    assert not (copy / "lungs.seg.nrrd").exists()
    assert not (again.parts.left | again.parts.right)[:, :, -50:].any()


def test_a_correction_on_other_voxels_is_refused(patient: Phantom, made: Segmentation, copy: Path) -> None:
    grid = Grid.from_spacing((20, 20, 20), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    write_volume(copy / "airway.nrrd", Volume(grid=grid, array=np.ones(grid.shape, dtype=bool)))
    with pytest.raises(GridMismatchError, match="not those of the CT"):
        _again(patient, made, copy)


def test_corrections_of_another_ct_are_not_used(patient: Phantom, made: Segmentation, copy: Path) -> None:
    other = Volume(grid=patient.ct.grid, array=np.asarray(patient.ct.array) + np.int16(1))
    request = SegmentationRequest(ct=other, out=copy, voxel_mm=VOXEL_MM)
    SegmentationFolder(copy, made.grid, "another")  # without corrections, another CT may be segmented into it
    write_volume(copy / "airway.nii.gz", Volume(grid=made.grid, array=_cut_airway(made)))
    with pytest.raises(AnatomyError, match="another CT.*airway"):
        segment(request)


class _Killed(BaseException):
    """Stands for kill -9: nothing catches it."""


def killed(request: SegmentationRequest, monkeypatch: pytest.MonkeyPatch, moment: int) -> None:
    """Segment, and end without a word where the file of that number takes its place."""
    replace, calls = os.replace, []

    def killing(source: Any, target: Any) -> None:
        calls.append(target)
        if len(calls) == moment:
            raise _Killed
        replace(source, target)

    with monkeypatch.context() as patched, pytest.raises(_Killed):
        patched.setattr(os, "replace", killing)
        segment(request)
    (request.out / ".0123456789ab-cost.nii.gz").write_bytes(b"half")


def require_made_good(patient: Phantom, made: Segmentation, folder: Path) -> None:
    """Segment again into a folder where a run was killed; it then holds what a run to the end makes."""
    assert not (folder / "patient.toml").exists()
    again = _again(patient, made, folder)
    assert again.corrected == ()
    assert _voxels(folder) == _voxels(made.folder)
    assert not list(folder.glob(f".{'[0-9a-f]' * 12}*"))


@pytest.mark.parametrize("moment", [2, 3])
def test_a_run_that_is_killed_in_its_last_steps_leaves_no_patient_and_is_made_good(
    patient: Phantom, made: Segmentation, copy: Path, monkeypatch: pytest.MonkeyPatch, moment: int
) -> None:
    """The first file to take its place is the description, which is set aside."""
    (copy / "lobes.nii.gz").unlink()
    killed(_same_request(patient, made, copy), monkeypatch, moment)
    require_made_good(patient, made, copy)


@pytest.mark.parametrize("moment", [1, 2, 3, 6, 9, 14, 20])
def test_a_killed_run_leaves_no_patient_and_is_made_good(
    patient: Phantom, made: Segmentation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moment: int
) -> None:
    killed(_same_request(patient, made, tmp_path / "patient"), monkeypatch, moment)
    require_made_good(patient, made, tmp_path / "patient")


def test_an_edited_description_is_kept(patient: Phantom, made: Segmentation, copy: Path) -> None:
    description = copy / "patient.toml"
    edited = description.read_text().replace('name = "P"', 'name = "Patient A"')
    description.write_text(edited)
    write_volume(copy / "lobes.nii.gz", Volume(grid=made.grid, array=made.parts.lobes * made.parts.left))
    again = _again(patient, made, copy)
    assert again.kept_description
    assert description.read_text() == edited
    assert not _again(patient, made, made.folder).kept_description


def test_a_point_outside_the_lung_is_warned_of(patient: Phantom, copy: Path, made: Segmentation) -> None:
    heart = made.grid.lps(np.argwhere(patient.labels.array == LABELS["heart"]).mean(axis=0))
    point = ",".join(f"{x:.2f}" for x in heart)
    result = segment(_request(patient, copy, target=f"lps:{point}"))
    assert any("outside the lungs" in warning for warning in result.warnings)
    assert load_patient(copy).targets_lps[0] == pytest.approx(heart, abs=0.01)
    far = segment(_request(patient, copy, target="lps:9000,0,0"))
    assert any("outside the image" in warning for warning in far.warnings)


def test_masks_of_other_programs_replace_steps(patient: Phantom, made: Segmentation, tmp_path: Path) -> None:
    folder = tmp_path / "totalsegmentator"
    folder.mkdir()
    truth = patient.images
    assert truth.wall is not None
    x = np.indices(truth.lung.array.shape)[0] > truth.lung.array.shape[0] / 2
    lobes = patient.lobes.array * (truth.lung.array & ~truth.lumen.array)
    parts = {
        "lung_airways": truth.lumen.array,
        "lung_airways_wall": truth.wall.array,
        "lung_arteries": truth.vessels.array & x,
        "lung_veins": truth.vessels.array & ~x,
        "lung_upper_lobe_left": lobes == LEFT_UPPER,
        "lung_lower_lobe_left": lobes == LEFT_LOWER,
        "lung_lower_lobe_right": (lobes > 0) & (lobes < LEFT_UPPER),
    }
    for name, mask in parts.items():
        write_volume(folder / f"{name}.nii.gz", Volume(grid=patient.grid, array=mask))
    result = segment(_request(patient, tmp_path / "out", totalsegmentator=folder))
    assert (result.parts.lumen == _in_box(patient, result, truth.lumen.array)).all()
    assert (result.parts.large_vessels == _in_box(patient, result, truth.vessels.array)).all()
    lung = _in_box(patient, result, truth.lung.array)
    both = np.count_nonzero((result.parts.left | result.parts.right) & lung)
    assert both > 0.95 * np.count_nonzero(truth.lung.array)
    found = _in_box(patient, result, lobes)
    assert (result.parts.lobes == np.where((found > 0) & (found < LEFT_UPPER), RIGHT_LOWER, found)).all()
    border = _in_box(patient, result, patient.mask("fissure")) & (found >= LEFT_UPPER)
    assert (result.parts.fissures[border] == SEEN).mean() > 0.8
    assert set(result.from_elsewhere) == {"airway", "airway_wall", "vessels", "lungs", "lobes"}
    images = load_patient(tmp_path / "out")
    assert images.lobes is not None and images.fissures is not None
    assert any("took the place" in said and "lung_airways" in said for said in images.warnings)
    wrong = truth.lumen.array[:, :, ::-1]
    write_volume(folder / "lung_airways.nii.gz", Volume(grid=patient.grid, array=np.roll(wrong, 6, axis=0)))
    with pytest.raises(RefusedError, match="mask of the airway is not of this CT.*--accept"):
        segment(_request(patient, tmp_path / "out", totalsegmentator=folder))
    assert not (tmp_path / "out" / "patient.toml").exists()
    with pytest.raises(FileError, match="holds no lobes"):
        segment(_request(patient, tmp_path / "out", totalsegmentator=tmp_path))


def test_thick_slices_are_marked(patient: Phantom, tmp_path: Path) -> None:
    step = 4
    matrix = patient.ct.grid.lps_from_ijk.copy()
    matrix[:3, 2] *= step
    hu = np.stack(
        [patient.ct.array[:, :, k : k + step].mean(axis=2) for k in range(0, patient.ct.grid.shape[2], step)],
        axis=2,
    )
    grid = Grid(shape=hu.shape, lps_from_ijk=matrix)
    ct = Volume(grid=grid, array=hu.astype(np.int16))
    with pytest.raises(AnatomyError, match="5.0 mm apart"):
        segment(SegmentationRequest(ct=ct, out=tmp_path))
    assert not (tmp_path / "patient.toml").exists()
    segment(SegmentationRequest(ct=ct, out=tmp_path, thick_slices=True, voxel_mm=VOXEL_MM))
    assert any("5.0 mm apart" in warning for warning in load_patient(tmp_path).warnings)


def test_quality_counts_ends_and_volumes(patient: Phantom, made: Segmentation) -> None:
    quality = quality_of(made.parts)
    assert quality.tree is not None
    assert quality.ends == np.count_nonzero(
        [not len(quality.tree.children(b)) for b in range(quality.tree.n_branches)]
    )
    litres = np.count_nonzero(made.parts.right) * made.grid.voxel_volume_mm3 * 1e-6
    assert quality.volumes_l["right lung"] == pytest.approx(litres)
    assert json.loads(json.dumps(quality.to_mapping()))["airway"]["ends"] == quality.ends


def test_a_file_that_is_no_image_is_refused(tmp_path: Path) -> None:
    (tmp_path / "slice.dcm").write_bytes(b"x")
    with pytest.raises(FileError, match="folder"):
        read_ct(tmp_path / "slice.dcm")
    with pytest.raises(FileError):
        read_ct(tmp_path / "missing.nii.gz")


def test_what_cannot_be_a_patient_leaves_none_and_is_accepted_by_name(
    patient: Phantom, made: Segmentation, copy: Path
) -> None:
    alone = made.parts.left * np.uint8(2)
    write_volume(copy / "lungs.nii.gz", Volume(grid=made.grid, array=alone))
    request = _request(patient, copy, nodule_mask=made.folder.parent / "given-nodule.nii.gz")
    with pytest.raises(RefusedError, match="no right lung.*--accept one-lung") as refused:
        segment(request)
    assert not (copy / "patient.toml").exists()
    assert refused.value.parts.left.any() and not refused.value.parts.right.any()
    segment(replace(request, accept=("one-lung",)))
    assert 'accepted = ["one-lung"]' in (copy / "patient.toml").read_text()
    assert any("one-lung" in warning for warning in load_patient(copy).warnings)
    with pytest.raises(RefusedError):
        segment(request)
    assert not (copy / "patient.toml").exists()
    with pytest.raises(SettingsError, match="one-lungs.*no check"):
        segment(replace(request, accept=("one-lungs",)))


@pytest.mark.parametrize(
    ("order", "flips"),
    [
        pytest.param((0, 1, 2), (0, 1), id="180 degrees about the body"),
        pytest.param((1, 0, 2), (0,), id="90 degrees about the body"),
        pytest.param((0, 2, 1), (), id="coronal slices"),
        pytest.param((2, 0, 1), (1, 2), id="sagittal slices, head first"),
    ],
)
def test_how_the_voxels_are_stored_does_not_matter(
    patient: Phantom, made: Segmentation, tmp_path: Path, order: tuple[int, ...], flips: tuple[int, ...]
) -> None:
    """Masks, lobes, cost map and tree are the same, if the header says how the image is turned."""
    stored = turned(phantom_image(patient), order, flips, header=True).ct
    nodule = made.folder.parent / "given-nodule.nii.gz"
    again = segment(replace(_request(patient, tmp_path, nodule_mask=nodule), ct=stored))
    assert _voxels(again.folder) == _voxels(made.folder)
    assert again.grid.is_close(made.grid)
    assert isinstance(again.parts.tree, AirwayTree) and isinstance(made.parts.tree, AirwayTree)
    for name in ("branch_parent", "generation", "branch_start"):
        np.testing.assert_array_equal(getattr(again.parts.tree, name), getattr(made.parts.tree, name))
    np.testing.assert_allclose(again.parts.tree.points_lps, made.parts.tree.points_lps, atol=1e-9)
