"""Output of TotalSegmentator: a folder of masks, label maps whose labels have names, or both side by side."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.base.errors import AnatomyError, FileError
from anatomy.base.files import read_json, sha256
from anatomy.io.assembly import assemble, fill_lung
from anatomy.io.images import image_stem, images_in, read_labels, read_volume
from anatomy.io.masks import MaskSource, read_masks
from anatomy.io.near_names import plain, require_single
from anatomy.lobes import lobe_named
from anatomy.patient import PatientImages

# Class tables published with TotalSegmentator [Wasserthal2023]: task lung_vessels since 2.5, and the lobes
# of task total.  Before 2.5, label 1 of lung_vessels was the vessels and 2 the airways, so that a file
# with these two values alone is ambiguous.
LUNG_VESSELS = {1: "lung_airways", 2: "lung_airways_wall", 3: "lung_arteries", 4: "lung_veins"}
TOTAL_LOBES = {
    10: "lung_upper_lobe_left", 11: "lung_lower_lobe_left", 12: "lung_upper_lobe_right",
    13: "lung_middle_lobe_right", 14: "lung_lower_lobe_right", 16: "trachea",
}  # fmt: skip
_LAST_LABEL_OF_TOTAL_1 = 104


def stored_names(path: Path) -> dict[int, str]:
    """Read the label names stored with a file: in its header, else in a side-car beside it.

    Side-cars are `<stem>.json` and `<stem>_labels.json`, and for all label maps of a folder `labels.json` and
    `dataset.json`; they map names to values or values to names, directly or under the key "labels". A
    side-car of the folder counts only for files that hold no other values than it names, because a CT may lie
    beside the label map.  Raises FileError if a side-car is no JSON object.
    """
    names = dict(read_labels(path))
    stem = image_stem(path)
    for sidecar in (f"{stem}.json", f"{stem}_labels.json", *(shared := ("labels.json", "dataset.json"))):
        if not names and (path.parent / sidecar).is_file():
            names = _sidecar_names(path.parent / sidecar)
            if sidecar in shared and not _label_values(path) <= {0, *names}:
                names = {}
    return names


def _label_values(path: Path) -> set[float]:
    """Return the values that occur in an image."""
    values: set[float] = set()
    for plane in read_volume(path).array.T:
        values |= set(np.unique(plane).tolist())
    return values


def _sidecar_names(path: Path) -> dict[int, str]:
    remedy = "Correct the file, or take it away if it belongs to nothing here"
    content: Any = read_json(path, expected="label names and values", remedy=remedy)
    if isinstance(content, Mapping) and isinstance(content.get("labels"), Mapping):
        content = content["labels"]
    if not isinstance(content, Mapping):
        raise FileError(f"{path} is not a JSON object", expected='{"lung_airways": 1, ...}', remedy=remedy)
    names: dict[int, str] = {}
    for key, value in content.items():
        if isinstance(value, int) and not isinstance(value, bool):
            names[value] = str(key)
        elif isinstance(value, str) and str(key).isdigit():
            names[int(key)] = value
    return names


def _published_names(stem: str, values: set[float], path: Path) -> tuple[dict[int, str], str]:
    """Name the labels of a TotalSegmentator file that stores no names, and say which table was used.

    Of a file whose name begins with "total" the task total is meant; `values` are those that occur.  Raises
    AnatomyError if the values fit no published table, or more than one.
    """
    if stem.startswith("total") and max(values, default=0) > _LAST_LABEL_OF_TOTAL_1:
        table, title = TOTAL_LOBES, "task total, version 2"
    elif not stem.startswith("total") and values & {3, 4} and values <= {0, *LUNG_VESSELS}:
        table, title = LUNG_VESSELS, "task lung_vessels, version 2.5 or newer"
    else:
        raise AnatomyError(
            f"{path} names no labels, and {sorted(values - {0})[:9]} fit no or several published tables",
            expected='names in the header, or in a side-car such as labels.json: {"lung_airways": 1}',
            remedy="Write the side-car, or describe the folder by a patient.toml",
        )
    names = {value: name for value, name in table.items() if value in values}
    return names, (
        f"{path.name} names no labels; they were read by TotalSegmentator's published table of {title}: "
        + ", ".join(f"{value} = {name}" for value, name in names.items())
    )


ROLES: Mapping[str, str] = {
    "lung_airways": "lumen", "lung_trachea_bronchia": "lumen", "trachea": "lumen",
    "lung_airways_wall": "wall", "lung_arteries": "vessels", "lung_veins": "vessels",
    "lung_vessels": "vessels", "lung_upper_lobe_left": "lobes", "lung_lower_lobe_left": "lobes",
    "lung_upper_lobe_right": "lobes", "lung_middle_lobe_right": "lobes", "lung_lower_lobe_right": "lobes",
    "lung_left": "lung", "lung_right": "lung", "lung": "lung", "lung_nodules": "nodules",
}  # fmt: skip
_AIRWAY_NAMES = ("lung_airways", "lung_trachea_bronchia")


def is_totalsegmentator(folder: Path) -> bool:
    """Tell whether a folder holds output of the task lung_vessels."""
    images = images_in(folder)
    if {image_stem(path) for path in images} & {*_AIRWAY_NAMES, "lung_vessels"}:
        return True
    return any(set(_AIRWAY_NAMES) & set(stored_names(path).values()) for path in images)


def has_lobes(folder: Path) -> bool:
    """Tell whether a folder holds lobes by TotalSegmentator's names."""
    return any(ROLES.get(image_stem(path)) == "lobes" for path in images_in(folder))


