"""Plans and masks as DICOM: others read back what was written, and another patient's CT is refused."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
import pytest

from anatomy.base.errors import AnatomyError, FileError, SettingsError
from anatomy.grid import Volume
from anatomy.io.images import read_labels, read_mask
from anatomy.lung import Lung
from anatomy.phantom import Phantom
from anatomy.segmentation.canonical import canonical
from lungaccess.judging.appraisal import Appraisal, appraise
from lungaccess.plans.plan import Plan
from lungaccess.showing.dicom_files import export_dicom
from lungaccess.showing.report.html.volumes import CtFile
from tests.anatomy.io.series import write_series

hd: Any = pytest.importorskip("highdicom")
PATIENT = {
    "StudyInstanceUID": "1.2.3",
    "FrameOfReferenceUID": "1.2.4",
    "PatientName": "Doe^Jane",
    "PatientID": "77",
}


@pytest.fixture(scope="module")
def ct(small_phantom: Phantom, tmp_path_factory: pytest.TempPathFactory) -> CtFile:
    folder = tmp_path_factory.mktemp("series")
    write_series(folder, small_phantom.ct, **PATIENT)
    return CtFile(path=folder)


@pytest.fixture(scope="module")
def appraisal(small_lung: Lung, small_plan: Plan) -> Appraisal:
    return appraise(small_plan, small_lung)


@pytest.fixture(scope="module")
def folder(
    small_lung: Lung,
    small_plan: Plan,
    ct: CtFile,
    appraisal: Appraisal,
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    made = tmp_path_factory.mktemp("dicom")
    export_dicom(small_plan, small_lung, made, ct, appraisal)
    return made


def test_segments_are_read_back_as_the_masks_they_were(folder: Path, small_lung: Lung) -> None:
    path = folder / "segments.dcm"
    numbers = {name: number for number, name in read_labels(path).items()}
    lumen = small_lung.mask("lumen").array
    masks = {
        "airway lumen": lumen,
        "vessel": small_lung.mask("vessel").array,
        "airway wall": small_lung.mask("airway").array & ~lumen,
    }
    for name, mask in masks.items():
        found = canonical(read_mask(path, labels=(numbers[name],)))
        whole = np.zeros(small_lung.grid.shape, dtype=bool)
        start = np.rint(small_lung.grid.ijk(found.grid.lps([0.0, 0.0, 0.0]))).astype(int)
        np.testing.assert_allclose(small_lung.grid.lps(start), found.grid.lps([0.0, 0.0, 0.0]), atol=1e-3)
        box = tuple(slice(n, n + size) for n, size in zip(start, found.array.shape, strict=True))
        whole[box] = found.array
        np.testing.assert_array_equal(whole, mask)
    by_code = read_mask(path, role="vessels")
    np.testing.assert_array_equal(by_code.array, read_mask(path, labels=(numbers["vessel"],)).array)


def test_another_program_reads_the_same_segments_and_report(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("dcmqi")
    path = folder / "segments.dcm"
    _run("segimage2itkimage", "--inputDICOM", path, "--outputDirectory", tmp_path, "-t", "nii")
    names = read_labels(path)
    for number in names:
        peer, ours = read_mask(tmp_path / f"{number}.nii.gz"), read_mask(path, labels=(number,))
        assert canonical(peer).grid.is_close(canonical(ours).grid, 1e-3)
        np.testing.assert_array_equal(canonical(peer).array, canonical(ours).array)
    report = tmp_path / "report.json"
    _run("tid1500reader", "--inputDICOM", folder / "report.dcm", "--outputMetadata", report)
    items = json.loads(report.read_text())["Measurements"][0]["measurementItems"]
    assert "Chance of success" in {each["quantity"]["CodeMeaning"] for each in items}


def _run(program: str, *words: object) -> None:
    subprocess.run([str(Path(sys.executable).with_name(program)), *map(str, words)], check=True)


def test_contours_are_filled(tmp_path: Path) -> None:
    """A ring of 20 and 8 mm on seven slices: as large as its area says, and nodule by its code."""
    angles = np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    heights = np.arange(-6.0, 7.0, 2.0)
    contours = [
        np.column_stack([radius * circle + [40.0, -30.0], np.full(200, z)])
        for z in heights
        for radius in (20.0, 8.0)
    ]
    path = tmp_path / "structures.dcm"
    write_contours(path, {"GTV": contours}, code="27925004")
    mask = read_mask(path, role="nodules")
    volume = np.count_nonzero(mask.array) * mask.grid.voxel_volume_mm3
    assert volume == pytest.approx(np.pi * (20.0**2 - 8.0**2) * 14.0, rel=0.01)
    centre = mask.grid.lps(np.argwhere(mask.array)).mean(axis=0)
    np.testing.assert_allclose(centre, [40.0, -30.0, 0.0], atol=0.1)
    assert read_labels(path) == {1: "GTV"}


def write_contours(path: Path, regions: dict[str, list[np.ndarray]], code: str) -> None:
    found = pydicom.Dataset()
    found.file_meta = pydicom.dataset.FileMetaDataset()
    found.file_meta.TransferSyntaxUID = pydicom.uid.ExplicitVRLittleEndian
    found.file_meta.MediaStorageSOPClassUID = found.SOPClassUID = pydicom.uid.RTStructureSetStorage
    found.file_meta.MediaStorageSOPInstanceUID = found.SOPInstanceUID = "1.2.9"
    found.StructureSetROISequence, found.ROIContourSequence, found.RTROIObservationsSequence = [], [], []
    for number, (name, contours) in enumerate(regions.items(), start=1):
        region, drawn, seen, meant = (pydicom.Dataset() for _ in range(4))
        region.ROINumber, region.ROIName = number, name
        drawn.ReferencedROINumber = seen.ReferencedROINumber = number
        drawn.ContourSequence = []
        for points in contours:
            contour = pydicom.Dataset()
            contour.ContourGeometricType, contour.NumberOfContourPoints = "CLOSED_PLANAR", len(points)
            contour.ContourData = [f"{value:.4f}" for value in points.ravel()]
            drawn.ContourSequence.append(contour)
        meant.CodeValue, meant.CodingSchemeDesignator, meant.CodeMeaning = code, "SCT", "Nodule"
        seen.RTROIIdentificationCodeSequence = [meant]
        found.StructureSetROISequence.append(region)
        found.ROIContourSequence.append(drawn)
        found.RTROIObservationsSequence.append(seen)
    found.save_as(path, enforce_file_format=True)


def test_several_segments_without_a_name_are_no_mask(folder: Path) -> None:
    with pytest.raises(AnatomyError, match="has the segments 1 lung tissue"):
        read_mask(folder / "segments.dcm")


def test_the_report_states_places_paths_and_verdict(
    folder: Path, small_plan: Plan, appraisal: Appraisal
) -> None:
    report = hd.sr.srread(folder / "report.dcm")
    assert isinstance(report, hd.sr.Comprehensive3DSR)
    text = str(report)
    assert appraisal.headline.verdict in text and appraisal.headline.geometry.value in text
    stated = _graphics(report)
    for points in (small_plan.target_lps[None], *(c.points_lps for c in small_plan.curves(1.0).present)):
        same = [each for each in stated if each.size == points.size]
        assert any(np.abs(each.reshape(-1, 3) - points).max() < 1e-3 for each in same)


def _graphics(dataset: pydicom.Dataset) -> list[np.ndarray]:
    found = []
    for element in dataset.iterall():
        if element.keyword == "GraphicData":
            found.append(np.array(element.value, dtype=np.float64))
    return found


def test_files_belong_to_the_study_and_are_the_same_again(
    folder: Path, small_lung: Lung, small_plan: Plan, ct: CtFile, appraisal: Appraisal, tmp_path: Path
) -> None:
    again = tmp_path / "again"
    names = export_dicom(small_plan, small_lung, again, ct, appraisal)
    for name in names:
        first, second = pydicom.dcmread(folder / name), pydicom.dcmread(again / name)
        assert first.StudyInstanceUID == "1.2.3" and first.PatientName == "Doe^Jane"
        assert first.SOPInstanceUID == second.SOPInstanceUID
    hidden = tmp_path / "hidden"
    for name in export_dicom(small_plan, small_lung, hidden, ct, appraisal, anonymise=True):
        found = pydicom.dcmread(hidden / name)
        assert not found.PatientName and not found.PatientID
        assert b"Doe" not in (hidden / name).read_bytes()


def test_a_mirrored_ct_is_refused(
    small_phantom: Phantom, small_lung: Lung, small_plan: Plan, appraisal: Appraisal, tmp_path: Path
) -> None:
    mirrored = Volume(grid=small_phantom.ct.grid, array=small_phantom.ct.array[::-1])
    write_series(tmp_path / "series", mirrored, **PATIENT)
    with pytest.raises(FileError, match="is air in the CT"):
        export_dicom(small_plan, small_lung, tmp_path / "out", CtFile(path=tmp_path / "series"), appraisal)


def test_a_plan_without_a_series_is_not_written(
    small_lung: Lung, small_plan: Plan, appraisal: Appraisal, tmp_path: Path
) -> None:
    with pytest.raises(SettingsError, match="without a CT"):
        export_dicom(small_plan, small_lung, tmp_path, None, appraisal)


def test_a_ct_slice_is_no_mask(ct: CtFile) -> None:
    with pytest.raises(FileError, match="Segmentation object"):
        read_mask(next(ct.path.glob("*.dcm")))
