"""Masks in DICOM: segments (SEG) and contours (RTSTRUCT), by number, label or coded meaning.

The standard is DICOM PS3.3, A.51 and A.19; codes of properties are those of SNOMED CT.
"""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.base.errors import AnatomyError, FileError, SettingsError
from anatomy.base.files import DAMAGE, reading, reason
from anatomy.base.typed import Array, Float, Mask
from anatomy.grid import Grid, Volume
from anatomy.io.image_header import image_shape, right_handed_grid

PREAMBLE_BYTES, MAGIC = 128, b"DICM"
SEG_CLASSES = ("1.2.840.10008.5.1.4.1.1.66.4", "1.2.840.10008.5.1.4.1.1.66.7")
"""Segmentation Storage, and Label Map Segmentation Storage."""
CONTOURS_CLASS = "1.2.840.10008.5.1.4.1.1.481.3"
"""RT Structure Set Storage."""
CONTOUR_MM, CONTOUR_FLAT_MM = 0.5, 0.02
"""Voxels that contours are filled with are so wide, finer than those of a CT; a contour is flat within the
second length, which is how far programs round coordinates."""
SNOMED, OWN = "SCT", "99LUNGACCESS"
"""Schemes of codes: SNOMED CT, and this program's, for what the lists of the standard do not hold."""
CODES: Mapping[str, tuple[str, str, str]] = {
    "lumen": ("89187006", SNOMED, "Airway structure"),
    "wall": ("AIRWAY_WALL", OWN, "Airway wall"),
    "vessels": ("59820001", SNOMED, "Blood vessel"),
    "lung": ("39607008", SNOMED, "Lung"),
    "fissures": ("278983006", SNOMED, "Fissure of lung"),
    "nodules": ("27925004", SNOMED, "Nodule"),
}
"""Code, scheme and meaning of each role: segments are written with them, and found by them."""
OTHER_CODES = {
    "955009": "lumen", "110726009": "lumen", "44567001": "lumen", "81040000": "vessels",
    "122972007": "vessels", "3341006": "lung", "44029006": "lung", "108369006": "nodules",
    "4147007": "nodules",
}  # fmt: skip
"""Other programs write these codes: bronchus, trachea and bronchus, trachea; pulmonary arteries; pulmonary
veins, right and left lung, neoplasm; mass."""


def highdicom() -> Any:
    """Return the library that reads and writes the objects of DICOM; SettingsError if it is not installed."""
    try:
        return importlib.import_module("highdicom")
    except ModuleNotFoundError as error:
        raise SettingsError(
            f"DICOM segmentations are read and written by {error.name}, which is not installed",
            expected="the extra `dicom`",
            remedy="pip install 'lungaccess[dicom]'",
        ) from error


def uid_of(*parts: str) -> str:
    """Return a UID that follows from some texts."""
    from pydicom.uid import generate_uid

    return str(generate_uid(entropy_srcs=list(parts)))


def is_dicom(path: Path) -> bool:
    """Return whether a file begins as DICOM files do."""
    with reading(path), path.open("rb") as stream:
        stream.seek(PREAMBLE_BYTES)
        return stream.read(len(MAGIC)) == MAGIC


class _Segments:
    """The segments of a Segmentation object: their labels, roles and voxels, by number."""

    def __init__(self, path: Path) -> None:
        self._path, self._found = path, highdicom().seg.segread(path)
        described = [self._found.get_segment_description(number) for number in self._found.segment_numbers]
        self.names = {int(each.segment_number): str(each.segment_label) for each in described}
        self.roles = {
            int(each.segment_number): _role(str(each.segmented_property_type.value)) for each in described
        }

    def label_map(self) -> Volume:
        """Return the numbers of the segments, of which later ones cover earlier ones."""
        grid, array = self._volume(None, combined=True)
        return Volume(grid=grid, array=array)

    def mask(self, numbers: Sequence[int]) -> Volume:
        """Return where one of some segments is; of fractions, those of at least a half count."""
        grid, array = self._volume(numbers, combined=False)
        held = array >= 0.5 if array.dtype.kind == "f" else array > 0
        return Volume(grid=grid, array=np.asfortranarray(held.any(axis=-1)))

    def _volume(self, numbers: Sequence[int] | None, *, combined: bool) -> tuple[Grid, Array]:
        made = self._found.get_volume(
            segment_numbers=numbers, combine_segments=combined, skip_overlap_checks=True
        )
        array = np.swapaxes(made.array, 0, 2)  # Frames, rows, columns become columns, rows, frames.
        matrix = np.array(made.affine)[:, [2, 1, 0, 3]]
        grid, is_reversed = right_handed_grid(array.shape[:3], matrix, self._path)
        return grid, np.asfortranarray(array[::-1] if is_reversed else array)


