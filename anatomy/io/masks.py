"""Many mask files of one patient, each placed on one grid by its own header."""

import os.path
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np

from anatomy.base.errors import AnatomyError, FrameError
from anatomy.base.files import sha256
from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.typed import Array, Bool, Float, Int, Mask, UInt8, UInt16
from anatomy.base.words import percent
from anatomy.grid import Grid, transform_points
from anatomy.io.frames import Frame
from anatomy.io.images import read_grid, read_parts, read_volume
from anatomy.io.mask_values import PARTS, is_whole

SHIFT_TOLERANCE = 0.05
"""Largest deviation of voxels that count as the same, in voxels: headers are rounded to some digits."""


@frozen_record
class Placed:
    """An image on the grid it was placed on, with the fill value beyond it.

    `n_voxels` of the image are not zero, and `n_lost` of these lie outside the grid; it is resampled if the
    voxels of the two grids do not coincide.
    """

    array: Array
    n_voxels: int
    n_lost: int
    is_resampled: bool


def place(array: Array, source: Grid, target: Grid, *, solid: bool = False, fill: float = 0) -> Placed:
    """Place an image `(ni, nj, nk)` on another grid by the nearest position, with `fill` beyond it.

    With `solid` every voxel that is not zero remains: a voxel of the grid is also set if the centre of one
    lies in it, so that thin obstacles leave no holes in coarser voxels.
    """
    target_from_source = target.ijk_from_lps @ source.lps_from_ijk
    source_from_target = source.ijk_from_lps @ target.lps_from_ijk
    placed = np.full(target.shape, fill, dtype=array.dtype, order="F")
    order = _axis_order(target_from_source, source.shape)
    if order is None:
        _sample_obliquely(array, source_from_target, placed)
    else:
        _sample_along_axes(array, source_from_target, order, placed)
    voxels = np.argwhere(array)
    at = np.floor(transform_points(target_from_source, voxels) + 0.5).astype(np.int64)
    inside = ((at >= 0) & (at < np.array(target.shape))).all(axis=1)
    is_resampled = order is None or not _is_whole(target_from_source, source.shape)
    if solid and is_resampled:
        placed[tuple(at[inside].T)] = array[tuple(voxels[inside].T)]
    return Placed(
        array=placed,
        n_voxels=len(voxels),
        n_lost=int(len(voxels) - np.count_nonzero(inside)),
        is_resampled=is_resampled,
    )


def union_grid(reference: Grid, others: list[tuple[str, Grid]]) -> Grid:
    """Return the voxels of `reference` continued to the box that holds the other grids as well.

    Raises:
        FrameError: If one of them lies so far away that its header, or that of the reference, must be wrong.
    """
    low, high = np.zeros(3), np.array(reference.shape, dtype=np.float64)
    for name, grid in others:
        if reference.is_close(grid):
            continue
        first, last = box_in(reference, grid)
        low, high = np.minimum(low, first), np.maximum(high, last)
        largest = max(np.prod(grid.shape), np.prod(reference.shape))
        finer = max(1.0, grid.voxel_volume_mm3 / reference.voxel_volume_mm3)
        # A box that holds two masks of one body is not larger than this many times the larger of them.
        if not np.prod(high - low) <= 4.0 * largest * finer:
            raise FrameError(
                f"{name} lies apart from the other masks: its header says {grid.describe()}",
                expected=f"a place near {reference.describe()}",
                remedy="Check the header of this file, and whether it belongs to the same patient",
            )
    start, stop = np.floor(low + SHIFT_TOLERANCE), np.ceil(high - SHIFT_TOLERANCE)
    if not start.any() and (stop == reference.shape).all():
        return reference
    return reference.crop(start, stop)


def box_in(reference: Grid, grid: Grid) -> tuple[Float, Float]:
    """Return where a grid begins and ends `(3,)`, in voxels of the reference: `low <= ijk < high`."""
    corners = np.array(list(product(*((-0.5, n - 0.5) for n in grid.shape))))
    ijk = reference.ijk(grid.lps(corners)) + 0.5
    return np.asarray(ijk.min(axis=0)), np.asarray(ijk.max(axis=0))


