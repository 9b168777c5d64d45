"""A plan and its anatomy as DICOM, for a hospital's systems: segments, a structured report and a picture.

The segments are a Segmentation object (DICOM PS3.3, A.51), the report is one of measurements (TID 1500 of
PS3.16), the picture is a Secondary Capture; all belong to the study and the frame of reference of the CT.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.base.errors import FileError, SettingsError
from anatomy.base.files import atomic_write, require_writable_folder
from anatomy.base.typed import Mask
from anatomy.io.dicom import series_headers
from anatomy.io.dicom_seg import CODES, OWN, highdicom, uid_of
from anatomy.lung import Lung
from lungaccess.judging.appraisal import Appraisal
from lungaccess.plans.plan import Plan
from lungaccess.plans.version import software_version
from lungaccess.showing.report.html.volumes import CtFile
from lungaccess.showing.slicer.models import SEGMENTS, Segment

SEGMENTS_FILE, REPORT_FILE, PICTURE_FILE = "segments.dcm", "report.dcm", "overview.dcm"
MAKER = "lungaccess"
IDENTIFYING = ("PatientName", "PatientID", "PatientBirthDate", "PatientSex", "AccessionNumber", "StudyID",
               "ReferringPhysicianName", "StudyDate", "StudyTime")  # fmt: skip
"""These attributes of patient and study are copied from the CT, or left empty."""
AIR_HU, AIR_SHARE, LOOKED_AT = -500.0, 0.8, 5000
"""The lumen of an airway is air: of so many of its voxels at least this share is below that density in the
CT of the patient.  In a mirrored or foreign CT it is lung and soft tissue too."""


def export_dicom(
    plan: Plan,
    lung: Lung,
    folder: str | Path,
    ct: CtFile | None,
    appraisal: Appraisal,
    *,
    anonymise: bool = False,
) -> tuple[str, ...]:
    """Write segments, report and overview of a plan beside the CT it belongs to; return the files' names.

    Args:
        ct: The DICOM series that the masks show; without one, nothing can be written.
        anonymise: Whether name, identity, dates and physicians of the CT are left empty.

    Raises:
        FileError: If the series cannot be read, lacks the study or frame it belongs to, shows another
            patient, or the folder cannot be written.
        SettingsError: If the CT is no folder, or the extra `dicom` is not installed.
    """
    hd = highdicom()
    if ct is None or not ct.path.is_dir():
        raise SettingsError(
            "The patient came without a CT" if ct is None else f"{ct.path} is no folder of DICOM slices",
            expected="the series to whose study the files are to belong",
            remedy="Give the folder of the series with --ct",
        )
    plan.require_lung(lung)
    _require_same_patient(lung, ct)
    sources = _sources(ct, anonymise=anonymise)
    target = require_writable_folder(folder)
    first = sources[0]

    def uid(what: str) -> str:
        """Return a UID that follows from plan, series and use, so that the same files are written again."""
        return uid_of(plan.digest, str(first.SeriesInstanceUID), what, str(anonymise))

    # The title of the picture says what reports call the patient.
    shown = replace(plan, patient_name="this patient") if anonymise else plan
    common = {"manufacturer": MAKER, "instance_number": 1}
    segments = hd.seg.Segmentation(
        sources, *_segments(lung, str(first.FrameOfReferenceUID)), series_instance_uid=uid("segments"),
        series_number=_number(first, 1), sop_instance_uid=uid("segment object"), content_label="ANATOMY",
        manufacturer_model_name=MAKER, software_versions=software_version(), device_serial_number="0",
        omit_empty_frames=True, **common,
    )  # fmt: skip
    written: dict[str, Any] = {
        SEGMENTS_FILE: segments,
        REPORT_FILE: hd.sr.Comprehensive3DSR(
            [*sources, segments], _report(plan, appraisal, first, uid), uid("report"), _number(first, 2),
            uid("report object"), is_complete=True, **common,
        ),
        PICTURE_FILE: hd.sc.SCImage.from_ref_dataset(
            first, _picture(shown, lung, appraisal), "RGB", 8, "PATIENT", uid("picture"), _number(first, 3),
            uid("picture object"), patient_orientation=("L", "P"), **common,
        ),
    }  # fmt: skip
    for name, dataset in written.items():
        with atomic_write(target / name) as temporary:
            dataset.save_as(temporary, enforce_file_format=True)
    return tuple(written)


def _number(first: Any, further: int) -> int:
    return 9000 + further + 10 * (int(first.get("SeriesNumber") or 0) % 100)


def _sources(ct: CtFile, *, anonymise: bool) -> list[Any]:
    """Return the headers of the slices, without what identifies the patient if that is asked for."""
    headers = series_headers(ct.path, ct.series)
    for header in headers:
        for name in ("StudyInstanceUID", "FrameOfReferenceUID"):
            if not header.get(name):
                raise FileError(
                    f"A slice of {ct.path} states no {name}",
                    expected="slices that say to which study and frame they belong",
                    remedy="Export the series again from the archive",
                )
        for name in IDENTIFYING:
            if anonymise or name not in header:
                setattr(header, name, "")
    return headers


def _require_same_patient(lung: Lung, ct: CtFile) -> None:
    """Raise FileError unless the lumen is air in the CT."""
    volume = ct.read()
    voxels = np.argwhere(lung.mask("lumen").array)
    some = lung.grid.lps(voxels[:: max(1, len(voxels) // LOOKED_AT)])
    air = float((volume.at(some, beyond=0.0) < AIR_HU).mean())
    if not air >= AIR_SHARE:
        raise FileError(
            f"Of the airway's lumen {100 * air:.0f} % is air in the CT of {ct.path}",
            expected=f"the CT that the masks show, in which at least {100 * AIR_SHARE:.0f} % is",
            remedy="Give the series from which the masks were made; a mirrored or moved copy is another one",
        )


def _segments(lung: Lung, frame: str) -> tuple[Any, str, list[Any]]:
    """Return the voxels of the structures that a lung has, the type, and the descriptions of the segments."""
    hd = highdicom()
    masks = {each.name: _mask(lung, each) for each in SEGMENTS}
    present = [each for each in SEGMENTS if masks[each.name].any()]
    array = np.stack([np.swapaxes(masks[each.name], 0, 2) for each in present], axis=-1)
    affine = lung.grid.lps_from_ijk[:, [2, 1, 0, 3]]
    category = hd.sr.CodedConcept("123037004", "SCT", "Anatomical structure")
    algorithm = hd.AlgorithmIdentificationSequence(
        name=MAKER,
        family=hd.sr.CodedConcept("123104", "DCM", "Morphological Operations"),
        version=software_version(),
    )
    described = [
        hd.seg.SegmentDescription(
            number, each.name, category, hd.sr.CodedConcept(*CODES[each.role]), "SEMIAUTOMATIC",
            algorithm,
            display_color=hd.color.CIELabColor.from_rgb(*(round(255 * part) for part in each.colour)),
        )
        for number, each in enumerate(present, start=1)
    ]  # fmt: skip
    volume = hd.Volume(
        array=array.astype(np.uint8), affine=affine, coordinate_system="PATIENT",
        frame_of_reference_uid=frame,
        channels={"SegmentNumber": list(range(1, len(present) + 1))},
    )  # fmt: skip
    return volume, "BINARY", described


def _mask(lung: Lung, segment: Segment) -> Mask:
    """Return the voxels of a segment, none where the lung has no such structure."""
    if segment.mask == "nodule" and lung.nodules is None:
        return np.zeros(lung.grid.shape, dtype=np.bool_)
    mask = lung.mask(segment.mask).array
    if segment.mask == "outside":
        return ~mask
    return mask & ~lung.mask("lumen").array if segment.mask == "airway" else mask


def _report(plan: Plan, appraisal: Appraisal, first: Any, uid: Callable[[str], str]) -> Any:
    """Return the content of the report: places, paths, clearances, chance and verdict of the plan."""
    sr, headline = highdicom().sr, appraisal.headline
    frame = str(first.FrameOfReferenceUID)

    def own(value: str, meaning: str) -> Any:
        return sr.CodedConcept(value, OWN, meaning)

    def measured(
        code: str, meaning: str, value: float, unit: str = "mm", graphic: str = "", at: Any = None
    ) -> Any:
        seen = [sr.CoordinatesForMeasurement3D(graphic, at, frame_of_reference_uid=frame)] if graphic else []
        units = sr.CodedConcept(unit, "UCUM", "percent" if unit == "%" else "millimeter")
        return sr.Measurement(own(code, meaning), round(value, 4), units, referenced_coordinates=seen or None)

    scope_tip = plan.scope.lps_from_scope_tip[:3, 3]
    found = [
        measured(
            f"{curve.name.upper()}_LENGTH", f"Length of the {curve.name}", float(curve.arc_length_mm[-1]),
            graphic="POLYLINE", at=curve.points_lps,
        )
        for curve in plan.shown_curves(1.0)
    ]  # fmt: skip
    places = (
        ("TARGET", "Target", plan.target_lps),
        ("EXIT", "Exit through the wall", plan.tube.exit.point_lps),
    )
    for code, meaning, point in places:
        away_mm = float(np.linalg.norm(point - scope_tip))
        words = f"{meaning}, distance from the scope's tip"
        found.append(measured(f"{code}_FROM_SCOPE", words, away_mm, graphic="POINT", at=np.atleast_2d(point)))
    for device, clearances in plan.clearance_mm.items():
        for structure, value in clearances.items():
            if np.isfinite(value):
                words = f"Distance of the {device}'s axis from the {structure}"
                found.append(measured(f"{device.upper()}_TO_{structure.upper()}", words, value))
    if headline.success is not None:
        found.append(measured("SUCCESS", "Chance of success", 100.0 * headline.success.value, "%"))
    evaluations = {"Independent check": headline.geometry.value, "Verdict": headline.verdict}
    group = sr.MeasurementsAndQualitativeEvaluations(
        sr.TrackingIdentifier(uid("group"), f"plan {plan.digest[:12]}"),
        finding_type=own("PLAN", "Plan of access to a lung nodule"),
        measurements=found,
        qualitative_evaluations=[
            sr.QualitativeEvaluation(own(name.upper().replace(" ", "_"), name), own("WORDS", words))
            for name, words in evaluations.items()
        ],
    )
    device = sr.DeviceObserverIdentifyingAttributes(uid("device"), name=MAKER, model_name=software_version())
    observer = sr.ObserverContext(sr.CodedConcept("121007", "DCM", "Device"), device)
    return sr.MeasurementReport(
        sr.ObservationContext(observer_device_context=observer),
        sr.CodedConcept("25045-6", "LN", "CT unspecified body region"),
        [group],
        sr.CodedConcept("126000", "DCM", "Imaging Measurement Report"),
    )


def _picture(plan: Plan, lung: Lung, appraisal: Appraisal) -> Any:
    """Return the overview as `(rows, columns, 3)` uint8."""
    from PIL import Image

    from lungaccess.showing.report import overview_png

    with tempfile.TemporaryDirectory() as folder:
        path = overview_png(plan, lung, Path(folder) / "overview.png", appraisal)
        return np.asarray(Image.open(path).convert("RGB"))
