"""Folders of the UNC Med-RAD collection: masks in NIfTI, poses and points as text in RAS."""

from __future__ import annotations

import re
from pathlib import Path

from anatomy.errors import FrameError
from anatomy.grid import Grid
from anatomy.io.files import sha256
from anatomy.io.frames import Frame, read_points, read_pose
from anatomy.io.masks import MaskSource, assemble, read_masks
from anatomy.patient import PatientImages

_ROLES = {
    "bronchialTree": "lumen",
    "vessels": "vessels",
    "pleuralBoundary": "lung",
    "fissures": "fissures",
    "nodule": "nodules",
}
_ENDINGS = (".nii.gz", ".nii")
_FRAME_ON_DISK: Frame = "ras"


def is_med_rad(folder: Path) -> bool:
    """Tell whether a folder holds a Med-RAD patient."""
    return _file(folder, "bronchialTree") is not None


def load_med_rad(folder: Path) -> PatientImages:
    """Read a Med-RAD patient.

    `pleuralBoundary` is, despite its name, a filled mask of both lungs.  The collection does not tell
    the airway wall from the lumen, and does not state the breath hold.

    Raises
    ------
    FrameError
        If a start or target lies outside the images: its numbers are not RAS, or of another patient.
    """
    found = [(_file(folder, stem), role) for stem, role in _ROLES.items()]
    masks = read_masks([MaskSource(role=role, path=path) for path, role in found if path is not None])
    start_files = sorted(folder.glob("start*.txt"), key=_natural)
    target_files = sorted(folder.glob("target*.txt"), key=_natural)
    starts = tuple(read_pose(path, _FRAME_ON_DISK) for path in start_files)
    targets = tuple(point for path in target_files for point in read_points(path, _FRAME_ON_DISK))
    for what, points in (("start", [pose[:3, 3] for pose in starts]), ("target", targets)):
        for point in points:
            _require_inside(masks.grid, point, what, folder)
    return assemble(
        masks,
        name=folder.name,
        kind="med-rad",
        where=folder,
        starts=starts,
        targets_lps=targets,
        sources={path.name: sha256(path) for path in (*start_files, *target_files)},
    )


def _file(folder: Path, stem: str) -> Path | None:
    candidates = (folder / (stem + ending) for ending in _ENDINGS)
    return next((path for path in candidates if path.is_file()), None)


def _natural(path: Path) -> tuple[int, str]:
    digits = re.search(r"\d+", path.stem)
    return (int(digits[0]) if digits else 0, path.name)


def _require_inside(grid: Grid, point: object, what: str, folder: Path) -> None:
    if not grid.contains(point).all():  # type: ignore[arg-type]
        raise FrameError(
            f"A {what} of {folder} lies outside the images, at LPS {point}",
            expected="positions in RAS mm inside the images",
            remedy="Check the frame of the text files, and that they belong to this patient",
        )
