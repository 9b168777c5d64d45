"""Many mask files of one patient read side by side onto one grid."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from os.path import commonpath
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.errors import AnatomyError
from anatomy.grid import Grid, Volume
from anatomy.io.files import sha256
from anatomy.io.frames import Frame
from anatomy.io.images import read_mask, read_volume
from anatomy.io.nifti import require_numbers
from anatomy.patient import PatientImages
from anatomy.records import frozen_record, frozen_value
from anatomy.typed import Array, Mask

_READERS = 2  # decompression releases the interpreter; more threads only raise the peak of memory
_REQUIRED = ("lumen", "vessels", "lung")
_MAY_BE_EMPTY = ("fissures", "nodules")


@frozen_value
class MaskSource:
    """A file that makes up (a part of) the mask `role`, one of `anatomy.patient.MASKS`.

    Of the file count the voxels of the labels, or, if there are none, all but zero.
    """

    role: str
    path: Path
    labels: tuple[int, ...] = ()


@frozen_record
class MaskSet:
    """The masks by role, the file names each came from, and the SHA-256 of every file.

    Files in different folders are named from their common folder on.
    """

    grid: Grid
    masks: Mapping[str, Mask]
    files: Mapping[str, tuple[str, ...]]
    sources: Mapping[str, str]


def read_masks(sources: Sequence[MaskSource], frame: Frame | None = None) -> MaskSet:
    """Read all files, each once, and unite the parts of every role.

    Raises
    ------
    AnatomyError, FileError, FrameError
        As `read_mask`.
    GridMismatchError
        If a file lies on another grid than the first; it is named.
    """
    paths = list(dict.fromkeys(source.path for source in sources))
    folder = commonpath([path.parent for path in paths]) if paths else ""
    masks: dict[str, Mask] = {}
    hashes: dict[str, str] = {}
    grid: Grid | None = None
    with ThreadPoolExecutor(_READERS) as pool:
        read = pool.map(lambda path: _read_file(path, sources, frame), paths)
        for path, (file_grid, parts, digest) in zip(paths, read, strict=True):
            grid = grid or file_grid
            grid.require_same(file_grid, path.name)
            hashes[path.relative_to(folder).as_posix()] = digest
            for role, mask in parts.items():
                _unite(masks, role, mask)
    if grid is None:
        raise AnatomyError("No mask was given", expected="masks of airway, vessels and lung")
    return MaskSet(grid=grid, masks=masks, files=_files_by_role(sources), sources=hashes)


def _read_file(
    path: Path, sources: Sequence[MaskSource], frame: Frame | None
) -> tuple[Grid, dict[str, Mask], str]:
    masks: dict[str, Mask] = {}
    sources = [source for source in sources if source.path == path]
    if not any(source.labels for source in sources):
        volume = read_mask(path, frame=frame)
        for source in sources:
            masks[source.role] = volume.array
    else:
        volume = read_volume(path, frame=frame)
        require_numbers(volume.array, path)
        for source in sources:
            _unite(masks, source.role, select(volume.array, source.labels))
    return volume.grid, masks, sha256(path)


def select(values: Array, labels: tuple[int, ...]) -> Mask:
    """Return where `values` is one of `labels`, or not zero if there are none."""
    if not labels:
        return np.asarray(values != 0)
    mask = values == labels[0]
    for label in labels[1:]:
        mask |= values == label
    return np.asarray(mask)


def _unite(masks: dict[str, Mask], role: str, mask: Mask) -> None:
    if role not in masks:
        masks[role] = mask
    elif masks[role].flags.writeable:
        masks[role] |= mask
    else:
        masks[role] = masks[role] | mask


def _files_by_role(sources: Sequence[MaskSource]) -> dict[str, tuple[str, ...]]:
    names: dict[str, list[str]] = {}
    for source in sources:
        names.setdefault(source.role, []).append(source.path.name)
    return {role: tuple(files) for role, files in names.items()}


def assemble(masks: MaskSet, *, name: str, kind: str, where: Path, **others: Any) -> PatientImages:
    """Make the `PatientImages` of masks that were read, after checking that none is missing or empty.

    Parameters
    ----------
    masks : MaskSet
    name, kind : str
        As in `PatientImages`.
    where : Path
        The patient's folder, for messages.
    others
        Further fields of `PatientImages`; `warnings` and `sources` are added to.

    Raises
    ------
    AnatomyError
        If lumen, vessels or lung is missing, or a mask is empty.  An empty mask of fissures or nodules
        only causes a warning.
    """
    missing = [role for role in _REQUIRED if role not in masks.masks]
    if missing:
        raise AnatomyError(
            f"{where} holds no mask of: {', '.join(missing)}",
            expected="masks of the airway lumen, the vessels and the lung",
            remedy="docs/reference/patients.md lists the file names that are understood",
        )
    volumes: dict[str, Any] = {}
    warnings = list(others.pop("warnings", ()))
    for role, mask in masks.masks.items():
        if mask.any():
            volumes[role] = Volume(grid=masks.grid, array=mask)
        else:
            warnings.append(_empty(role, masks.files[role]))
    return PatientImages(
        name=name,
        kind=kind,
        grid=masks.grid,
        sources={**masks.sources, **others.pop("sources", {})},
        warnings=tuple(warnings),
        **volumes,
        **others,
    )


def _empty(role: str, files: tuple[str, ...]) -> str:
    if role in _MAY_BE_EMPTY:
        return f"The mask of {role} ({', '.join(files)}) is empty; it is taken as absent"
    raise AnatomyError(
        f"The mask of {role} is empty ({', '.join(files)})",
        expected="at least one voxel that is not zero",
        remedy="Segment the structure again, or remove the file if the structure is unknown",
    )


def require_cost(volume: Volume, grid: Grid, path: Path) -> Volume:
    """Return a cost map as float32 on the grid of the masks.

    Raises
    ------
    GridMismatchError
        If it lies on another grid.
    """
    grid.require_same(volume.grid, path.name)
    return Volume(grid=grid, array=volume.array.astype(np.float32))
