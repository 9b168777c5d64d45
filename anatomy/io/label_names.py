"""Which label value of a label map is which structure: header, side-car file, or the published table."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.base.errors import AnatomyError, FileError
from anatomy.base.files import read_json
from anatomy.io.images import image_stem, read_labels, read_volume

# Class tables published with TotalSegmentator [Wasserthal2023]: task lung_vessels since 2.5, and the lobes
# of task total.  Before 2.5, label 1 of lung_vessels was the vessels and 2 the airways, so that a file
# with these two values alone is ambiguous.
LUNG_VESSELS = {1: "lung_airways", 2: "lung_airways_wall", 3: "lung_arteries", 4: "lung_veins"}
TOTAL_LOBES = {
    10: "lung_upper_lobe_left",
    11: "lung_lower_lobe_left",
    12: "lung_upper_lobe_right",
    13: "lung_middle_lobe_right",
    14: "lung_lower_lobe_right",
    16: "trachea",
}
_LAST_LABEL_OF_TOTAL_1 = 104


def stored_names(path: Path) -> dict[int, str]:
    """Read the label names stored with a file: in its header, else in a side-car beside it.

    Side-cars are `<stem>.json` and `<stem>_labels.json`, and for all label maps of a folder `labels.json`
    and `dataset.json`; they map names to values or values to names, directly or under the key "labels".
    A side-car of the folder counts only for files that hold no other values than it names, because a
    CT may lie beside the label map.

    Raises:
        FileError: If a side-car is no JSON object.
    """
    names = dict(read_labels(path))
    stem = image_stem(path)
    for sidecar in (f"{stem}.json", f"{stem}_labels.json"):
        if not names and (path.parent / sidecar).is_file():
            names = _sidecar_names(path.parent / sidecar)
    for sidecar in ("labels.json", "dataset.json"):
        if not names and (path.parent / sidecar).is_file():
            shared = _sidecar_names(path.parent / sidecar)
            names = shared if label_values(path) <= {0, *shared} else {}
    return names


def label_values(path: Path) -> set[float]:
    """Return the values that occur in an image."""
    values: set[float] = set()
    for plane in read_volume(path).array.T:
        values |= set(np.unique(plane).tolist())
    return values


def _sidecar_names(path: Path) -> dict[int, str]:
    content: Any = read_json(
        path,
        expected="label names and values",
        remedy="Correct the file, or take it away if it belongs to nothing here",
    )
    if isinstance(content, Mapping) and isinstance(content.get("labels"), Mapping):
        content = content["labels"]
    if not isinstance(content, Mapping):
        raise FileError(
            f"{path} is not a JSON object",
            expected='{"lung_airways": 1, ...}',
            remedy="Correct the file, or take it away if it belongs to nothing here",
        )
    names: dict[int, str] = {}
    for key, value in content.items():
        if isinstance(value, int) and not isinstance(value, bool):
            names[value] = str(key)
        elif isinstance(value, str) and str(key).isdigit():
            names[int(key)] = value
    return names


def published_names(stem: str, values: set[float], path: Path) -> tuple[dict[int, str], str]:
    """Name the labels of a TotalSegmentator file that stores no names, and say so.

    Args:
        stem: File name without ending; a name that begins with "total" belongs to the task total.
        values (set of numbers): The label values that occur.
        path: For messages.

    Returns:
        - names (dict of label value to name)
        - statement - A warning which table was used.

    Raises:
        AnatomyError: If the values fit more than one published table.
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