def load_totalsegmentator(folder: Path, label_map: Path | None = None) -> PatientImages:
    """Read the masks of tasks lung_vessels and total from one folder.

    It holds one mask a structure (`lung_airways.nii.gz`, ...), or label maps whose labels are named in the
    header or a side-car, or both.  `label_map` is read as one even if it names no labels.  Raises
    AnatomyError if a structure is missing or empty, or labels cannot be told apart.
    """
    sources, statements = mask_sources(folder, label_map)
    filled = fill_lung(read_masks(sources))
    sidecars = [path for path in folder.glob("*.json") if path.is_file()]
    return assemble(
        filled,
        name=folder.resolve().name,
        kind="totalsegmentator",
        where=folder,
        warnings=tuple(statements),
        sources={path.name: sha256(path) for path in sidecars},
    )


def mask_sources(folder: Path, label_map: Path | None = None) -> tuple[list[MaskSource], list[str]]:
    """Return the files and labels of a folder that make up each mask, and what had to be inferred.

    The parameters and errors are those of `load_totalsegmentator`.
    """
    sources: list[MaskSource] = []
    statements: list[str] = []
    read: dict[str, Path] = {}
    for path in images_in(folder):
        of_file, said = file_sources(path, is_label_map=path == label_map)
        if of_file and read.setdefault(plain(image_stem(path)), path) == path:
            sources += of_file
            statements += said
    statements += require_single(folder, read.values())
    return sources, statements


def file_sources(path: Path, *, is_label_map: bool = False) -> tuple[list[MaskSource], list[str]]:
    """Return the masks of one file, which is named after a structure or has labels that are.

    Nothing is returned for a file that names no structure, unless `is_label_map` says that it must.
    """
    stem = image_stem(path)
    if is_label_map or stem == "lung_vessels" or stem not in ROLES:
        names, statement = _label_names(path, must_have=is_label_map)
        if names or stem not in ROLES:
            values_of: dict[tuple[str, int], list[int]] = {}
            for value, name in names.items():
                if name in ROLES and value != 0:
                    values_of.setdefault((ROLES[name], _lobe(name)), []).append(value)
            return [
                MaskSource(role=role, path=path, labels=tuple(sorted(values)), lobe=lobe)
                for (role, lobe), values in values_of.items()
            ], statement
    return [MaskSource(role=ROLES[stem], path=path, lobe=_lobe(stem))], []


def _label_names(path: Path, *, must_have: bool) -> tuple[dict[int, str], list[str]]:
    """Return the names of the labels of a file, and a statement if they had to be inferred."""
    names = stored_names(path)
    if names:
        return names, []
    stem = image_stem(path)
    if stem != "lung_vessels" and not must_have and not stem.startswith("total"):
        return {}, []
    values = _label_values(path)
    is_mask = values <= {0, 1} or any(value % 1 for value in values)
    if stem == "lung_vessels" and (is_mask or (len(values) == 2 and not values <= {0, *LUNG_VESSELS})):
        return {}, []
    table, statement = _published_names(stem, values, path)
    return table, [statement]


def _lobe(name: str) -> int:
    return lobe_named(name) if ROLES[name] == "lobes" else 0
