"""The file in which the corrections of a person are kept with a patient."""

from pathlib import Path

import numpy as np

from anatomy.base.errors import FileError
from anatomy.base.files import atomic_write, require_writable_folder, sha256
from anatomy.corrections import AS_MADE, NODULE, with_corrections
from anatomy.grid import Volume
from anatomy.io.images import read_volume, write_volume
from anatomy.morphology import bounds
from anatomy.patient import PatientImages

FOLDER = "corrections"
PAINTED_FILE = "painted.nii.gz"
NOTE = "1 tissue, 2 airway, 3 vessel, 4 fissure, 5 nodule; 0 as the masks say"
"""The header of the file says this."""


def corrections_file(path: Path) -> Path:
    """Return the file in which the corrections of a patient are kept, whether or not there is one."""
    return (path if path.is_dir() else path.parent) / FOLDER / PAINTED_FILE


def corrected(images: PatientImages, path: Path) -> PatientImages:
    """Return the images of a patient as a person corrected them, if anybody did.

    Raises FileError or FrameError if the file cannot be read.
    """
    file = corrections_file(path)
    if not file.is_file():
        return images
    return with_corrections(images, read_corrections(file), {f"{FOLDER}/{PAINTED_FILE}": sha256(file)})


def read_corrections(file: Path) -> Volume:
    """Read corrections; FileError or FrameError if the file cannot be read, or holds other values."""
    volume = read_volume(file)
    values = np.asarray(volume.array)
    if not np.isin(np.unique(values), range(NODULE + 1)).all():
        raise FileError(
            f"{file} holds values from {values.min():g} to {values.max():g}",
            expected=f"whole numbers from 0 to {NODULE}, which say what a voxel is",
            remedy="Take the file away to explore the masks as they were made",
        )
    return Volume(grid=volume.grid, array=np.asfortranarray(values.astype(np.uint8)))


def write_corrections(file: Path, corrections: Volume) -> None:
    """Write corrections, as small as they are; without any the file is taken away.

    Raises FileError if the file cannot be written.
    """
    low, high = bounds(corrections.array != AS_MADE)
    if not (low < high).all():
        file.unlink(missing_ok=True)
        return
    require_writable_folder(file.parent)
    part = np.asfortranarray(corrections.array[tuple(map(slice, low, high))])
    with atomic_write(file) as temporary:
        write_volume(temporary, Volume(grid=corrections.grid.crop(low, high), array=part), note=NOTE)
