"""Lungs of the UNC Med-RAD collection, and the starts and targets of its folders, which are RAS text."""

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.base.errors import AnatomyError, FrameError
from anatomy.base.files import sha256
from anatomy.grid import Grid
from anatomy.io.assembly import DESCRIBE_YOURSELF, LUNG_ROLES, assemble
from anatomy.io.frames import Frame, read_points, read_pose
from anatomy.io.masks import MaskSource, read_masks
from anatomy.io.near_names import by_name, looks_like, plain, require_single
from anatomy.lobes import lobe_named
from anatomy.patient import PatientImages

LUNG_FILES: Mapping[str, tuple[str, ...]] = {
    "lumen": ("bronchialTree", "airway", "airways", "bronchi", "airwayTree"),
    "vessels": ("vessels", "vessel", "bloodVessels"),
    "lung": ("pleuralBoundary", "lungs", "lung"),
    "fissures": ("fissures", "fissure"),
}
"""Names of the files of a lung by role, that of the collection first; the case of letters is the same."""
_FRAME_ON_DISK: Frame = "ras"


def is_med_rad(folder: Path) -> bool:
    """Tell whether a folder holds a lung of Med-RAD: a bronchial tree, and vessels, lungs or lobes."""
    roles = {source.role for source in lung_sources(folder)}
    return "lumen" in roles and len(roles) > 1


def load_med_rad(folder: Path) -> PatientImages:
    """Read a lung of Med-RAD.

    `pleuralBoundary` is, despite its name, a filled mask of both lungs; the respiratory part has lobes
    instead.  The collection does not tell the airway wall from the lumen, and does not state the breath
    hold.  Raises FrameError if a start or target lies outside the images: its numbers are not RAS, or of
    another patient.
    """
    sources = lung_sources(folder)
    require_roles(folder, sources)
    lobes = combinations((source for source in sources if source.role == "lobes"), 2)
    alike = ((a.path, b.path) for a, b in lobes if a.lobe == b.lobe)
    doubles = require_single(folder, [source.path for source in sources], alike)
    masks = read_masks(sources)
    poses, hashes = text_poses(folder, masks.grid)
    return assemble(
        masks,
        name=folder.resolve().name,
        kind="med-rad",
        where=folder,
        sources=hashes,
        warnings=(*doubles, *_not_read(folder, sources)),
        **poses,
    )


def _not_read(folder: Path, sources: Sequence[MaskSource]) -> Iterator[str]:
    """Say which images are not read: by the names of `LUNG_FILES` another one comes first, or none fits."""
    images = by_name(folder)
    read = {source.role: source.path for source in sources}
    known = {*(plain(name) for names in LUNG_FILES.values() for name in names)}
    taken = {source.path for source in sources}
    for stem, path in images.items():
        if path not in taken and stem not in known:
            yield f"{path.name} is not read: a lung has no mask of this name, and nothing keeps clear of it."
    for role, names in LUNG_FILES.items():
        for path in (images[plain(name)] for name in names if plain(name) in images):
            if role in read and path != read[role]:
                yield f"{path.name} is not read: {read[role].name}, whose name comes first, shows the {role}."


def lung_sources(folder: Path) -> list[MaskSource]:
    """Return the masks of a lung that a folder holds by the names of Med-RAD."""
    images = by_name(folder)
    sources = [
        MaskSource(role="lobes", path=path, lobe=lobe_named(name))
        for name, path in images.items()
        if lobe_named(name)
    ]
    for role, names in LUNG_FILES.items():
        path = next((images[plain(name)] for name in names if plain(name) in images), None)
        if path is None and role == "lumen":
            # The name of the one bronchial tree may begin or end with that of its case.
            holding = [path for stem, path in images.items() if "bronchialtree" in stem]
            path = holding[0] if len(holding) == 1 else None
        if path is not None:
            sources.append(MaskSource(role=role, path=path))
    return [*sources, *numbered_nodules(images)]