def covers_same_voxels(grid: Grid, other: Grid) -> bool:
    """Tell whether two grids have the same voxels, in whatever order their axes run."""
    target_from_source = other.ijk_from_lps @ grid.lps_from_ijk
    if _axis_order(target_from_source, grid.shape) is None or not _is_whole(target_from_source, grid.shape):
        return False
    low, high = box_in(other, grid)
    return bool(max(np.abs(low).max(), np.abs(high - other.shape).max()) <= SHIFT_TOLERANCE)


def _axis_order(target_from_source: Float, shape: tuple[int, ...]) -> Int | None:
    """Return which axis of the source runs along each axis of the target; None if axes are oblique."""
    axes = np.abs(target_from_source[:3, :3])
    order = np.argmax(axes, axis=1)
    rest = axes.copy()
    rest[np.arange(3), order] = 0.0
    if len(set(order.tolist())) < 3 or (rest * np.array(shape)).max() > SHIFT_TOLERANCE:
        return None
    return np.asarray(order, dtype=np.int64)


def _is_whole(target_from_source: Float, shape: tuple[int, ...]) -> bool:
    """Tell whether voxels coincide, in whatever order the axes run."""
    corners = np.array(list(product(*((0, n - 1) for n in shape))))
    at = transform_points(target_from_source, corners)
    sizes = np.abs(target_from_source[:3, :3]).max(axis=0)
    steps = np.abs(sizes - 1.0) * np.array(shape)
    return bool(max(np.abs(at - np.rint(at)).max(), steps.max()) <= SHIFT_TOLERANCE)


def _sample_along_axes(array: Array, source_from_target: Float, order: Int, placed: Array) -> None:
    turned = array.transpose(tuple(order))
    index: list[Int] = []
    where: list[Bool] = []
    for axis, source_axis in enumerate(order):
        step, offset = source_from_target[source_axis, axis], source_from_target[source_axis, 3]
        at = np.floor(step * np.arange(placed.shape[axis]) + offset + 0.5).astype(np.int64)
        inside = (at >= 0) & (at < turned.shape[axis])
        index.append(at[inside])
        where.append(inside)
    if all(len(at) for at in index):
        placed[np.ix_(*where)] = turned[np.ix_(*index)]


def _sample_obliquely(array: Array, source_from_target: Float, placed: Array) -> None:
    """Sample plane by plane: the positions of all voxels at once would fill the memory."""
    i, j = np.indices(placed.shape[:2])
    for k in range(placed.shape[2]):
        plane = np.stack([i, j, np.full_like(i, k)], axis=-1)
        at = np.floor(transform_points(source_from_target, plane) + 0.5).astype(np.int64)
        inside = ((at >= 0) & (at < np.array(array.shape))).all(axis=-1)
        placed[:, :, k][inside] = array[tuple(at[inside].T)]


SOLID = ("wall", "vessels", "fissures", "hepatic-vein", "portal-vein", "hepatic-artery")
"""Obstacles: none of their voxels may be lost where they are put on another grid."""
EXTENT = ("lumen", "lung", "lobes")
"""Roles whose files decide how far the common grid reaches."""


@frozen_value
class MaskSource:
    """A file that makes up (a part of) the mask `role`, one of `anatomy.patient.MASKS` or "lobes".

    Of the file count the voxels of the labels, or, if there are none, what is its mask by
    `anatomy.io.mask_values.mask_of`.  `lobe` is the number of the lobe for the role "lobes", `nodule` that of
    the nodule for the role "nodules", 0 if it has none.
    """

    role: str
    path: Path
    labels: tuple[int, ...] = ()
    lobe: int = 0
    nodule: int = 0


@frozen_record
class MaskSet:
    """The masks by role, the files each came from, the SHA-256 of every file, and how files were placed.

    Files in different folders are named from their common folder on.  `lobes` are numbers of
    `anatomy.lobes.LOBES`, if there are lobes; their own role is "lobes" in `files` alone.  `nodule_labels`
    are the numbers of nodules by their files, if these tell more than one apart.
    """

    grid: Grid
    masks: Mapping[str, Mask]
    files: Mapping[str, tuple[str, ...]]
    sources: Mapping[str, str]
    lobes: UInt8 | None = None
    nodule_labels: UInt16 | None = None
    statements: tuple[str, ...] = ()


