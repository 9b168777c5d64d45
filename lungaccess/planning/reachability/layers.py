"""The work behind a reachability map: its points layer by layer, kept on disk as they are finished."""

import shutil
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import MappingProxyType

import numpy as np

from anatomy.base.checksums import array_checksum, values_checksum, warn_of_damage
from anatomy.base.files import DAMAGE, atomic_write, require_writable_folder
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Float32, Int, Int32, Mask, UInt8, UInt64
from anatomy.grid import Grid, Volume
from anatomy.lobes import LOBES
from anatomy.lung import Lung
from anatomy.structures import OBSTACLES, obstacle_bits
from lungaccess.planning.coupled.search.reach_scans import Scan
from stages.needle import BLOCK_MM

SLAB_MM = BLOCK_MM
"""Thickness of the slabs of layers that are tried, and kept on disk, at a time."""
THREADS = 2
"""The kernels hold no lock, and two cores are the least that a machine of today has."""


def counted_voxels(lung: Lung, grid: Grid, with_fissures: bool) -> Mask:
    """Tell which voxels of a map have their centre in lung tissue that is no obstacle."""
    bits = obstacle_bits(with_fissures)
    counted = np.zeros(grid.shape, dtype=bool, order="F")
    for k in range(grid.shape[2]):
        i, j = np.meshgrid(*map(np.arange, grid.shape[:2]), indexing="ij")
        centres = grid.lps(np.stack([i, j, np.full_like(i, k)], axis=-1))
        counted[:, :, k] = (lung.labels_at(centres) & bits) == 0
    return counted


def scan_layers(
    scan: Scan,
    grid: Grid,
    counted: Mask,
    store: "LayerStore | None",
    progress: Callable[[float], None] | None,
) -> tuple[Float32, Int32, int]:
    """Try the points of all layers, slab by slab.

    Args:
        counted ((ni, nj, nk) bool): Voxels whose centres are tried.
        store: Where finished slabs are kept; emptied at the end.

    Returns:
        - found ((4, ni, nj, nk) float32) - Kind, cost, clearance and share of the breath, see
          `stages.needle.reach.Reached`.
        - entries ((ni, nj, nk) int32) - Start pose of what is reached, else -1.
        - resumed - Layers taken from the store.
    """
    found = np.zeros((4, *grid.shape), dtype=np.float32)
    entries = np.full(grid.shape, -1, dtype=np.int32)
    done, resumed = 0, 0
    thickness = max(int(SLAB_MM / grid.spacing_mm[2] + 1e-9), 1)

    def one_slab(first: int) -> None:
        nonlocal done, resumed
        slab = counted[:, :, first : first + thickness]
        places = np.argwhere(slab)
        kept = None if store is None else store.load(first, len(places))
        ijk = places + np.array([0, 0, first], dtype=np.int64)
        if kept is None and len(places):
            reached = scan.reach(grid.lps(ijk), voxel_seeds(grid, ijk), _earlier_neighbours(slab))
            share = np.zeros_like(reached.cost) if reached.window_share is None else reached.window_share
            rows = np.stack([reached.kinds, reached.cost, reached.clearance_mm, share]).astype(np.float32)
            kept = rows, reached.entries.astype(np.int32)
            if store is not None:
                store.save(first, kept)
        elif kept is not None:
            resumed += slab.shape[2]
        if kept is not None:
            found[:, *ijk.T], entries[*ijk.T] = kept
        done += slab.shape[2]
        if progress:
            progress(done / grid.shape[2])

    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(one_slab, range(0, grid.shape[2], thickness)))
    if store is not None:
        store.clear()
    return found, entries, resumed


def voxel_seeds(grid: Grid, ijk: Int) -> UInt64:
    """Return the seed of the search to each of voxels (N, 3): its number in the grid."""
    return np.asarray(np.ravel_multi_index(tuple(ijk.T), grid.shape), dtype=np.uint64)


def _earlier_neighbours(counted: Mask) -> Int:
    """Return the indices `(N, 3)` of the neighbours before each True place along each axis, -1 for none."""
    index = np.full(tuple(n + 1 for n in counted.shape), -1, dtype=np.int64)
    index[1:, 1:, 1:][counted] = np.arange(np.count_nonzero(counted))
    i, j, k = np.nonzero(counted)
    return np.stack([index[i, j + 1, k + 1], index[i + 1, j, k + 1], index[i + 1, j + 1, k]], axis=1)


Rows = tuple[Float32, Int32]
"""What was found of N voxels: `(4, N)` and `(N,)`, see `scan_layers`."""


