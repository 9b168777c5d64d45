"""CT series in DICOM as Hounsfield units on a grid in LPS, with every slice accounted for."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from anatomy.base.errors import FileError, FrameError
from anatomy.base.files import reading, reason
from anatomy.base.records import frozen_value
from anatomy.base.typed import Float, Float32
from anatomy.grid import Grid, Volume
from anatomy.io.image_header import image_shape, named_grid, require_directions, require_lengths

if TYPE_CHECKING:
    from pydicom.dataset import FileDataset

_SPACING_TOLERANCE_MM = 0.05
_HOUNSFIELD_TYPES = ("HU", "US", "", None)
"""The standard has HU where a CT states none; US, unspecified, is what many scanners write for HU."""
_GREY_KEYS = ("SamplesPerPixel", "PhotometricInterpretation")
_UNIFORM_KEYS = ("Rows", "Columns", "PixelSpacing", "RescaleSlope", "RescaleIntercept", *_GREY_KEYS)
_NEEDED_KEYS = ("ImagePositionPatient", "ImageOrientationPatient", *_UNIFORM_KEYS)
_SERIES_KEYS = (
    "RescaleType", "SeriesInstanceUID", "SeriesNumber", "SeriesDescription", "Modality", "NumberOfFrames",
    "PatientID",
)  # fmt: skip

MOST_NAMED = 5
"""Damaged files that a message names: the others lie beside them."""


@frozen_value
class SeriesInfo:
    """One series of a folder: what a person needs to choose it, and its files (unsorted).

    `slice_mm` is the mean distance of its slices, and 0 where they state no places; `middle` is the file of
    the slice in the middle; `patient` is the identifier of the patient, which is not for showing.
    """

    uid: str
    number: int | None
    description: str
    modality: str
    paths: tuple[Path, ...]
    slice_mm: float
    middle: Path
    patient: str

    @property
    def length_mm(self) -> float:
        """How much of the body it covers along its slices."""
        return self.slice_mm * (len(self.paths) - 1)

    def picture_hu(self) -> Float32:
        """Return the slice in the middle in HU, `(rows, columns)`.

        Raises FileError if it cannot be read, or holds no picture of grey values.
        """
        from pydicom import dcmread

        with _reading(self.middle):
            slice_ = dcmread(self.middle)
            _require_grey_values(slice_, str(self.middle))
            values = slice_.pixel_array * float(slice_.RescaleSlope) + float(slice_.RescaleIntercept)
            return np.asarray(values, dtype=np.float32)

    def describe(self) -> str:
        """Say what the series is in one line."""
        number = "-" if self.number is None else self.number
        return f"{self.uid} (number {number}, {self.modality}, {self.description!r}, {len(self.paths)} files)"


def list_series(folder: str | Path) -> tuple[SeriesInfo, ...]:
    """List the DICOM series of a folder and its subfolders, ordered by UID.

    Raises FileError if there is no folder, or no DICOM image in it.
    """
    by_uid, _ = _headers_by_series(Path(folder))
    with _reading(folder):
        return tuple(_info(uid, files) for uid, files in sorted(by_uid.items()))


def read_dicom(folder: str | Path, series_uid: str | None = None) -> Volume:
    """Read a CT series in Hounsfield units, (ni, nj, nk); k runs along the normal of the slices.

    Which series it is must be given when the folder holds more than one.  Raises FileError if the choice of
    series is open, slices are missing, damaged, empty, doubled or unevenly spaced, or the files do not state
    Hounsfield units, and FrameError if the gantry was tilted, so that the voxels do not form a rectangular
    grid.
    """
    by_uid, others = _headers_by_series(Path(folder))
    uid = _choose(by_uid, series_uid, folder)
    headers = by_uid[uid]
    where = f"Series {uid} of {folder}"
    _require_no_dead_slices(headers, {path: of for path, of in others.items() if of in ("", uid)}, where)
    with _reading(where):
        _require_uniform([header for _, header in headers], where)
        _require_grey_values(headers[0][1], where)
        paths, grid = _geometry(headers, where)
        return Volume(grid=grid, array=_pixels(paths, grid, float(headers[0][1].RescaleIntercept)))


def series_headers(folder: Path, series_uid: str | None = None) -> list[FileDataset]:
    """Return the headers of the slices of a series, by the names of their files.

    Raises FileError if the choice of series is open, or a slice cannot be read.
    """
    by_uid, _others = _headers_by_series(folder)
    chosen = by_uid[_choose(by_uid, series_uid, folder)]
    from pydicom import dcmread

    with _reading(folder):
        return [dcmread(path, stop_before_pixels=True) for path in sorted(path for path, _ in chosen)]


@contextmanager
def _reading(what: str | Path) -> Iterator[None]:
    """Do as `reading`, also for what pydicom alone raises."""
    from pydicom.errors import BytesLengthException

    with reading(what), warnings.catch_warnings(action="ignore"):  # Odd values are judged here.
        try:
            yield
        except BytesLengthException as error:
            raise ValueError(reason(error)) from error


def _headers_by_series(folder: Path) -> tuple[dict[str, list[tuple[Path, FileDataset]]], dict[Path, str]]:
    """Return the images of a folder by series, and the series of its other files, empty where none is stated.

    Hidden files are left out: they are notes of systems, whatever their names end in.
    """
    import pydicom
    from pydicom.errors import InvalidDicomError

    if not folder.is_dir():
        raise FileError(
            f"There is no folder {folder}",
            expected="a folder of DICOM files",
            remedy="Check the name; the CT may also be one file (.nii.gz, .nrrd, .mha)",
        )
    by_uid: dict[str, list[tuple[Path, FileDataset]]] = {}
    others: dict[Path, str] = {}
    tags: list[Any] = [*_SERIES_KEYS, *_NEEDED_KEYS]
    for path in sorted(
        p for p in folder.rglob("*") if p.is_file() and p.name != "DICOMDIR" and p.name[0] != "."
    ):
        with _reading(path):
            try:
                header = pydicom.dcmread(path, stop_before_pixels=True, specific_tags=tags)
            except (InvalidDicomError, EOFError):
                others[path] = ""
                continue
            uid = str(header.get("SeriesInstanceUID") or "")
            if uid and "Rows" in header:
                by_uid.setdefault(uid, []).append((path, header))
            else:
                others[path] = uid
    if not by_uid:
        raise FileError(
            f"{folder} holds no DICOM images",
            expected="a folder of DICOM files",
            remedy="Name the folder that holds the slices themselves, or a file (.nii.gz, .nrrd, .mha)",
        )
    return by_uid, others


def _require_no_dead_slices(
    headers: Sequence[tuple[Path, Any]], others: Mapping[Path, str], where: str
) -> None:
    """Refuse a series with files beside it that state its UID, or are named alike, but are no slices."""
    alike = {_likeness(path) for path, _ in headers}
    dead = [path for path, uid in others.items() if uid or _likeness(path) in alike]
    if dead:
        named = ", ".join(f"{path.name} ({path.stat().st_size} bytes)" for path in dead[:MOST_NAMED])
        raise FileError(
            f"{where} has {len(dead)} damaged files beside its {len(headers)} slices: {named}"
            + (" and others" if len(dead) > MOST_NAMED else ""),
            expected="files that are named like slices to begin as DICOM and to hold an image",
            remedy="Copy the series again; move away what does not belong to it",
        )


def _likeness(path: Path) -> tuple[Path, str]:
    """Return what slices of one export have in common: folder, and ending, or name without its numbers."""
    ending = path.suffix.lower()
    return path.parent, ending if re.search("[a-z]", ending) else re.sub(r"[\d.]+", "", path.name.lower())


def _info(uid: str, files: Sequence[tuple[Path, FileDataset]]) -> SeriesInfo:
    first = files[0][1]
    number = first.get("SeriesNumber")
    try:
        places = np.array([header.ImagePositionPatient for _, header in files], dtype=np.float64)
        along = places @ np.cross(*np.reshape(first.ImageOrientationPatient, (2, 3)).astype(np.float64))
    except (AttributeError, TypeError, ValueError):  # A picture without a place, such as a report's.
        along = np.zeros(len(files))
    return SeriesInfo(
        uid=uid,
        number=None if number is None else int(number),
        description=str(first.get("SeriesDescription", "")),
        modality=str(first.get("Modality", "?")),
        paths=tuple(path for path, _ in files),
        slice_mm=float(np.ptp(along)) / max(len(files) - 1, 1),
        middle=files[int(np.argsort(along, kind="stable")[len(files) // 2])][0],
        patient=str(first.get("PatientID", "")),
    )


def _choose(by_uid: dict[str, list[tuple[Path, Any]]], series_uid: str | None, folder: str | Path) -> str:
    if series_uid is None and len(by_uid) == 1:
        return next(iter(by_uid))
    if series_uid in by_uid:
        return str(series_uid)
    found = "; ".join(_info(uid, files).describe() for uid, files in sorted(by_uid.items()))
    asked = "" if series_uid is None else f", none of which is {series_uid}"
    raise FileError(
        f"{folder} holds {len(by_uid)} series{asked}: {found}",
        expected="an explicit choice of one series",
        remedy="Give the UID of the series",
    )


def _require_uniform(headers: Sequence[FileDataset], where: str) -> None:
    first = headers[0]
    if first.get("Modality") != "CT":
        raise FileError(
            f"{where} is of modality {first.get('Modality')}",
            expected="CT in Hounsfield units",
            remedy="Choose the CT series",
        )
    if int(first.get("NumberOfFrames") or 1) > 1:
        raise FileError(
            f"{where} keeps many slices in one file (enhanced DICOM)",
            expected="one slice a file",
            remedy="Convert the series to NIfTI, for instance with dcm2niix",
        )
    for header in headers:
        missing = [key for key in _NEEDED_KEYS if header.get(key) is None]
        if missing:
            raise FileError(
                f"{where} has a slice without {', '.join(missing)}",
                expected="a CT series",
                remedy="Export the CT series again, with all its tags",
            )
        for key in _UNIFORM_KEYS:
            if header.get(key) != first.get(key):
                raise FileError(
                    f"{where} has slices whose {key} differ: {first.get(key)} and {header.get(key)}",
                    expected="one size and scale for all slices",
                    remedy="Export the reconstruction as a series of its own",
                )


def _require_grey_values(first: FileDataset, where: str) -> None:
    """Refuse slices that do not hold one Hounsfield unit a pixel; all slices say the same as the first."""
    slope, samples = float(first.RescaleSlope), int(first.SamplesPerPixel)
    shown_as, unit = first[_GREY_KEYS[1]].value, first.get("RescaleType", "HU")
    scaled = slope != 0 and np.isfinite([slope, float(first.RescaleIntercept)]).all()
    if (samples, shown_as) != (1, "MONOCHROME2") or not scaled or unit not in _HOUNSFIELD_TYPES:
        raise FileError(
            f"{where} has {samples} samples a pixel, shown as {shown_as}, RescaleSlope {slope:g}, "
            f"RescaleIntercept {first.RescaleIntercept} and RescaleType {unit}",
            expected="one MONOCHROME2 sample a pixel, which slope and intercept turn into Hounsfield units",
            remedy="Export the CT series again, not a picture of it",
        )


def _geometry(headers: Sequence[tuple[Path, FileDataset]], where: str) -> tuple[list[Path], Grid]:
    """Sort the slices along their normal and prove that they form a rectangular grid."""
    first = headers[0][1]
    orientation = np.array([h.ImageOrientationPatient for _, h in headers], dtype=np.float64)
    if not np.abs(orientation - orientation[0]).max() <= 1e-4:
        raise FrameError(
            f"{where} has slices of different orientation",
            expected="parallel slices",
            remedy="Choose one axial series, without scout images",
        )
    along_i, along_j = orientation[0, :3], orientation[0, 3:]
    require_directions(np.stack([along_i, along_j], axis=1), "ImageOrientationPatient", Path(where))
    normal = np.cross(along_i, along_j)
    positions = np.array([h.ImagePositionPatient for _, h in headers], dtype=np.float64)
    order = np.argsort(positions @ normal, kind="stable")
    positions = positions[order]
    spacing_k_mm = _slice_spacing(positions @ normal, [headers[n][0].name for n in order], where)
    _require_no_tilt(positions, normal, where)
    spacing_j_mm, spacing_i_mm = require_lengths(first.PixelSpacing, "PixelSpacing", Path(where)).tolist()
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([along_i * spacing_i_mm, along_j * spacing_j_mm, normal * spacing_k_mm], axis=1)
    matrix[:3, 3] = positions[0]
    stored_bytes = sum(path.stat().st_size for path, _ in headers)
    shape = image_shape((int(first.Columns), int(first.Rows), len(headers)), 2, Path(where), stored_bytes)
    return [headers[n][0] for n in order], named_grid(shape, matrix, Path(where))


def _slice_spacing(heights_mm: Float, names: Sequence[str], where: str) -> float:
    """Return the distance of neighbouring slices; the sorted heights must be evenly spaced."""
    if len(heights_mm) < 2:
        raise FileError(
            f"{where} has a single slice",
            expected="a volume of two or more slices",
            remedy="Choose another series, or copy all its files",
        )
    gaps = np.diff(heights_mm)
    spacing_mm = float(np.median(gaps))
    if not gaps.min() >= _SPACING_TOLERANCE_MM:
        at = int(gaps.argmin())
        raise FileError(
            f"{where} has two slices at the height {heights_mm[at]:.2f} mm: {names[at]} and {names[at + 1]}",
            expected="one slice at each position",
            remedy="Keep one acquisition (phase, time or reconstruction) a series, and one copy of each file",
        )
    if not gaps.max() <= 1.5 * spacing_mm:
        at = int(gaps.argmax())
        raise FileError(
            f"{where} misses slices between the heights {heights_mm[at]:.2f} and {heights_mm[at + 1]:.2f} mm",
            expected=f"a slice every {spacing_mm:.3f} mm",
            remedy="Export the complete series again",
        )
    even = heights_mm[0] + (heights_mm[-1] - heights_mm[0]) / (len(gaps)) * np.arange(len(heights_mm))
    if not np.abs(heights_mm - even).max() <= _SPACING_TOLERANCE_MM:
        raise FileError(
            f"{where} has slices spaced {gaps.min():.3f} to {gaps.max():.3f} mm apart",
            expected="one distance between all slices",
            remedy="Resample the series to even spacing",
        )
    return float((heights_mm[-1] - heights_mm[0]) / len(gaps))


def _require_no_tilt(positions: Float, normal: Float, where: str) -> None:
    travel = positions - positions[0]
    sideways_mm = np.linalg.norm(travel - np.outer(travel @ normal, normal), axis=1)
    if not sideways_mm.max() <= 0.1:
        degrees = float(np.degrees(np.arctan2(sideways_mm[-1], travel[-1] @ normal)))
        raise FrameError(
            f"{where} was taken with the gantry tilted by {degrees:.2f} degrees",
            expected="slices stacked along their normal",
            remedy="Correct the tilt by resampling, for instance with dcm2niix",
        )


def _pixels(paths: Sequence[Path], grid: Grid, intercept: float) -> Any:
    """Read the slices in order; the reader applies slope and intercept of each file."""
    import SimpleITK

    values: Any = None
    for k, path in enumerate(paths):
        with reading(path):
            plane = SimpleITK.GetArrayViewFromImage(image := SimpleITK.ReadImage(str(path)))
        if values is None:
            values = np.zeros(grid.shape, dtype=plane.dtype, order="F")
        if (plane == intercept).all():
            raise FileError(
                f"{path} holds nothing but zeros as its pixels",
                expected="slices of a CT, which are nowhere all alike",
                remedy="Copy the series again; where it was made with empty slices at its ends, remove them",
            )
        values[:, :, k] = plane.reshape(plane.shape[-2:]).T
        del plane, image
    return values
