"""`lungaccess segment`: a CT in, a patient folder out; bad input is explained."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pydicom
import pytest

from anatomy.grid import Grid, Volume
from anatomy.io import load_patient, read_volume
from anatomy.io.images import write_volume
from anatomy.phantom import Phantom
from anatomy.segmentation.vessels import LARGE_RADIUS_MM, border_mm
from lungaccess.cli import app as cli
from lungaccess.cli.exit_code import ExitCode
from lungaccess.showing.report.html.volumes import find_ct
from tests.anatomy.io.series import write_series

AS_IT_IS = ("--voxel-mm", "1.25")
"""The voxels of the patient: nothing is interpolated, which takes time."""
PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(scope="module")
def ct_file(small_phantom: Phantom, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("ct") / "ct.nii.gz"
    write_volume(path, small_phantom.ct)
    return path


def _one_line(text: str) -> str:
    return " ".join(text.replace("│", " ").split())


def _refused(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert cli.main(["segment", *words]) == ExitCode.BAD_INPUT
    shown = capsys.readouterr().err
    assert "Traceback" not in shown
    return _one_line(shown)


@pytest.mark.slow
def test_a_ct_becomes_a_patient_that_info_reads(
    ct_file: Path, small_phantom: Phantom, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "patient"
    centre = ",".join(f"{x:.2f}" for x in small_phantom.nodules[0].centre_lps)
    assert (
        cli.main(["segment", str(ct_file), "--out", str(out), "--target", f"lps:{centre}", *AS_IT_IS])
        == ExitCode.OK
    )
    shown = capsys.readouterr().out
    assert "right lung" in shown
    assert "ends" in shown
    assert (out / "segmentation.png").read_bytes().startswith(PNG)
    shown_later = find_ct(out)
    assert shown_later is not None and shown_later.path.resolve() == ct_file.resolve()
    assert shown_later.read().grid.is_close(small_phantom.ct.grid)
    quality = json.loads((out / "quality.json").read_text())
    truth_l = np.count_nonzero(small_phantom.images.lung.array) * small_phantom.grid.voxel_volume_mm3 * 1e-6
    both = quality["volumes_l"]["right lung"] + quality["volumes_l"]["left lung"]
    assert both == pytest.approx(truth_l, rel=0.03)
    assert quality["airway"]["ends"] >= 10
    assert len(load_patient(out).targets_lps) == 1
    assert "large_radius_mm = 2.828\n" in (out / "patient.toml").read_text()
    stated = border_mm(LARGE_RADIUS_MM, float(small_phantom.grid.spacing_mm[2]))
    assert load_patient(out).vessel_border_mm == pytest.approx(stated, abs=0.005)
    assert cli.main(["info", str(out), "--cache", str(tmp_path / "cache")]) == ExitCode.OK


@pytest.mark.slow
def test_the_second_run_says_that_nothing_was_to_do(
    ct_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["segment", str(ct_file), "--out", str(tmp_path / "patient"), "--no-pictures", *AS_IT_IS]
    assert cli.main(words) == ExitCode.OK
    capsys.readouterr()
    assert cli.main(words) == ExitCode.OK
    assert "all was up to date" in _one_line(capsys.readouterr().out)
    assert not (tmp_path / "patient" / "segmentation.png").exists()


def test_a_radius_that_no_scale_tells_is_refused(
    ct_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(ct_file), "--out", str(tmp_path / "patient"), "--large-radius-mm", "0.5"]
    assert "1 to 4 mm" in _refused(capsys, *words)


@pytest.mark.slow
def test_planning_on_thick_slices_must_be_allowed(
    small_phantom: Phantom, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    grid, step = small_phantom.ct.grid, 4
    hu = np.asarray(small_phantom.ct.array)
    blocks = [hu[:, :, k : k + step].mean(axis=2) for k in range(0, hu.shape[2], step)]
    matrix = grid.lps_from_ijk.copy()
    matrix[:3, 2] *= step
    thick = np.stack(blocks, axis=2).astype(np.int16)
    write_volume(
        tmp_path / "ct.nii.gz", Volume(grid=Grid(shape=thick.shape, lps_from_ijk=matrix), array=thick)
    )
    words = (str(tmp_path / "ct.nii.gz"), "--out", str(tmp_path / "patient"))
    assert "5.0 mm apart" in _refused(capsys, *words)
    assert cli.main(["segment", *words, "--thick-slices", "--no-pictures", *AS_IT_IS]) == ExitCode.OK
    capsys.readouterr()
    plan = ["plan", str(tmp_path / "patient"), "--target", "lps:50,0,0", "--iterations", "1"]
    plan += ["--out", str(tmp_path / "plan"), "--cache", str(tmp_path / "cache")]
    assert cli.main(plan) == ExitCode.BAD_INPUT
    assert "--thick-slices" in _one_line(capsys.readouterr().err)
    cli.main([*plan, "--thick-slices"])
    assert "slices 5.0 mm apart" not in _one_line(capsys.readouterr().err)


@pytest.mark.slow
def test_what_is_no_chest_ct_is_refused(
    ct_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ("--out", str(tmp_path / "patient"))
    stored = read_volume(ct_file)
    shifted = Volume(grid=stored.grid, array=stored.array + np.int16(1024))
    write_volume(tmp_path / "stored.nii.gz", shifted)
    assert "offset" in _refused(capsys, str(tmp_path / "stored.nii.gz"), *out)
    write_volume(tmp_path / "zero.nii.gz", Volume(grid=stored.grid, array=np.zeros_like(stored.array)))
    assert "Every voxel" in _refused(capsys, str(tmp_path / "zero.nii.gz"), *out)
    assert "no file" in _refused(capsys, str(tmp_path / "nothing.nii.gz"), *out)
    assert "ras:" in _refused(capsys, str(ct_file), *out, "--target", "1,2,3")
    data = ct_file.read_bytes()
    (tmp_path / "cut.nii.gz").write_bytes(data[: len(data) // 2])
    assert "damaged" in _refused(capsys, str(tmp_path / "cut.nii.gz"), *out)
    assert not (tmp_path / "patient" / "patient.toml").exists()


def _write_series(folder: Path, number: int = 1) -> list[Path]:
    """Write a small CT series, 12 slices of 16 x 16 pixels; return its files from slice to slice."""
    grid = Grid.from_spacing((16, 16, 12), (8.0, 8.0, 2.0), (0.0, 0.0, 0.0))
    array = np.broadcast_to(np.arange(12, dtype=np.int16) - 1000, grid.shape)
    write_series(folder, Volume(grid=grid, array=array), number)
    return [folder / f"{number}-{(k * 5) % 12}.dcm" for k in range(12)]


def _edit(path: Path, **changes: object) -> None:
    header = pydicom.dcmread(path)
    for key, value in changes.items():
        setattr(header, key, value)
    header.save_as(path)


def _miss_a_slice(paths: list[Path]) -> None:
    paths[5].unlink()


def _double_a_slice(paths: list[Path]) -> None:
    _edit(paths[5], ImagePositionPatient=[0.0, 0.0, 8.0])


def _tilt(paths: list[Path]) -> None:
    for k, path in enumerate(paths):
        _edit(path, ImagePositionPatient=[0.0, 0.5 * k, 2.0 * k])


def _truncate(paths: list[Path]) -> None:
    paths[5].write_bytes(paths[5].read_bytes()[:-200])


def _second_series(paths: list[Path]) -> None:
    _write_series(paths[0].parent, number=2)


def _other_modality(paths: list[Path]) -> None:
    for path in paths:
        _edit(path, Modality="MR")


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (_miss_a_slice, "misses slices between the heights 8.00 and 12.00 mm"),
        (_double_a_slice, "two slices at the height 8.00 mm"),
        (_tilt, "gantry tilted"),
        (_truncate, "cannot be read"),
        (_second_series, "2 series"),
        (_other_modality, "modality MR"),
    ],
)
def test_a_wrong_dicom_series_is_explained(
    damage: object, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = _write_series(tmp_path / "dicom")
    damage(paths)  # type: ignore[operator]
    assert words in _refused(capsys, str(tmp_path / "dicom"), "--out", str(tmp_path / "patient"))


def test_a_whole_dicom_series_is_read_and_then_judged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = _write_series(tmp_path / "dicom")
    shown = _refused(capsys, str(tmp_path / "dicom"), "--out", str(tmp_path / "patient"))
    assert "hardly any soft tissue" in shown  # 12 slices of air alone
    _second_series(paths)
    uid = str(pydicom.dcmread(paths[0]).SeriesInstanceUID)
    chosen = _refused(capsys, str(tmp_path / "dicom"), "--out", str(tmp_path / "patient"), "--series", uid)
    assert "hardly any soft tissue" in chosen


def test_a_folder_without_dicom_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    assert "no DICOM images" in _refused(capsys, str(tmp_path / "empty"), "--out", str(tmp_path / "out"))


@pytest.mark.data
@pytest.mark.slow
def test_a_real_scan_with_its_nodule(data_dir: Path, tmp_path: Path) -> None:
    folder, out = data_dir / "ct" / "lidc-0314", tmp_path / "patient"
    words = ["segment", str(folder / "ct.nii.gz"), "--out", str(out)]
    assert cli.main([*words, "--nodule-contours", str(folder / "nodule_contours.json")]) == ExitCode.OK
    quality = json.loads((out / "quality.json").read_text())
    assert quality["airway"]["ends"] >= 20
    images = load_patient(out)
    assert images.nodules is not None
    assert np.linalg.norm(images.targets_lps[0] - (-57, 131, -520)) < 5.0
    assert not (images.nodules.array & images.vessels.array).any()


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["aeropath", "atm"])
def test_a_case_of_a_data_set_becomes_a_patient_with_its_own_masks(
    small_phantom: Phantom, tmp_path: Path, capsys: pytest.CaptureFixture[str], layout: str
) -> None:
    images = small_phantom.images
    if layout == "aeropath":
        case, ct = tmp_path / "7", tmp_path / "7" / "7_CT_HR.nii.gz"
        airway, lungs = case / "7_CT_HR_label_airways.nii.gz", case / "7_CT_HR_label_lungs.nii.gz"
        case.mkdir()
        write_volume(lungs, images.lung)
    else:
        case = tmp_path / "labelsTr" / "ATM_007_0000.nii.gz"
        airway, ct = case, tmp_path / "imagesTr" / "ATM_007_0000.nii.gz"
        ct.parent.mkdir()
        airway.parent.mkdir()
    write_volume(ct, small_phantom.ct)
    write_volume(airway, images.lumen)
    assert cli.main(["info", str(case)]) == ExitCode.BAD_INPUT
    said = _one_line(capsys.readouterr().err)
    assert "there are no masks of vessels" in said and "lungaccess segment" in said
    out = tmp_path / "patient"
    words = ["segment", str(case), "--out", str(out), "--no-pictures", *AS_IT_IS]
    assert cli.main(words) == ExitCode.OK
    patient = load_patient(out)
    start = small_phantom.grid.voxels(patient.grid.lps([0.0, 0.0, 0.0]))
    box = tuple(slice(n, n + size) for n, size in zip(start, patient.grid.shape, strict=True))
    assert (patient.lumen.array == images.lumen.array[box]).all()
    truth = images.lung.array[box]
    assert np.count_nonzero(patient.lung.array & truth) > 0.9 * np.count_nonzero(truth)
    assert cli.main(["info", str(out), "--cache", str(tmp_path / "cache")]) == ExitCode.OK
