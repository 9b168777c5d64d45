"""Reading and writing of single image files: NIfTI, NRRD and MetaImage."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from anatomy.errors import FileError
from anatomy.grid import Grid, Volume
from anatomy.io.compressed import require_intact
from anatomy.io.files import atomic_write, require_file, unreadable
from anatomy.io.frames import LPS_FROM, Frame
from anatomy.io.itk_headers import metaimage_payload, nrrd_labels, read_nrrd_header, stated_frame
from anatomy.io.nifti import begins_as_nifti, read_nifti, read_nifti_header, read_nifti_mask, require_numbers
from anatomy.io.nifti_header import right_handed_grid

if TYPE_CHECKING:
    import SimpleITK

NIFTI, NRRD, METAIMAGE = (".nii.gz", ".nii", ".gz"), (".seg.nrrd", ".nrrd"), (".mha", ".mhd")
T = TypeVar("T")

MOST_NOTE = 79
"""Letters that the description in a NIfTI header has room for."""
SUFFIXES = NIFTI + NRRD + METAIMAGE


def image_suffix(path: str | Path) -> str | None:
    """Return the ending of a known image format, or None."""
    name = Path(path).name.lower()
    return next((suffix for suffix in SUFFIXES if name.endswith(suffix)), None)


def image_stem(path: str | Path) -> str:
    """Return the file name without the ending of its image format."""
    suffix = image_suffix(path) or ""
    name = Path(path).name
    return name[: len(name) - len(suffix)]


def images_in(folder: Path) -> list[Path]:
    """Return the image files of a folder by name; a bare .gz counts if a NIfTI image is in it."""
    files = sorted(path for path in folder.iterdir() if path.is_file() and image_suffix(path))
    return [path for path in files if image_suffix(path) != ".gz" or begins_as_nifti(path)]


def read_grid(path: str | Path, *, frame: Frame | None = None) -> Grid:
    """Read the grid of an image from its header alone; parameters and errors as `read_volume`."""
    path = require_file(path)
    if _suffix(path) in NIFTI:
        return _guard(path, read_nifti_header, path, frame).grid
    import SimpleITK

    reader = SimpleITK.ImageFileReader()
    reader.SetFileName(str(path))
    try:
        reader.ReadImageInformation()
    except RuntimeError as error:
        raise unreadable(path, RuntimeError(_last_line(error))) from error
    _require_three_dimensions(path, reader.GetDimension(), reader.GetNumberOfComponents())
    return _itk_grid(reader, path, frame)[0]


def read_volume(path: str | Path, *, frame: Frame | None = None) -> Volume:
    """Read an image in its own type of voxel.

    Parameters
    ----------
    path : path of a .nii, .nii.gz (or .gz), .nrrd, .seg.nrrd, .mha or .mhd file
    frame : "ras" or "lps", optional
        The frame to assume if, and only if, the file states none.

    Returns
    -------
    Volume
        `array[i, j, k]` with the grid in LPS mm; the first index of a file with left-handed axes is
        counted the other way.

    Raises
    ------
    FileError
        If the file is missing, damaged, truncated or no image of three dimensions.
    FrameError
        If the file states no frame and none is given, or its axes are not perpendicular.
    """
    path = require_file(path)
    if _suffix(path) in NIFTI:
        return _guard(path, read_nifti, path, frame)
    image = _read_itk(path)
    array = np.asarray(_ImageBuffer(image)).T
    grid, is_reversed = _itk_grid(image, path, frame)
    return Volume(grid=grid, array=array[::-1] if is_reversed else array)


def read_mask(path: str | Path, *, frame: Frame | None = None) -> Volume:
    """Read an image as a bool mask, true where a voxel is not zero.

    Raises
    ------
    AnatomyError
        If a voxel is not a number.
    FileError, FrameError
        As `read_volume`.
    """
    path = require_file(path)
    if _suffix(path) in NIFTI:
        return _guard(path, read_nifti_mask, path, frame)
    volume = read_volume(path, frame=frame)
    require_numbers(volume.array, path)
    return Volume(grid=volume.grid, array=volume.array != 0)


def read_labels(path: str | Path) -> Mapping[int, str]:
    """Read the names of label values that a file carries in its header.

    Returns
    -------
    dict of label value to name
        From the label table in the header extension of NIfTI, or the segments of .seg.nrrd; empty if
        there is none.
    """
    path = require_file(path)
    suffix = _suffix(path)
    if suffix in NIFTI:
        return _guard(path, read_nifti_header, path, "lps").labels
    return nrrd_labels(read_nrrd_header(path)) if suffix in NRRD else {}


def write_volume(
    path: str | Path, volume: Volume, *, header: Mapping[str, str] | None = None, note: str = ""
) -> None:
    """Write a volume as .nii, .nii.gz, .nrrd or .seg.nrrd, with its frame stated; masks become 0 and 1.

    The file appears complete or not at all.

    Parameters
    ----------
    path : path
    volume : Volume
    header : mapping of str to str, optional
        `key:=value` lines of a .nrrd file, such as those that name the segments of .seg.nrrd.

    note : str
        What the header of a NIfTI file says of its voxels, at most 79 letters.

    Raises
    ------
    FileError
        If the ending is unknown or the folder cannot be written to.
    """
    import SimpleITK

    path = Path(path)
    if image_suffix(path) not in (".nii", ".nii.gz", ".nrrd", ".seg.nrrd"):
        raise FileError(
            f"{path} has no ending that can be written", expected=".nii, .nii.gz, .nrrd or .seg.nrrd"
        )
    if header and path.suffix != ".nrrd":
        raise FileError(f"{path} cannot hold a header of keys and values", expected="a name ending in .nrrd")
    array = volume.array.view(np.uint8) if volume.array.dtype == np.bool_ else volume.array
    image = SimpleITK.GetImageFromArray(array.T)
    spacing = volume.grid.spacing_mm
    image.SetSpacing(spacing.tolist())
    image.SetOrigin(volume.grid.lps_from_ijk[:3, 3].tolist())
    image.SetDirection((volume.grid.lps_from_ijk[:3, :3] / spacing).ravel().tolist())
    if note:
        image.SetMetaData("ITK_FileNotes", note[:MOST_NOTE])
    for key, value in (header or {}).items():
        image.SetMetaData(key, value)
    with atomic_write(path) as temporary:
        try:
            SimpleITK.WriteImage(image, str(temporary), useCompression=path.suffix != ".nii")
        except RuntimeError as error:
            raise OSError(_last_line(error)) from error


class _ImageBuffer:
    """Keeps an ITK image alive for as long as an array looks into its memory."""

    def __init__(self, image: SimpleITK.Image) -> None:
        import SimpleITK

        self._image = image
        self.__array_interface__ = SimpleITK.GetArrayViewFromImage(image).__array_interface__


def _suffix(path: Path) -> str:
    suffix = image_suffix(path)
    if suffix is None:
        raise FileError(
            f"{path} is of an unknown kind",
            expected="an image ending in " + ", ".join(SUFFIXES),
            remedy="Convert the image to NIfTI (.nii.gz) with the program that wrote it",
        )
    return suffix


def _guard(path: Path, function: Callable[..., T], *arguments: object) -> T:
    try:
        return function(*arguments)
    except OSError as error:
        raise unreadable(path, error) from error


def _read_itk(path: Path) -> SimpleITK.Image:
    import SimpleITK

    _guard(path, _require_intact_payload, path)
    try:
        image = SimpleITK.ReadImage(str(path))
    except RuntimeError as error:
        raise unreadable(path, RuntimeError(_last_line(error))) from error
    _require_three_dimensions(path, image.GetDimension(), image.GetNumberOfComponentsPerPixel())
    return image


def _require_three_dimensions(path: Path, dimensions: int, components: int) -> None:
    if (dimensions, components) != (3, 1):
        raise FileError(
            f"{path} is not one image of three dimensions with one number a voxel",
            expected="one three-dimensional image",
            remedy="Export overlapping segments to separate files, or merge them into one label map",
        )


def _require_intact_payload(path: Path) -> None:
    """Prove the checksum of compressed data: ITK returns damaged voxels without a word."""
    if image_suffix(path) in NRRD:
        header = read_nrrd_header(path)
        if header.fields.get("encoding") in ("gzip", "gz"):
            require_intact(path, header.data_offset)
    else:
        payload = metaimage_payload(path)
        if payload is not None:
            require_intact(*payload)


def _itk_grid(
    image: SimpleITK.Image | SimpleITK.ImageFileReader, path: Path, frame: Frame | None
) -> tuple[Grid, bool]:
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(image.GetDirection()).reshape(3, 3) * np.array(image.GetSpacing())
    matrix[:3, 3] = image.GetOrigin()
    if image_suffix(path) in NRRD and not stated_frame(read_nrrd_header(path), path, frame):
        matrix = LPS_FROM[str(frame)] @ matrix
    ni, nj, nk = image.GetSize()
    return right_handed_grid((ni, nj, nk), matrix, path)


def _last_line(error: Exception) -> str:
    return str(error).strip().splitlines()[-1]
