"""Finds out what kind of patient a path holds, and reads it."""

from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import NoReturn

from anatomy.base.errors import FileError
from anatomy.io.assembly import DESCRIBE_YOURSELF
from anatomy.io.corrections import corrected
from anatomy.io.ct_cases import cases_in, require_no_ct_case
from anatomy.io.dicom_seg import is_dicom
from anatomy.io.images import image_suffix, images_in, read_volume
from anatomy.io.liver import is_liver
from anatomy.io.med_rad import is_med_rad, load_med_rad, lung_sources, require_roles
from anatomy.io.near_names import by_name
from anatomy.io.own_masks import DESCRIPTION, load_own_masks, motion_alone, with_motion
from anatomy.io.totalsegmentator import has_lobes, is_totalsegmentator, load_totalsegmentator
from anatomy.patient import PatientImages

_SHOWN = 12
"""A long list shows this many of its names."""
AIR_HU = -500.0
"""A CT of the chest holds voxels of less density; masks and label maps hold none below 0."""


def load_patient(path: str | Path, *, as_made: bool = False) -> PatientImages:
    """Read a patient's lungs from disk.

    Args:
        path: A folder with a `patient.toml`, a lung of Med-RAD, a folder with output of TotalSegmentator,
            beside which a `patient.toml` may name the motion alone; or a `.toml` file, or a label map of
            TotalSegmentator with the lobes beside it.
        as_made: Without what a person corrected by hand.

    Raises:
        AnatomyError: If a mask is missing, empty, or holds NaN.
        FileError: If the path is of none of these kinds, or a file is damaged.  The message names what the
            folder looks like: a liver, a case without masks of vessels, the folder of a data set and its
            cases.
        FrameError: If a file states no frame, or one whose axes are not perpendicular, or lies far from the
            others.
        SettingsError: If a `patient.toml` is wrong.

    Examples:
        >>> load_patient("nowhere")
        Traceback (most recent call last):
        anatomy.base.errors.FileError: There is no patient at nowhere. ...
    """
    path = Path(path)
    if not path.exists():
        raise FileError(
            f"There is no patient at {path}", expected="an existing folder or file", remedy="Check the path"
        )
    images = _load_file(path) if path.is_file() else _load_folder(path)
    return images if as_made else corrected(images, path)


def _load_folder(path: Path) -> PatientImages:
    description = path / DESCRIPTION
    motion = motion_alone(description) if description.is_file() else None
    if description.is_file() and motion is None:
        return load_own_masks(description)
    kinds = ((is_med_rad, load_med_rad), (is_totalsegmentator, load_totalsegmentator))
    images = next((load(path) for is_kind, load in kinds if is_kind(path)), None)
    if images is None:
        _refuse(path)
    return images if motion is None else with_motion(images, motion, description)


def is_ct(path: Path) -> bool:
    """Return whether a path is a CT and no patient: a folder of DICOM slices, or an image that holds air."""
    if path.is_dir():
        files = (each for each in path.rglob("*") if each.is_file())
        # The first files tell whether a folder holds DICOM; a few of them may be something else.
        return not _here(path) and any(is_dicom(each) for each in islice(files, 20))
    return image_suffix(path) is not None and float(read_volume(path).array.min()) <= AIR_HU


def _load_file(path: Path) -> PatientImages:
    if path.suffix == ".toml":
        return load_own_masks(path)
    require_no_ct_case(path)
    if image_suffix(path):
        return load_totalsegmentator(path.parent, label_map=path)
    raise FileError(
        f"{path} is no patient",
        expected="a folder, a patient.toml, or a label map of TotalSegmentator",
        remedy="Name the folder that holds the masks",
    )


def _refuse(folder: Path) -> NoReturn:
    """Raise an error that says what a folder is that is no patient, or nearly one."""
    if is_liver(folder):
        raise FileError(
            f"{folder} is a liver of Med-RAD: without airways no bronchoscope can be planned for it",
            expected="a lung",
            remedy="For a liver there are `lungaccess info`, `lungaccess needle` and `lungaccess route`, "
            "which takes --lumen portal-vein, hepatic-vein or hepatic-artery",
        )
    held = by_name(folder)
    brain = [name for name in ("brain", "ventricles", "globipallidi", "globipaladii") if name in held]
    if "brain" in brain and (len(brain) > 1 or "vessels" in held):
        raise FileError(
            f"{folder} is a brain of Med-RAD ({', '.join(brain)}): brains are not planned for",
            expected="a lung or a liver",
            remedy="Of Med-RAD, the folders of Lungs and Liver are understood",
        )
    require_no_ct_case(folder)
    if lung_sources(folder):
        if has_lobes(folder):
            raise FileError(
                f"{folder} holds lobes of TotalSegmentator, but neither airways nor vessels",
                expected="output of the tasks total and lung_vessels in one folder",
                remedy=f"Run TotalSegmentator -i CT.nii.gz -o {folder} --task lung_vessels",
            )
        require_roles(folder, lung_sources(folder))
    # Patients, of any kind, that lie one or two folders below, or the cases of a data set.
    below = _folders_in(folder)
    within = cases_in(folder) or [path for each in below for path in _here(each) or _below(each)]
    if within:
        shown = ", ".join(str(path.relative_to(folder)) for path in within[:_SHOWN])
        rest = f" and {len(within) - _SHOWN} more" if len(within) > _SHOWN else ""
        raise FileError(
            f"{folder} is not one patient, it holds {len(within)}: {shown}{rest}",
            expected="one of them",
            remedy=f"Name one, such as {within[0]}",
        )
    there = ", ".join([path.name for path in images_in(folder)][:_SHOWN]) or "no image at all"
    raise FileError(
        f"{folder} is no patient of a known kind: it holds {there}",
        expected="a folder of Med-RAD (bronchialTree, vessels, pleuralBoundary), output of TotalSegmentator "
        "(task lung_vessels), a case of AeroPath or ATM'22, or a folder with a patient.toml",
        remedy=DESCRIBE_YOURSELF,
    )


def _below(folder: Path) -> list[Path]:
    """Return the patients one folder below, or the cases of a data set in a folder."""
    return cases_in(folder) or [path for below in _folders_in(folder) for path in _here(below)]


def _here(folder: Path) -> list[Path]:
    known: tuple[Callable[[Path], bool], ...] = (is_med_rad, is_liver, is_totalsegmentator)
    return [folder] if (folder / DESCRIPTION).is_file() or any(kind(folder) for kind in known) else []


def _folders_in(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
