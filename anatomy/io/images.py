"""Reading and writing of single image files: NIfTI, NRRD and MetaImage."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from anatomy.errors import FileError
from anatomy.grid import Grid, Volume
from anatomy.io.files import atomic_write, reading, require_file
from anatomy.io.frames import Frame
from anatomy.io.image_header import ImageHeader
from anatomy.io.metaimage import open_metaimage
from anatomy.io.nifti import begins_as_nifti, open_nifti
from anatomy.io.nrrd import open_nrrd
from anatomy.io.voxels import read_nonzero, read_values

NIFTI, NRRD, METAIMAGE = (".nii.gz", ".nii", ".gz"), (".seg.nrrd", ".nrrd"), (".mha", ".mhd")

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
    with reading(path):
        return _open(path, frame)[0].grid


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
        If the file is missing, damaged, truncated, absurdly large or no image of three dimensions.
    FrameError
        If the file states no frame and none is given, or its axes are not perpendicular.
    """
    path = require_file(path)
    with reading(path):
        return read_values(*_open(path, frame), path)


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
    with reading(path):
        return read_nonzero(*_open(path, frame), path)


def read_labels(path: str | Path) -> Mapping[int, str]:
    """Read the names of label values that a file carries in its header.

    Returns
    -------
    dict of label value to name
        From the label table in the header extension of NIfTI, or the segments of .seg.nrrd; empty if
        there is none.
    """
    path = require_file(path)
    with reading(path):
        return _open(path, "lps")[0].labels


def _open(path: Path, frame: Frame | None) -> tuple[ImageHeader, Iterator[bytes]]:
    """Read the header of a file of any format, and return it with the bytes of the voxels."""
    suffix = image_suffix(path)
    with np.errstate(invalid="ignore", over="ignore"):  # Grids refuse what is not finite.
        if suffix in NIFTI:
            return open_nifti(path, frame)
        if suffix in NRRD:
            return open_nrrd(path, frame)
        if suffix in METAIMAGE:
            return open_metaimage(path)
    raise FileError(
        f"{path} is of an unknown kind",
        expected="an image ending in " + ", ".join(SUFFIXES),
        remedy="Convert the image to NIfTI (.nii.gz) with the program that wrote it",
    )


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
            raise OSError(str(error).strip().splitlines()[-1]) from error
