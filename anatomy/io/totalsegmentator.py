"""Output of TotalSegmentator: a folder of masks, a label map, or both side by side."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from anatomy.io.files import sha256
from anatomy.io.images import image_stem, image_suffix
from anatomy.io.label_names import label_values, published_names, stored_names
from anatomy.io.masks import MaskSet, MaskSource, assemble, read_masks
from anatomy.morphology import grown_by_one
from anatomy.patient import PatientImages
from anatomy.typed import Mask

ROLES: Mapping[str, str] = {
    "lung_airways": "lumen",
    "lung_trachea_bronchia": "lumen",
    "trachea": "lumen",
    "lung_airways_wall": "wall",
    "lung_arteries": "vessels",
    "lung_veins": "vessels",
    "lung_vessels": "vessels",
    "lung_upper_lobe_left": "lung",
    "lung_lower_lobe_left": "lung",
    "lung_upper_lobe_right": "lung",
    "lung_middle_lobe_right": "lung",
    "lung_lower_lobe_right": "lung",
    "lung_left": "lung",
    "lung_right": "lung",
    "lung": "lung",
    "lung_nodules": "nodules",
}
_AIRWAY_NAMES = ("lung_airways", "lung_trachea_bronchia")


def is_totalsegmentator(folder: Path) -> bool:
    """Tell whether a folder holds output of the task lung_vessels."""
    images = _images(folder)
    if {image_stem(path) for path in images} & {*_AIRWAY_NAMES, "lung_vessels"}:
        return True
    return any(set(_AIRWAY_NAMES) & set(stored_names(path).values()) for path in images)


def load_totalsegmentator(folder: Path, label_map: Path | None = None) -> PatientImages:
    """Read the masks of tasks lung_vessels and total from one folder.

    Parameters
    ----------
    folder : Path
        Holds one mask a structure (`lung_airways.nii.gz`, ...), or label maps whose labels are named
        in the header or a side-car, or both.
    label_map : Path, optional
        A file of the folder to read as a label map even if it names no labels.

    Raises
    ------
    AnatomyError
        If a structure is missing or empty, or labels cannot be told apart.
    """
    sources, statements = mask_sources(folder, label_map)
    masks = read_masks(sources)
    filled = fill_lung(masks)
    sidecars = [path for path in folder.glob("*.json") if path.is_file()]
    return assemble(
        filled,
        name=folder.name,
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
    for path in _images(folder):
        if path == label_map or image_stem(path) == "lung_vessels" or image_stem(path) not in ROLES:
            names, statement = _label_names(path, must_have=path == label_map)
            sources += _named_sources(path, names)
            statements += statement
        else:
            sources.append(MaskSource(role=ROLES[image_stem(path)], path=path))
    return sources, statements


def _images(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_file() and image_suffix(path))


def _label_names(path: Path, *, must_have: bool) -> tuple[dict[int, str], list[str]]:
    """Return the names of the labels of a file, and a statement if they had to be inferred."""
    names = stored_names(path)
    if names:
        return names, []
    stem = image_stem(path)
    if stem != "lung_vessels" and not must_have and not stem.startswith("total"):
        return {}, []
    values = label_values(path)
    if stem == "lung_vessels" and values <= {0, 1}:
        return {1: "lung_vessels"}, []
    table, statement = published_names(stem, values, path)
    return table, [statement]


def _named_sources(path: Path, names: Mapping[int, str]) -> list[MaskSource]:
    labels_of_role: dict[str, list[int]] = {}
    for value, name in names.items():
        if name in ROLES and value != 0:
            labels_of_role.setdefault(ROLES[name], []).append(value)
    return [
        MaskSource(role=role, path=path, labels=tuple(sorted(values)))
        for role, values in labels_of_role.items()
    ]


def fill_lung(masks: MaskSet) -> MaskSet:
    """Count airways and vessels, and the rim between them and a lobe, as lung.

    The lobes leave out the larger bronchi and vessels, and two networks do not agree on a border to the
    voxel.  All that is added is airway or vessel, hence an obstacle, or lies in a gap of at most two voxels
    between one of them and a lobe, so that the mediastinum does not become passable.
    """
    roles = [masks.masks[role] for role in ("lumen", "wall", "vessels") if role in masks.masks]
    if "lung" not in masks.masks or not masks.masks["lung"].any() or not roles:
        return masks
    lobes = masks.masks["lung"]
    tubes: Mask = np.logical_or.reduce(roles)
    lung: Mask = lobes | tubes
    box = _box(lung)
    closed = ~grown_by_one(~grown_by_one(lung[box]))
    lung[box] |= closed & grown_by_one(tubes[box]) & grown_by_one(grown_by_one(lobes[box]))
    return MaskSet(
        grid=masks.grid, masks={**masks.masks, "lung": lung}, files=masks.files, sources=masks.sources
    )


def _box(mask: Mask) -> tuple[slice, ...]:
    """Return the box around all voxels of a mask, two voxels wider on every side."""
    along_jk = np.any(mask, axis=0)
    lines = np.any(mask, axis=(1, 2)), np.any(along_jk, axis=1), np.any(along_jk, axis=0)
    hits = [np.flatnonzero(line) for line in lines]
    return tuple(slice(max(0, int(hit[0]) - 2), int(hit[-1]) + 3) for hit in hits)
