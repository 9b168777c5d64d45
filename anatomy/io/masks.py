"""Many mask files of one patient, each placed on one grid by its own header."""

from __future__ import annotations

import os.path
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from anatomy.base.errors import AnatomyError
from anatomy.base.files import sha256
from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.typed import Array, Mask, UInt8
from anatomy.grid import Grid
from anatomy.io.frames import Frame
from anatomy.io.images import read_grid, read_mask, read_volume
from anatomy.io.placement import Placed, covers_same_voxels, place, union_grid
from anatomy.io.placement_words import moved, placement
from anatomy.io.voxels import require_numbers

_READERS = 2  # decompression releases the interpreter; more threads only raise the peak of memory
SOLID = ("wall", "vessels", "fissures", "hepatic-vein", "portal-vein", "hepatic-artery")
"""Obstacles: none of their voxels may be lost where they are put on another grid."""
EXTENT = ("lumen", "lung", "lobes")
"""Roles whose files decide how far the common grid reaches."""


@frozen_value
class MaskSource:
    """A file that makes up (a part of) the mask `role`, one of `anatomy.patient.MASKS` or "lobes".

    Of the file count the voxels of the labels, or, if there are none, all but zero.  `lobe` is the number of
    the lobe for the role "lobes".
    """

    role: str
    path: Path
    labels: tuple[int, ...] = ()
    lobe: int = 0


@frozen_record
class MaskSet:
    """The masks by role, the files each came from, the SHA-256 of every file, and how files were placed.

    Files in different folders are named from their common folder on.  `lobes` are numbers of
    `anatomy.lobes.LOBES`, if there are lobes; their own role is "lobes" in `files` alone.
    """

    grid: Grid
    masks: Mapping[str, Mask]
    files: Mapping[str, tuple[str, ...]]
    sources: Mapping[str, str]
    lobes: UInt8 | None = None
    statements: tuple[str, ...] = ()


def read_masks(
    sources: Sequence[MaskSource], frame: Frame | None = None, *, extent: Sequence[str] = EXTENT
) -> MaskSet:
    """Read all files, each once, and unite the parts of every role on one grid.

    The grid is that of the first file, of the lumen if there is one, continued as far as the files of the
    roles in `extent` reach.  A file on another grid is placed by its own header, and a statement says how.

    Raises
    ------
    AnatomyError, FileError, FrameError
        As `read_mask`; or if a file of the lungs or lumen lies far from the others.
    """
    paths = list(dict.fromkeys(source.path for source in sources))
    if not paths:
        raise AnatomyError("No mask was given", expected="masks of airway, vessels and lung")
    grids = {path: read_grid(path, frame=frame) for path in paths}
    basis = next((source.path for source in sources if source.role == "lumen"), paths[0])
    reaching = dict.fromkeys(source.path for source in sources if source.role in extent)
    grid = union_grid(grids[basis], [(path.name, grids[path]) for path in reaching])
    gathered = _Gathered(grid, basis.name, grids[basis])
    folder = os.path.commonpath([os.path.abspath(path.parent) for path in paths])
    hashes: dict[str, str] = {}
    with ThreadPoolExecutor(_READERS) as pool:
        read = pool.map(lambda path: _read_file(path, sources, frame), paths)
        for path, (file_grid, parts, digest) in zip(paths, read, strict=True):
            hashes[Path(os.path.relpath(os.path.abspath(path), folder)).as_posix()] = digest
            gathered.add(path.name, file_grid, parts)
    return MaskSet(
        grid=grid,
        masks=gathered.masks,
        files=_files_by_role(sources),
        sources=hashes,
        lobes=gathered.lobes,
        statements=tuple(gathered.finish()),
    )


class _Gathered:
    """The masks of the files read so far, on one grid."""

    def __init__(self, grid: Grid, basis: str, basis_grid: Grid) -> None:
        self._grid, self._basis, self._basis_grid = grid, basis, basis_grid
        self._later: list[Callable[[Mask | None], str]] = []
        self._statements: list[str] = []
        self.masks: dict[str, Mask] = {}
        self.lobes: UInt8 | None = None

    def add(self, name: str, grid: Grid, parts: list[tuple[MaskSource, Mask]]) -> None:
        for source, mask in parts:
            on_grid = mask if self._grid.is_close(grid) else self._placed(name, source.role, grid, mask)
            if source.role != "lobes":
                _unite(self.masks, source.role, on_grid)
                continue
            if self.lobes is None:
                self.lobes = np.zeros(self._grid.shape, dtype=np.uint8, order="F")
            self.lobes[on_grid & (self.lobes == 0)] = source.lobe

    def _placed(self, name: str, role: str, grid: Grid, mask: Mask) -> Mask:
        solid = role in SOLID
        found = place(mask, grid, self._grid, solid=solid)
        if covers_same_voxels(grid, self._basis_grid):
            return np.asarray(found.array)
        if grid.shape == self._basis_grid.shape:
            self._state_move(name, grid, mask, found)
        else:
            self._statements.append(placement(name, role, mask, grid, self._grid, found))
        return np.asarray(found.array)

    def _state_move(self, name: str, grid: Grid, mask: Mask, found: Placed) -> None:
        """Remember to say, once the lungs are known, how much of a file lies in them by its header."""
        by_index = place(mask, self._basis_grid, self._grid).array
        self._later.append(
            lambda lung: moved(
                name,
                self._basis,
                grid.lps(np.zeros(3)) - self._basis_grid.lps(np.zeros(3)),
                found,
                share_by_header=_share(found.array, lung),
                share_by_index=_share(by_index, lung),
            )
        )

    def finish(self) -> Iterable[str]:
        """Yield how files were placed."""
        lung = self.masks.get("lung")
        if lung is None and self.lobes is not None:
            lung = self.lobes > 0
        yield from self._statements
        yield from (later(lung) for later in self._later)


def _share(mask: Array, lung: Mask | None) -> float | None:
    count = np.count_nonzero(mask)
    return None if lung is None or not count else float(np.count_nonzero(mask & lung)) / count


def _read_file(
    path: Path, sources: Sequence[MaskSource], frame: Frame | None
) -> tuple[Grid, list[tuple[MaskSource, Mask]], str]:
    sources = [source for source in sources if source.path == path]
    if not any(source.labels for source in sources):
        volume = read_mask(path, frame=frame)
        parts = [(source, volume.array) for source in sources]
    else:
        volume = read_volume(path, frame=frame)
        require_numbers(volume.array, path)
        parts = [(source, select(volume.array, source.labels)) for source in sources]
    return volume.grid, parts, sha256(path)


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