class _Contours:
    """The regions of a Structure Set: their names, roles and voxels, by number.

    A contour has no voxels: they are those of the planes of the contours, `CONTOUR_MM` wide.  Contours of one
    region in one plane that lie in each other are holes.
    """

    def __init__(self, path: Path) -> None:
        from pydicom import dcmread

        found = dcmread(path)
        regions = {int(each.ROINumber): str(each.ROIName) for each in found.StructureSetROISequence}
        drawn: dict[int, list[Float]] = {number: [] for number in regions}
        for each in found.ROIContourSequence:
            for contour in each.get("ContourSequence", ()):
                if contour.ContourGeometricType == "CLOSED_PLANAR":
                    points = np.array(contour.ContourData, dtype=np.float64).reshape(-1, 3)
                    drawn[int(each.ReferencedROINumber)].append(points)
        self._drawn = {number: contours for number, contours in drawn.items() if contours}
        self.names = {number: regions[number] for number in self._drawn}
        self.roles = dict.fromkeys(self.names, "")
        for each in found.get("RTROIObservationsSequence", ()):
            for code in each.get("RTROIIdentificationCodeSequence", ()):
                if int(each.ReferencedROINumber) in self.roles:
                    self.roles[int(each.ReferencedROINumber)] = _role(str(code.CodeValue))
        self._grid = self._grid_of(path)

    def _grid_of(self, path: Path) -> Grid:
        contours = [contour for each in self._drawn.values() for contour in each]
        points = np.concatenate(contours) if contours else np.zeros((0, 3))
        planes = np.unique(np.array([contour[0, 2] for contour in contours]).round(2))
        flat = all(np.ptp(contour[:, 2]) <= CONTOUR_FLAT_MM for contour in contours)
        gaps = np.diff(planes)
        step_mm = float(gaps.min()) if len(gaps) else 0.0
        if not flat or not step_mm or not (np.abs(gaps / step_mm - (gaps / step_mm).round()) <= 0.05).all():
            raise FileError(
                f"{path} has contours on {len(planes)} heights that are no evenly spaced planes",
                expected="closed contours in axial slices",
                remedy="Export the structures as a DICOM segmentation, or as an image",
            )
        low, high = points.min(axis=0) - CONTOUR_MM, points.max(axis=0) + CONTOUR_MM
        spacing = np.array([CONTOUR_MM, CONTOUR_MM, step_mm])
        sizes = np.ceil((high - low)[:2] / CONTOUR_MM).astype(int) + 1
        levels = round(float(planes[-1] - planes[0]) / step_mm) + 1
        shape = image_shape((int(sizes[0]), int(sizes[1]), levels), 1, path, path.stat().st_size)
        return Grid.from_spacing(shape, spacing, [low[0], low[1], planes[0]])

    def label_map(self) -> Volume:
        """Return the numbers of the regions, of which later ones cover earlier ones."""
        array = np.zeros(self._grid.shape, dtype=np.uint16, order="F")
        for number in self.names:
            array[self.mask([number]).array] = number
        return Volume(grid=self._grid, array=array)

    def mask(self, numbers: Sequence[int]) -> Volume:
        """Return where one of some regions is."""
        from skimage.draw import polygon2mask

        held = np.zeros(self._grid.shape, dtype=np.bool_, order="F")
        for number in numbers:
            region = np.zeros_like(held)
            for contour in self._drawn[number]:
                places = self._grid.ijk(contour)
                region[:, :, round(float(places[0, 2]))] ^= polygon2mask(self._grid.shape[:2], places[:, :2])
            held |= region
        return Volume(grid=self._grid, array=held)


@contextmanager
def _opened(path: Path) -> Iterator[_Segments | _Contours]:
    """Open an object with masks; what cannot be understood of it is a `FileError`."""
    from pydicom import dcmread

    with reading(path), warnings.catch_warnings(action="ignore"):
        found = str(dcmread(path, specific_tags=["SOPClassUID"]).get("SOPClassUID", ""))
    if found not in (*SEG_CLASSES, CONTOURS_CLASS):
        raise FileError(
            f"{path} is a DICOM file of the class {found or 'unknown'}",
            expected="a Segmentation object or Structure Set, where masks are read",
            remedy="Give the folder of the series where a CT is meant",
        )
    try:
        with warnings.catch_warnings(action="ignore"):
            yield _Contours(path) if found == CONTOURS_CLASS else _Segments(path)
    except (*DAMAGE, AttributeError, RuntimeError) as error:
        raise FileError(
            f"{path} holds masks that cannot be read: {reason(error)}",
            expected="frames or contours that form one volume",
            remedy="Export the segmentation again, on the voxels of its CT",
        ) from error


def segment_names(path: Path) -> Mapping[int, str]:
    """Read the labels of masks by their number, without voxels; errors are those of `read_segments`."""
    with _opened(path) as found:
        return found.names


def read_segments(path: Path) -> Volume:
    """Read masks as a label map, in which later ones cover earlier ones.

    Raises FileError if the file is no Segmentation object or Structure Set, or damaged, and SettingsError if
    the extra `dicom` is not installed.
    """
    with _opened(path) as found:
        return found.label_map()


def read_segment_masks(path: Path, parts: Sequence[tuple[str, Sequence[int]]]) -> tuple[Grid, list[Mask]]:
    """Read a mask for each role and numbers of segments; without numbers, of those that mean the role.

    A file with one segment is a mask by itself.  Raises AnatomyError if no segment has a number, or several
    segments are there and none means the role, and FileError or SettingsError as `read_segments`.
    """
    with _opened(path) as found:
        volumes = [found.mask(_numbers(path, found.roles, found.names, *part)) for part in parts]
        return volumes[0].grid, [np.asarray(volume.array) for volume in volumes]


def _role(code: str) -> str:
    """Return the role that a code means, else an empty text."""
    return next((role for role, (value, *_) in CODES.items() if value == code), OTHER_CODES.get(code, ""))


def _numbers(
    path: Path, roles: Mapping[int, str], names: Mapping[int, str], role: str, labels: Sequence[int]
) -> list[int]:
    chosen = list(labels) or [n for n, each in roles.items() if each == role] or list(roles)
    if set(chosen) <= set(roles) and (labels or len(roles) == 1 or len(chosen) < len(roles)):
        return chosen
    held = ", ".join(f"{number} {name}" for number, name in names.items())
    asked = ", ".join(map(str, labels)) if labels else f"one that means {role or 'a mask'} by its code"
    raise AnatomyError(
        f"{path.name} has the segments {held}, and not {asked}",
        expected="segments by number or label",
        remedy=f"Name the segments, as in {path.name}#{next(iter(names), 1)}",
    )
