"""Reading and writing of single image files: NIfTI, NRRD and MetaImage, and masks of DICOM."""

from __future__ import annotations

import errno
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from anatomy.base.errors import FileError, LungaccessError
from anatomy.base.files import DAMAGE, atomic_write, reading, reason, require_file
from anatomy.base.typed import Array, Mask
from anatomy.grid import Grid, Volume
from anatomy.io.dicom_seg import is_dicom, read_segment_masks, read_segments, segment_names
from anatomy.io.frames import Frame
from anatomy.io.image_header import ImageHeader
from anatomy.io.mask_values import mask_of
from anatomy.io.metaimage import open_metaimage
from anatomy.io.nifti import begins_as_nifti, open_nifti
from anatomy.io.nrrd import open_nrrd
from anatomy.io.voxels import read_array, read_two_valued, require_whole

if TYPE_CHECKING:
    import SimpleITK

NIFTI, NRRD, METAIMAGE = (".nii.gz", ".nii", ".gz"), (".seg.nrrd", ".nrrd"), (".mha", ".mhd")

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


def _holds_segments(path: Path) -> bool:
    """Return whether a file whose name tells no image format is DICOM, in which masks are segments."""
    return image_suffix(path) is None and is_dicom(path)


def read_grid(path: str | Path, *, frame: Frame | None = None) -> Grid:
    """Read the grid of an image from its header alone; parameters and errors as `read_volume`."""
    path = require_file(path)
    if _holds_segments(path):
        return read_segments(path).grid
    with reading(path):
        return open_image(path, frame)[0].grid


def read_volume(path: str | Path, *, frame: Frame | None = None) -> Volume:
    """Read an image in its own type of voxel.

    Args:
        path: path of a .nii, .nii.gz (or .gz), .nrrd, .seg.nrrd, .mha or .mhd file, or a DICOM segmentation.
        frame ("ras" or "lps"): The frame to assume if, and only if, the file states none.

    Returns:
        `array[i, j, k]` with the grid in LPS mm; the first index of a file with left-handed axes is counted
        the other way.

    Raises:
        FileError: If the file is missing, damaged, truncated, absurdly large or no image of three dimensions.
        FrameError: If the file states no frame and none is given, or its axes are not perpendicular.
    """
    path = require_file(path)
    if _holds_segments(path):
        return read_segments(path)
    with reading(path):
        header, stream = open_image(path, frame)
        return Volume(grid=header.grid, array=read_array(header, stream, path))


def read_mask(
    path: str | Path,
    *,
    frame: Frame | None = None,
    role: str = "",
    labels: Sequence[int] = (),
    say: Callable[[str], object] = warnings.warn,
) -> Volume:
    """Read an image as a bool mask: of one label, of two values, of fractions, or of labels that are named.

    Args:
        path, frame: As in `read_volume`.
        role, labels: What the mask shows, and the labels that count, as in `anatomy.io.mask_values.mask_of`.
        say: Receives what a user should know of how the values were understood, such as that of fractions
            those of at least a half count, and how the volume changes.

    Raises:
        AnatomyError: If a voxel is not a number, several labels occur and none is named, or the values are
            those of no mask.
        FileError, FrameError: As `read_volume`.
    """
    grid, masks, said = read_parts(path, [(role, labels)], frame=frame)
    for each in said:
        say(each)
    return Volume(grid=grid, array=masks[0])


def read_parts(
    path: str | Path, parts: Sequence[tuple[str, Sequence[int]]], *, frame: Frame | None = None
) -> tuple[Grid, list[Mask], tuple[str, ...]]:
    """Read an image once, and return its grid, the masks of some roles and labels, and what to say of them.

    Errors and meaning are those of `read_mask`.
    """
    path = require_file(path)
    if _holds_segments(path):
        return *read_segment_masks(path, parts), ()
    if not any(labels for _, labels in parts):
        with reading(path):
            plain = read_two_valued(*open_image(path, frame), path)
        if plain is not None:
            return plain.grid, [plain.array] * len(parts), ()
    volume = read_volume(path, frame=frame)
    voxel_mm3 = volume.grid.voxel_volume_mm3
    found = [
        mask_of(volume.array, path.name, voxel_mm3=voxel_mm3, role=role, labels=labels)
        for role, labels in parts
    ]
    said = dict.fromkeys(each for _, told in found for each in told)
    return volume.grid, [mask for mask, _ in found], tuple(said)