class LayerStore:
    """Finished slabs of layers on disk, in a folder named after what they depend on."""

    def __init__(self, work: Path, key: str) -> None:
        self._folder = require_writable_folder(work / f".reach-{key}")

    def _path(self, layer: int) -> Path:
        return self._folder / f"layer-{layer:04d}.npz"

    def load(self, layer: int, count: int) -> Rows | None:
        """Return the rows of the slab that begins with a layer, None if it is not there or not whole."""
        try:
            with self._path(layer).open("rb") as stream, np.load(stream) as stored:
                rows, entries = np.asarray(stored["rows"]), np.asarray(stored["entries"])
                checksum = str(stored["checksum"])
        except FileNotFoundError:
            return None
        except DAMAGE:
            checksum = ""
        whole = checksum and rows.shape == (4, count) and entries.shape == (count,)
        if whole and checksum == self._checksum(layer, (rows, entries)):
            return rows.astype(np.float32, copy=False), entries.astype(np.int32, copy=False)
        warn_of_damage(self._path(layer))
        return None

    def save(self, layer: int, found: Rows) -> None:
        """Write a slab, whole or not at all."""
        rows, entries = found
        with atomic_write(self._path(layer)) as temporary:
            checksum = np.array(self._checksum(layer, found))
            np.savez_compressed(temporary, rows=rows, entries=entries, checksum=checksum)

    def _checksum(self, layer: int, found: Rows) -> str:
        """Return what binds the rows of a slab to the run and to its place."""
        rows, entries = (array_checksum(each) for each in found)
        return values_checksum({"of": [self._folder.name, layer], "rows": rows, "entries": entries})

    def clear(self) -> None:
        """Remove all slabs."""
        shutil.rmtree(self._folder, ignore_errors=True)


RIGHT, LEFT = 1, 2
NAMES: Mapping[int, str] = MappingProxyType({RIGHT: "right lung", LEFT: "left lung"})


@frozen_record
class Regions:
    """The region of each voxel of a grid: a key of `names`, or 0, in a volume of uint8.

    If `lungs_are_separate`, the two are parts of the mask without a bridge; else the plane through the carina
    divides them.  `lobes` has the numbers of `anatomy.lobes.LOBES`; None if the patient came without lobes.
    `segments` has 1 for the first of `segment_names` and so on, by the nearest bronchus; 0 where it has none.
    """

    volume: Volume
    names: Mapping[int, str]
    lungs_are_separate: bool
    segments: Volume
    segment_names: tuple[str, ...]
    lobes: Volume | None = None

    def parts(self) -> Iterator[tuple[str, Mask]]:
        """Yield the name and the voxels of each lung, then of each lobe."""
        for code, name in self.names.items():
            yield name, self.volume.array == code
        if self.lobes is not None:
            for code, name in LOBES.items():
                yield name, self.lobes.array == code


def lung_regions(lung: Lung, grid: Grid, where: Mask) -> Regions:
    """Return the side of the voxels of a grid, any in the same place, that are true in `where`; 0 of others.

    The lungs are the two largest parts of the free tissue between which no face is shared; smaller parts
    belong to the side of the carina on which they lie.
    """
    from scipy import ndimage

    parts, _count = ndimage.label((lung.labels & OBSTACLES) == 0)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    two = np.argsort(sizes)[::-1][:2]
    # The smaller of two lungs holds at least this share of the larger one.
    lungs_are_separate = len(two) == 2 and bool(sizes[two[1]] >= max(1.0, 0.1 * sizes[two[0]]))
    ijk = np.argwhere(where)
    points = grid.lps(ijk)
    # LPS: the patient's left is +x.
    codes = np.where(points[:, 0] > lung.tree.carina_lps[0], LEFT, RIGHT).astype(np.uint8)
    voxels = tuple(np.clip(lung.grid.voxels(points), 0, np.array(parts.shape) - 1).T)
    if lungs_are_separate:
        here = parts[voxels]
        first, second = here == two[0], here == two[1]
        first_is_left = _mean_x(points[first]) > _mean_x(points[second])
        codes[first] = LEFT if first_is_left else RIGHT
        codes[second] = RIGHT if first_is_left else LEFT

    def on_grid(values: UInt8) -> Volume:
        array = np.zeros(grid.shape, dtype=np.uint8, order="F")
        array[tuple(ijk.T)] = values
        return Volume(grid=grid, array=array)

    segments = np.array(lung.tree.bronchi.segments)
    names = sorted({*segments.tolist()} - {""}, key=lambda name: (name[0], int(name[2:].partition("+")[0])))
    nearest = lung.tree.branch_of_point[lung.tree.nearest_point_index.query(points)[1]]
    of_branch = np.array([names.index(name) + 1 if name else 0 for name in segments], dtype=np.uint8)
    return Regions(
        volume=on_grid(codes),
        names=NAMES,
        lungs_are_separate=lungs_are_separate,
        lobes=None if lung.lobes is None else on_grid(lung.lobes.array[voxels]),
        segments=on_grid(of_branch[nearest]),
        segment_names=tuple(names),
    )


def _mean_x(points: Float) -> float:
    return float(points[:, 0].mean()) if len(points) else 0.0
