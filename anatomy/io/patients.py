"""Finds out what kind of patient a path holds, and reads it."""

from __future__ import annotations

from pathlib import Path

from anatomy.errors import FileError
from anatomy.io.images import image_suffix
from anatomy.io.med_rad import is_med_rad, load_med_rad
from anatomy.io.own_masks import DESCRIPTION, load_own_masks
from anatomy.io.totalsegmentator import is_totalsegmentator, load_totalsegmentator
from anatomy.patient import PatientImages


def load_patient(path: str | Path) -> PatientImages:
    """Read a patient from disk.

    Parameters
    ----------
    path : str or Path
        A folder with a `patient.toml`, a Med-RAD folder, a folder with output of TotalSegmentator; or a
        `.toml` file, or a label map of TotalSegmentator with the lobes beside it.

    Returns
    -------
    PatientImages

    Raises
    ------
    AnatomyError
        If a mask is missing, empty, or holds NaN.
    FileError
        If the path is of none of these kinds, or a file is damaged.
    FrameError
        If a file states no frame, or one whose axes are not perpendicular.
    GridMismatchError
        If the masks do not share one voxel grid.
    SettingsError
        If a `patient.toml` is wrong.

    Examples
    --------
    >>> load_patient("nowhere")
    Traceback (most recent call last):
    anatomy.errors.FileError: There is no patient at nowhere. ...
    """
    path = Path(path)
    if path.is_file() and path.suffix == ".toml":
        return load_own_masks(path)
    if path.is_file() and image_suffix(path):
        return load_totalsegmentator(path.parent, label_map=path)
    if path.is_dir():
        if (path / DESCRIPTION).is_file():
            return load_own_masks(path / DESCRIPTION)
        if is_med_rad(path):
            return load_med_rad(path)
        if is_totalsegmentator(path):
            return load_totalsegmentator(path)
    raise FileError(
        f"There is no patient at {path}" if not path.exists() else f"{path} is no patient of a known kind",
        expected="a folder with patient.toml, a Med-RAD folder, or output of TotalSegmentator's lung_vessels",
        remedy="docs/reference/patients.md describes the three kinds of folders",
    )
