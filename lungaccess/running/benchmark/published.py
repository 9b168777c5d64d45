"""The needle queries that were published with patients: every start pose with every target."""

import re
from collections.abc import Sequence
from pathlib import Path

from anatomy.base.errors import FileError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.liver import LiverImages
from anatomy.organ import Organ
from anatomy.patient import PatientImages

NO_STARTS = "no query: the patient came without start poses"
NO_TARGETS = "no query: the patient came without targets"


@frozen_record
class PublishedQuery:
    """One start pose and one target of a patient, both counted from 1.

    Parameters
    ----------
    lps_from_start : (4, 4) float64
    target_lps : (3,) float64, LPS mm
    """

    patient: str
    start: int
    target: int
    lps_from_start: Float
    target_lps: Float


def published_queries(patient: PatientImages | LiverImages | Organ, name: str) -> list[PublishedQuery]:
    """Return each start of a patient with each of its targets, or with that which its name states.

    A start called `target2_start1` or `nodule2_start1` belongs to `target2` alone.
    """
    return [
        PublishedQuery(patient=name, start=s, target=t, lps_from_start=pose, target_lps=point)
        for s, pose in enumerate(patient.starts, start=1)
        for t, point in enumerate(patient.targets_lps, start=1)
        if _belong_together(patient.start_names[s - 1 : s], patient.target_names[t - 1 : t])
    ]


def _belong_together(start: Sequence[str], target: Sequence[str]) -> bool:
    stated = re.match(r"(?:target|nodule)(\d+)_", "".join(start).lower())
    known = re.fullmatch(r"targets?_?(\d+)", "".join(target).lower())
    return stated is None or known is None or stated[1] == known[1]


def why_no_query(patient: PatientImages | LiverImages | Organ) -> str:
    """Return why a patient has no query; "" if it has one."""
    if not patient.starts:
        return NO_STARTS
    return "" if patient.targets_lps else NO_TARGETS


def patients_of(folder: Path) -> list[Path]:
    """Return the patients that a folder holds, or itself if it is one, in the order of their numbers.

    Raises
    ------
    FileError
        If the folder is not there, or is no patient and holds none.
    """
    from anatomy.io.images import image_suffix

    if not folder.is_dir():
        raise FileError(
            f"There is no folder {folder}",
            expected="a folder of a patient, or a folder of such folders",
            remedy="Check the name and the folder",
        )
    entries = sorted(folder.iterdir(), key=_natural)
    if any(path.is_file() and (image_suffix(path) or path.suffix == ".toml") for path in entries):
        return [folder]
    inner = [path for path in entries if path.is_dir()]
    if not inner:
        raise FileError(
            f"{folder} holds neither images nor folders",
            expected="a patient, or a folder of patients",
            remedy="Name the folder that holds the masks, or the one that holds the patients",
        )
    return inner


def _natural(path: Path) -> tuple[str, int, str]:
    digits = re.search(r"\d+", path.name)
    return (path.name[: digits.start()] if digits else path.name, int(digits[0]) if digits else 0, path.name)