def read_labels(path: str | Path) -> Mapping[int, str]:
    """Read the names of label values that a file carries in its header; empty if there are none.

    They stand in the label table in the header extension of NIfTI, or are the segments of .seg.nrrd or DICOM.
    """
    path = require_file(path)
    if _holds_segments(path):
        return segment_names(path)
    with reading(path):
        return open_image(path, "lps")[0].labels


def open_image(path: Path, frame: Frame | None, components: int = 1) -> tuple[ImageHeader, Iterator[bytes]]:
    """Read the header of a file of any format, and return it with the bytes of the voxels.

    `components` is how many numbers a voxel must have.
    """
    suffix = image_suffix(path)
    with np.errstate(invalid="ignore", over="ignore"):  # Grids refuse what is not finite.
        if suffix in NIFTI:
            return open_nifti(path, frame, components)
        if suffix in NRRD:
            return open_nrrd(path, frame, components)
        if suffix in METAIMAGE:
            return open_metaimage(path, components)
    raise FileError(
        f"{path} is of an unknown kind",
        expected="an image ending in " + ", ".join(SUFFIXES),
        remedy="Convert the image to NIfTI (.nii.gz) with the program that wrote it",
    )


def itk_image(array: Array, grid: Grid) -> SimpleITK.Image:
    """Return the image of ITK with the numbers, or the vectors, of the voxels of a grid."""
    import SimpleITK

    image = SimpleITK.GetImageFromArray(np.moveaxis(array, (0, 2), (2, 0)), isVector=array.ndim == 4)
    spacing = grid.spacing_mm
    image.SetSpacing(spacing.tolist())
    image.SetOrigin(grid.lps_from_ijk[:3, 3].tolist())
    image.SetDirection((grid.lps_from_ijk[:3, :3] / spacing).ravel().tolist())
    return image


def write_volume(
    path: str | Path, volume: Volume, *, header: Mapping[str, str] | None = None, note: str = ""
) -> None:
    """Write a volume as .nii, .nii.gz, .nrrd or .seg.nrrd, with its frame stated; masks become 0 and 1.

    The file appears complete or not at all.  Raises FileError if the ending is unknown or the folder cannot
    be written to.

    Args:
        header: `key:=value` lines of a .nrrd file, such as those that name the segments of .seg.nrrd.
        note: What the header of a NIfTI file says of its voxels, at most 79 letters.
    """
    path = Path(path)
    if image_suffix(path) not in (".nii", ".nii.gz", ".nrrd", ".seg.nrrd"):
        raise FileError(
            f"{path} has no ending that can be written", expected=".nii, .nii.gz, .nrrd or .seg.nrrd"
        )
    if header and path.suffix != ".nrrd":
        raise FileError(f"{path} cannot hold a header of keys and values", expected="a name ending in .nrrd")
    array = volume.array.view(np.uint8) if volume.array.dtype == np.bool_ else volume.array
    image = itk_image(array, volume.grid)
    if note:
        # Letters that the description in a NIfTI header has room for.
        image.SetMetaData("ITK_FileNotes", note[:79])
    for key, value in (header or {}).items():
        image.SetMetaData(key, value)
    write_image(image, path)


def write_image(image: SimpleITK.Image, path: Path, components: int = 1) -> None:
    """Write an image of ITK with so many numbers a voxel, all of it or nothing.

    ITK says nothing where the disk is full: what was written is read through once, up to its checksum.
    Raises FileError if the folder cannot be written to, or the disk is full.
    """
    import SimpleITK

    with atomic_write(path) as temporary:
        try:
            SimpleITK.WriteImage(image, str(temporary), useCompression=path.suffix != ".nii")
        except RuntimeError as error:
            raise OSError(reason(error)) from error
        try:
            require_whole(*open_image(temporary, None, components), temporary)
        except (*DAMAGE, LungaccessError) as error:
            raise OSError(errno.ENOSPC, "not all of it could be written") from error
