"""The work behind a reachability map: its points layer by layer, kept on disk as they are finished."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from anatomy.checksums import array_checksum, values_checksum, warn_of_damage
from anatomy.grid import Grid
from anatomy.io.files import DAMAGE, atomic_write, require_writable_folder
from anatomy.lung import Lung
from anatomy.structures import obstacle_bits
from anatomy.typed import Float, Float32, Int, Mask, UInt64
from lungaccess.coupled import Scan
from stages.needle import Reached

THREADS = 2
"""The kernels hold no lock, and two cores are the least that a machine of today has."""


def counted_voxels(lung: Lung, grid: Grid, with_fissures: bool) -> Mask:
    """Tell which voxels of a map have their centre in lung tissue that is no obstacle."""
    bits = obstacle_bits(with_fissures)
    counted = np.zeros(grid.shape, dtype=bool, order="F")
    for k in range(grid.shape[2]):
        ijk = np.floor(lung.grid.ijk(_layer_points(grid, k)) + 0.5).astype(np.int64)
        inside = ((ijk >= 0) & (ijk < lung.grid.shape)).all(axis=-1)
        layer = np.zeros(inside.shape, dtype=bool)
        layer[inside] = (lung.labels[tuple(ijk[inside].T)] & bits) == 0
        counted[:, :, k] = layer
    return counted


def _layer_points(grid: Grid, k: int) -> Float:
    """Return the centres `(ni, nj, 3)` of a layer of voxels, LPS mm."""
    ni, nj, _nk = grid.shape
    i, j = np.meshgrid(np.arange(ni), np.arange(nj), indexing="ij")
    return grid.lps(np.stack([i, j, np.full_like(i, k)], axis=-1))


def scan_layers(
    scan: Scan, grid: Grid, counted: Mask, store: LayerStore | None, progress: Callable[[float], None] | None
) -> tuple[Float32, int]:
    """Try the points of all layers.

    Parameters
    ----------
    counted : (ni, nj, nk) bool
        Voxels whose centres are tried.
    store : LayerStore or None
        Where finished layers are kept; emptied at the end.
    progress : callable or None
        Told the share of the layers done.

    Returns
    -------
    found : (4, ni, nj, nk) float32
        Kind, cost, clearance and share of the breath, see `stages.needle.reach.Reached`.
    resumed : int
        Layers taken from the store.
    """
    found = np.zeros((4, *grid.shape), dtype=np.float32)
    done, resumed = 0, 0

    def one_layer(k: int) -> None:
        nonlocal done, resumed
        places = np.argwhere(counted[:, :, k])
        kept = None if store is None else store.load(k, len(places))
        if kept is None and len(places):
            ijk = np.concatenate([places, np.full((len(places), 1), k)], axis=1)
            kept = _as_rows(
                scan.reach(grid.lps(ijk), _seeds(grid, ijk), _earlier_neighbours(counted[:, :, k]))
            )
            if store is not None:
                store.save(k, kept)
        elif kept is not None:
            resumed += 1
        if kept is not None:
            found[:, places[:, 0], places[:, 1], k] = kept
        done += 1
        if progress:
            progress(done / grid.shape[2])

    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(one_layer, range(grid.shape[2])))
    if store is not None:
        store.clear()
    return found, resumed


def _seeds(grid: Grid, ijk: Int) -> UInt64:
    """Return a seed for each voxel: its number in the grid."""
    return np.asarray(np.ravel_multi_index(tuple(ijk.T), grid.shape), dtype=np.uint64)


def _earlier_neighbours(counted: Mask) -> Int:
    """Return the indices `(N, 3)` of the neighbours before each True place of a layer, -1 for none."""
    index = np.full((counted.shape[0] + 1, counted.shape[1] + 2), -1, dtype=np.int64)
    index[1:, 1:-1][counted] = np.arange(np.count_nonzero(counted))
    i, j = np.nonzero(counted)
    return np.stack([index[i + 1, j], index[i, j + 1], index[i, j + 2]], axis=1)


def _as_rows(reached: Reached) -> Float32:
    share = np.zeros_like(reached.cost) if reached.window_share is None else reached.window_share
    return np.stack([reached.kinds, reached.cost, reached.clearance_mm, share]).astype(np.float32)


class LayerStore:
    """Finished layers on disk, in a folder named after what they depend on."""

    def __init__(self, work: Path, key: str) -> None:
        self._folder = require_writable_folder(work / f".reach-{key}")

    def _path(self, layer: int) -> Path:
        return self._folder / f"layer-{layer:04d}.npz"

    def load(self, layer: int, count: int) -> Float32 | None:
        """Return the rows `(4, count)` of a layer, None if it is not there or not whole."""
        try:
            with self._path(layer).open("rb") as stream, np.load(stream) as stored:
                rows, checksum = np.asarray(stored["rows"]), str(stored["checksum"])
        except FileNotFoundError:
            return None
        except DAMAGE:
            checksum = ""
        if checksum and rows.shape == (4, count) and checksum == self._checksum(layer, rows):
            return rows.astype(np.float32, copy=False)
        warn_of_damage(self._path(layer))
        return None

    def save(self, layer: int, rows: Float32) -> None:
        """Write a layer, whole or not at all."""
        with atomic_write(self._path(layer)) as temporary:
            np.savez_compressed(temporary, rows=rows, checksum=np.array(self._checksum(layer, rows)))

    def _checksum(self, layer: int, rows: Float32) -> str:
        """Return what binds the rows of a layer to the run and to its place."""
        return values_checksum({"of": [self._folder.name, layer], "rows": array_checksum(rows)})

    def clear(self) -> None:
        """Remove all layers."""
        shutil.rmtree(self._folder, ignore_errors=True)
