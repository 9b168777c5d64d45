"""Output of TotalSegmentator: a folder of masks, a label map, or both side by side."""

from collections.abc import Mapping
from pathlib import Path

from anatomy.base.files import sha256
from anatomy.io.assembly import assemble
from anatomy.io.images import image_stem, images_in
from anatomy.io.label_names import LUNG_VESSELS, label_values, published_names, stored_names
from anatomy.io.lungs import fill_lung
from anatomy.io.masks import MaskSource, read_masks
from anatomy.io.near_names import plain, require_single
from anatomy.lobes import lobe_named
from anatomy.patient import PatientImages

ROLES: Mapping[str, str] = {
    "lung_airways": "lumen",
    "lung_trachea_bronchia": "lumen",
    "trachea": "lumen",
    "lung_airways_wall": "wall",
    "lung_arteries": "vessels",
    "lung_veins": "vessels",
    "lung_vessels": "vessels",
    "lung_upper_lobe_left": "lobes",
    "lung_lower_lobe_left": "lobes",
    "lung_upper_lobe_right": "lobes",
    "lung_middle_lobe_right": "lobes",
    "lung_lower_lobe_right": "lobes",
    "lung_left": "lung",
    "lung_right": "lung",
    "lung": "lung",
    "lung_nodules": "nodules",
}
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

    Args:
        folder: Holds one mask a structure (`lung_airways.nii.gz`, ...), or label maps whose labels are named
            in the header or a side-car, or both.
        label_map: A file of the folder to read as a label map even if it names no labels.

    Raises:
        AnatomyError: If a structure is missing or empty, or labels cannot be told apart.
    """
    sources, statements = mask_sources(folder, label_map)
    masks = read_masks(sources)
    filled = fill_lung(masks)
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
            return _named_sources(path, names), statement
    return [MaskSource(role=ROLES[stem], path=path, lobe=_lobe(stem))], []


def _label_names(path: Path, *, must_have: bool) -> tuple[dict[int, str], list[str]]:
    """Return the names of the labels of a file, and a statement if they had to be inferred."""
    names = stored_names(path)
    if names:
        return names, []
    stem = image_stem(path)
    if stem != "lung_vessels" and not must_have and not stem.startswith("total"):
        return {}, []
    values = label_values(path)
    is_mask = values <= {0, 1} or any(value % 1 for value in values)
    if stem == "lung_vessels" and (is_mask or (len(values) == 2 and not values <= {0, *LUNG_VESSELS})):
        return {}, []
    table, statement = published_names(stem, values, path)
    return table, [statement]


def _named_sources(path: Path, names: Mapping[int, str]) -> list[MaskSource]:
    values_of: dict[tuple[str, int], list[int]] = {}
    for value, name in names.items():
        if name in ROLES and value != 0:
            values_of.setdefault((ROLES[name], _lobe(name)), []).append(value)
    return [
        MaskSource(role=role, path=path, labels=tuple(sorted(values)), lobe=lobe)
        for (role, lobe), values in values_of.items()
    ]


def _lobe(name: str) -> int:
    """Return the number of the lobe of a structure, 0 for any other."""
    return lobe_named(name) if ROLES[name] == "lobes" else 0