def numbered_nodules(images: Mapping[str, Path]) -> list[MaskSource]:
    """Return the masks called nodule, nodules, tumour, nodule1, nodule2 and so on, with these numbers."""
    found = [(re.fullmatch(r"(?:nodule|tumou?r)s?(\d*)", stem), path) for stem, path in images.items()]
    return [
        MaskSource(role="nodules", path=path, nodule=int(match[1] or 0)) for match, path in found if match
    ]


def text_poses(folder: Path, grid: Grid) -> tuple[dict[str, Any], dict[str, str]]:
    """Read the files whose names end in `start1` and the like as poses, and `target` and the like as points.

    A name that holds both, such as `target1_start2.txt`, is a start.  Returned are fields of `PatientImages`,
    starts `(4, 4)` and targets `(3,)` LPS mm and their names, and the SHA-256 of the files.  Raises FileError
    if a file holds no pose or point, and FrameError if a position lies outside `grid`.
    """
    texts = sorted(
        folder.glob("*.[tT][xX][tT]"),
        key=lambda path: ([int(digits) for digits in re.findall(r"\d+", path.stem)], path.name),
    )
    start_files = [path for path in texts if re.search(r"start_?\d*$", path.stem.lower())]
    target_files = [path for path in texts if re.fullmatch(r"targets?_?\d*", path.stem.lower())]
    starts = tuple(read_pose(path, _FRAME_ON_DISK) for path in start_files)
    points = [(path.stem, read_points(path, _FRAME_ON_DISK)) for path in target_files]
    targets = [
        (stem if len(of_file) == 1 else f"{stem}.{n + 1}", point)
        for stem, of_file in points
        for n, point in enumerate(of_file)
    ]
    for what, places in (("start", [pose[:3, 3] for pose in starts]), ("target", [p for _, p in targets])):
        for place in places:
            if not grid.contains(place).all():
                flipped = place * np.array([-1.0, -1.0, 1.0])
                hint = "; taken as LPS it would lie inside" if grid.contains(flipped).all() else ""
                where = ", ".join(f"{x:.1f}" for x in place)
                raise FrameError(
                    f"A {what} of {folder} lies outside the images, at LPS ({where}) mm{hint}",
                    expected="positions in RAS mm inside the images",
                    remedy="Check the frame of the text files, and that they belong to this patient",
                )
    poses = {
        "starts": starts,
        "start_names": tuple(path.stem for path in start_files),
        "targets_lps": tuple(point for _, point in targets),
        "target_names": tuple(name for name, _ in targets),
    }
    return poses, {path.name: sha256(path) for path in (*start_files, *target_files)}


def require_roles(folder: Path, sources: list[MaskSource]) -> None:
    """Refuse a folder that lacks a mask, and say which file is missing and which one looks like it.

    Raises AnatomyError if lumen, vessels, or lungs and lobes are missing.
    """
    found = {"lung" if source.role == "lobes" else source.role for source in sources}
    missing = [role for role in LUNG_ROLES if role not in found]
    if missing:
        words = " and ".join(LUNG_ROLES[role] for role in missing)
        files = ", ".join(f"{LUNG_FILES[role][0]}.nii.gz ({what})" for role, what in LUNG_ROLES.items())
        raise AnatomyError(
            f"{folder} holds some masks of lungs, but no mask of {words}. "
            f"{_missing_files(folder, missing, sources)}",
            expected=f"{files}; instead of pleuralBoundary also the lobes LUL, LLL, RUL, RML, RLL",
            remedy=DESCRIBE_YOURSELF,
        )


def _missing_files(folder: Path, missing: list[str], sources: list[MaskSource]) -> str:
    """Say of each missing role which image of the folder looks like it, and what else is there."""
    used = {source.path for source in sources}
    unused = {name: path for name, path in by_name(folder).items() if path not in used}
    alike = {role: looks_like(LUNG_FILES[role], unused) for role in missing}
    sentences = [
        f"{file.name} looks like {LUNG_FILES[role][0]}.nii.gz" for role, file in alike.items() if file
    ]
    there = ", ".join(path.name for path in unused.values())
    return "; ".join([*sentences, f"images of unknown name: {there or 'none'}"])
