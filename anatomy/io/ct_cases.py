"""Data sets that hold a CT with some masks: AeroPath (airway, lungs) and ATM'22 (airway).

Their cases are not patients yet, because the vessels are missing; `lungaccess segment` makes the missing
masks from the CT.
"""

import re
from pathlib import Path

from anatomy.base.errors import FileError
from anatomy.base.records import frozen_value

_AEROPATH = re.compile(
    r"(?P<case>.+)_CT_HR(?P<label>_label_airways|_label_lungs|)\.nii(\.gz)?", re.IGNORECASE
)
_ATM = re.compile(r"(?P<case>ATM_\d+)_0000\.nii(\.gz)?", re.IGNORECASE)
_ATM_FOLDERS = ("imagesTr", "labelsTr")


@frozen_value
class CtCase:
    """A case of a data set: its CT, and the masks that came with it."""

    data_set: str
    name: str
    ct: Path
    airway: Path
    lungs: Path | None = None

    @property
    def lacks(self) -> str:
        """The masks that a patient needs and this case lacks, in words."""
        return "vessels" if self.lungs else "vessels and lungs"

    @property
    def out(self) -> str:
        """A name for the folder of its masks."""
        return re.sub(r"[^a-z0-9]+", "-", f"{self.data_set}-{self.name}".lower()).strip("-")


def ct_case(path: Path) -> CtCase | None:
    """Return the case of AeroPath or ATM'22 that a path stands for, or None.

    A case of AeroPath is its folder; a case of ATM'22 is one of its files, in imagesTr or labelsTr.
    """
    return _aeropath(path) if path.is_dir() else _atm(path)


def require_no_ct_case(path: Path) -> None:
    """Refuse a case of a data set that lacks masks, with the command that makes them.

    Raises FileError if the path is such a case, or the folder of a data set, whose cases are then listed.
    """
    case = ct_case(path)
    if case is not None:
        raise FileError(
            f"{path} is case {case.name} of {case.data_set}: there are no masks of {case.lacks}",
            expected="masks of airway, vessels and lungs",
            remedy=f"Make the missing ones from its CT, which takes minutes: lungaccess segment {path} "
            f"--out {case.out}; then use the folder {case.out}",
        )


def cases_in(folder: Path) -> list[Path]:
    """Return the paths of the cases of AeroPath or ATM'22 in the folder of a data set or a part of it."""
    if not folder.is_dir():
        return []
    parts = [folder / name for name in _ATM_FOLDERS]
    files = folder if folder.name in _ATM_FOLDERS else next((part for part in parts if part.is_dir()), None)
    if files is not None:
        return [path for path in sorted(files.iterdir()) if _atm(path) is not None]
    number = {path: int(path.name) if path.name.isdigit() else 1 << 31 for path in folder.iterdir()}
    by_number = sorted(number, key=lambda path: (number[path], "" if path.name.isdigit() else path.name))
    return [path for path in by_number if path.is_dir() and _aeropath(path)]


def _aeropath(folder: Path) -> CtCase | None:
    found: dict[str, dict[str, Path]] = {}
    for path in folder.iterdir():
        match = _AEROPATH.fullmatch(path.name)
        if match and path.is_file():
            found.setdefault(match["case"], {})[match["label"].lower()] = path
    whole = [(case, files) for case, files in found.items() if {"", "_label_airways"} <= files.keys()]
    if len(whole) != 1:
        return None
    case, files = whole[0]
    return CtCase(
        data_set="AeroPath",
        name=case,
        ct=files[""],
        airway=files["_label_airways"],
        lungs=files.get("_label_lungs"),
    )


def _atm(path: Path) -> CtCase | None:
    match = _ATM.fullmatch(path.name)
    if not match or path.parent.name not in _ATM_FOLDERS:
        return None
    ct, airway = (path.parent.parent / folder / path.name for folder in _ATM_FOLDERS)
    if not (ct.is_file() and airway.is_file()):
        return None
    return CtCase(data_set="ATM'22", name=match["case"], ct=ct, airway=airway)