def read_masks(
    sources: Sequence[MaskSource], frame: Frame | None = None, *, extent: Sequence[str] = EXTENT
) -> MaskSet:
    """Read all files, each once, and unite the parts of every role on one grid.

    The grid is that of the first file, of the lumen if there is one, continued as far as the files of the
    roles in `extent` reach. A file on another grid is placed by its own header, and a statement says how.
    Raises AnatomyError, FileError or FrameError as `read_mask`; or if a file of the lungs or lumen lies far
    from the others.
    """
    paths = list(dict.fromkeys(source.path for source in sources))
    names: dict[str, list[str]] = {}
    for source in sources:
        names.setdefault(source.role, []).append(source.path.name)
    if not paths:
        raise AnatomyError("No mask was given", expected="masks of airway, vessels and lung")
    grids = {path: read_grid(path, frame=frame) for path in paths}
    basis = next((source.path for source in sources if source.role == "lumen"), paths[0])
    reaching = dict.fromkeys(source.path for source in sources if source.role in extent)
    grid = union_grid(grids[basis], [(path.name, grids[path]) for path in reaching])
    gathered = _Gathered(grid, basis.name, grids[basis])
    folder = os.path.commonpath([os.path.abspath(path.parent) for path in paths])
    hashes: dict[str, str] = {}
    # Decompression releases the interpreter; more threads would only raise the peak of memory.
    with ThreadPoolExecutor(2) as pool:
        read = pool.map(lambda path: _read_file(path, sources, frame), paths)
        for path, (file_grid, parts, digest, said) in zip(paths, read, strict=True):
            hashes[Path(os.path.relpath(os.path.abspath(path), folder)).as_posix()] = digest
            gathered.add(path.name, file_grid, parts, said)
    return MaskSet(
        grid=grid,
        masks=gathered.masks,
        files={role: tuple(files) for role, files in names.items()},
        sources=hashes,
        lobes=gathered.lobes,
        nodule_labels=gathered.nodule_labels
        if len(gathered.nodules) > 1 and 0 not in gathered.nodules
        else None,
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
        self.nodules: set[int] = set()
        self.nodule_labels: UInt16 | None = None

    def add(self, name: str, grid: Grid, parts: list[tuple[MaskSource, Mask]], said: tuple[str, ...]) -> None:
        self._statements += said
        for source, mask in parts:
            on_grid = mask if self._grid.is_close(grid) else self._placed(name, source.role, grid, mask)
            if source.role == "nodules":
                self.nodules.add(source.nodule)
                if self.nodule_labels is None:
                    self.nodule_labels = np.zeros(self._grid.shape, dtype=np.uint16, order="F")
                self.nodule_labels[on_grid & (self.nodule_labels == 0)] = source.nodule
            if source.role != "lobes":
                known = self.masks.get(source.role)
                self.masks[source.role] = on_grid if known is None else known | on_grid
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
            # How much of a file lies in the lungs by its header is said once these are known.
            by_index = place(mask, self._basis_grid, self._grid).array
            offset_mm = grid.lps(np.zeros(3)) - self._basis_grid.lps(np.zeros(3))
            self._later.append(partial(moved, name, self._basis, offset_mm, found, by_index))
        else:
            self._statements.append(placement(name, role, mask, grid, self._grid, found))
        return np.asarray(found.array)

    def finish(self) -> Iterable[str]:
        """Yield how files were placed."""
        lung = self.masks.get("lung")
        if lung is None and self.lobes is not None:
            lung = self.lobes > 0
        yield from self._statements
        yield from (later(lung) for later in self._later)


def _read_file(
    path: Path, sources: Sequence[MaskSource], frame: Frame | None
) -> tuple[Grid, list[tuple[MaskSource, Mask]], str, tuple[str, ...]]:
    sources = [source for source in sources if source.path == path]
    grid, masks, said = read_parts(path, [(source.role, source.labels) for source in sources], frame=frame)
    parts = list(zip(sources, masks, strict=True))
    if any(source.role == "nodules" for source in sources):
        values = read_volume(path, frame=frame).array
        parts = [each for source, mask in parts for each in _by_label(source, mask, values)]
    return grid, parts, sha256(path), said


def _by_label(source: MaskSource, mask: Mask, values: Array) -> list[tuple[MaskSource, Mask]]:
    """Return a part for each nodule that the labels of a file tell apart; the mask itself if none are."""
    if source.role != "nodules":
        return [(source, mask)]
    if len(source.labels) == 1:
        return [(replace(source, nodule=source.labels[0]), mask)]
    held = np.unique(values[mask])
    if len(held) < 2 or not is_whole(held) or len(held) > PARTS["nodules"]:
        return [(source, mask)]
    return [(replace(source, labels=(n,), nodule=n), mask & (values == n)) for n in held.astype(int).tolist()]


_BEYOND = {
    "lumen": "nothing counts as airway",
    "lung": "nothing counts as lung",
    "lobes": "nothing counts as lung",
    "liver": "nothing counts as liver",
    "wall": "no airway wall is known, so that none is avoided",
    **dict.fromkeys(
        ("vessels", "hepatic-vein", "portal-vein", "hepatic-artery"),
        "no vessel is known, so that none is avoided",
    ),
    "fissures": "no fissure is known, so that none is avoided",
    "nodules": "there is no nodule",
}


def placement(name: str, role: str, mask: Mask, grid: Grid, target: Grid, found: Placed) -> str:
    """Say how a mask on a grid of its own was placed by its header on the grid `target` of the patient."""
    if found.n_voxels and found.n_lost == found.n_voxels:
        return (
            f"{name} lies outside the images: by its header it holds {grid.describe()}, the images hold "
            f"{target.describe()}. None of its {found.n_voxels} voxels is used."
        )
    low, high = box_in(target, grid)
    low, high = np.rint(np.maximum(low, 0)), np.rint(np.minimum(high, target.shape))
    covered = f"{_listed(high - low, ' x ')} of the {_listed(target.shape, ' x ')} voxels, "
    covered += f"from ({_listed(low, ', ')}) on"
    sentences = [f"{name} was placed by its header: it covers {covered}."]
    if found.is_resampled:
        half = float(np.linalg.norm(grid.spacing_mm)) / 2
        sentences.append(f"Its own grid is {grid.describe()}: borders moved by up to {half:.1f} mm.")
    if (low > 0).any() or (high < target.shape).any():
        sentences.append(f"Beyond it {_BEYOND.get(role, 'nothing is known')}.")
    faces = sum(bool(np.moveaxis(mask, axis, 0)[end].any()) for axis in range(3) for end in (0, -1))
    if faces and role != "lung":
        sentences.append(f"It reaches {faces} of its 6 faces, so that it may go on beyond them.")
    if found.n_lost:
        sentences.append(
            f"{found.n_lost} of its {found.n_voxels} voxels ({percent(found.n_lost / found.n_voxels)}) "
            "lie outside the images and are left out."
        )
    return " ".join(sentences)


def moved(name: str, basis: str, offset_mm: Float, found: Placed, by_index: Array, lung: Mask | None) -> str:
    """Say that a mask of as many voxels as another one lies `offset_mm` (3,) away by its header.

    The shares tell how much of it is in the lungs by its header, and if it lay where the other one lies.
    """
    sentences = [
        f"{name} has as many voxels as {basis}, but its header puts its first voxel "
        f"({', '.join(f'{x:.1f}' for x in offset_mm)}) mm away in LPS: it was placed by its header, "
        "which may be wrong."
    ]
    counts = [int(np.count_nonzero(each)) for each in (found.array, by_index)]
    if lung is not None and any(counts):
        inside = [int(np.count_nonzero(each & lung)) for each in (found.array, by_index)]
        by_header, by_voxel = (percent(n / max(count, 1)) for n, count in zip(inside, counts, strict=True))
        sentences.append(f"By its header {by_header} of it lie in the lungs, voxel by voxel {by_voxel}.")
    if found.n_lost:
        sentences.append(f"{found.n_lost} of its {found.n_voxels} voxels lie outside the images.")
    return " ".join(sentences)


def _listed(numbers: object, between: str) -> str:
    return between.join(f"{float(n):g}" for n in np.asarray(numbers))
