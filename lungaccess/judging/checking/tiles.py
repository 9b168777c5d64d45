"""The surface voxels of every structure of a lung, found tile by tile when they are asked for, and kept."""

from collections.abc import Iterator
from functools import cached_property
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from anatomy import structures
from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float, Int, Labels
from lungaccess.judging.checking.space import Select, branch_of, window_of

if TYPE_CHECKING:
    from anatomy.lung import Lung

TILE = 40
"""Voxels along each side of a tile."""

RUN = 32
"""Points of a path whose common bounding box is compared with those of tiles."""

BITS = tuple(structures.BITS.values())
"""One bit of the labels for each structure."""
NOT_LUMEN = -1
"""Stands for everything that is not lumen, beside the bits of structures."""


@frozen_record
class Cluster:
    """Surface voxels of one structure in one tile, of one branch if it is an airway.

    Args:
        voxels ((K, 3) int64): Indices in the lung's grid, K >= 1.
        centres_mm ((K, 3) float64): Index times spacing.
        half_mm ((3,) float64): Half of a voxel.
        branch: -1 if it is no airway.
    """

    voxels: Int
    centres_mm: Float
    half_mm: Float
    branch: int

    @cached_property
    def low_mm(self) -> Float:
        """Corner of the bounding box of the solid voxels, `(3,)`."""
        return np.asarray(self.centres_mm.min(axis=0) - self.half_mm)

    @cached_property
    def high_mm(self) -> Float:
        """Opposite corner, `(3,)`."""
        return np.asarray(self.centres_mm.max(axis=0) + self.half_mm)

    @cached_property
    def tree(self) -> cKDTree:
        """The centres as a KD-tree."""
        return cKDTree(self.centres_mm, balanced_tree=False, compact_nodes=False)


class Tiles:
    """The surfaces of a lung's structures; each tile is looked through once, so labels must not change."""

    def __init__(self, lung: "Lung") -> None:
        self.lung = lung
        self.spacing_mm = lung.grid.spacing_mm
        self._kept: dict[tuple[int, tuple[int, ...]], tuple[Cluster, ...]] = {}

    def local_mm(self, points_lps: Float) -> Float:
        """Return points in the axes of the grid, index times spacing, `(N, 3)` mm."""
        points = np.asarray(points_lps, dtype=np.float64).reshape(-1, 3)
        return np.asarray(self.lung.grid.ijk(points) * self.spacing_mm)

    def near(self, select: Select, local_mm: Float, reach_mm: float) -> list[Cluster]:
        """Return the clusters of a structure of which voxels may be within `reach_mm` of the points."""
        runs = [local_mm[n : n + RUN] for n in range(0, len(local_mm), RUN)]
        low = np.array([run.min(axis=0) for run in runs]) - reach_mm
        high = np.array([run.max(axis=0) for run in runs]) + reach_mm
        return [
            cluster
            for tile in self._tiles_between(low, high)
            for key in _keys(select)
            for cluster in self._clusters(key, tile)
            if (select.but_branch is None or cluster.branch != select.but_branch)
            and ((cluster.low_mm <= high) & (cluster.high_mm >= low)).all(axis=1).any()
        ]

    def _tiles_between(self, low_mm: Float, high_mm: Float) -> Iterator[tuple[int, ...]]:
        """Yield the tiles that overlap any of the boxes; beyond the grid's first voxels all is OUTSIDE."""
        shape = np.asarray(self.lung.labels.shape)
        first = np.maximum(np.floor(low_mm.min(axis=0) / self.spacing_mm - 0.5).astype(np.int64), -1)
        last = np.minimum(np.ceil(high_mm.max(axis=0) / self.spacing_mm + 0.5).astype(np.int64), shape)
        side_mm = TILE * self.spacing_mm
        for tile in product(*(range(a // TILE, b // TILE + 1) for a, b in zip(first, last, strict=True))):
            corner = np.asarray(tile) * side_mm - 0.5 * self.spacing_mm
            if ((corner <= high_mm) & (corner + side_mm >= low_mm)).all(axis=1).any():
                yield tile

    def _clusters(self, key: int, tile: tuple[int, ...]) -> tuple[Cluster, ...]:
        if (key, tile) not in self._kept:
            self._kept[key, tile] = tuple(self._found(key, tile))
        return self._kept[key, tile]

    def _found(self, key: int, tile: tuple[int, ...]) -> Iterator[Cluster]:
        begin = np.asarray(tile) * TILE
        body = _bodies(key, window_of(self.lung, begin - 1, begin + TILE + 1))
        core = body[1:-1, 1:-1, 1:-1]
        if not core.any():
            return
        index = np.argwhere(on_surface(body))
        names = core[tuple(index.T)]
        for name in np.unique(names):
            voxels = index[names == name] + begin
            yield Cluster(
                voxels=voxels,
                centres_mm=voxels * self.spacing_mm,
                half_mm=0.5 * self.spacing_mm,
                branch=int(name) - 2 if key == structures.AIRWAY else -1,
            )


def _keys(select: Select) -> list[int]:
    """Return the parts that make up a structure."""
    if select.complement:
        return [NOT_LUMEN]
    return [bit for bit in BITS if select.bits & bit]


def _bodies(key: int, labels: Labels) -> Labels:
    """Return 0 where the structure is not, else 1; of airways, the number of the branch plus 2."""
    if key == NOT_LUMEN:
        return np.asarray((labels & structures.LUMEN) == 0, dtype=np.uint16)
    mask = (labels & key) != 0
    names = branch_of(labels) + 2 if key == structures.AIRWAY else mask
    return np.where(mask, names, 0).astype(np.uint16)


def on_surface(body: Labels) -> Bool:
    """Tell which inner voxels have a face neighbour of another body, and are not 0 themselves.

    The voxel nearest to a point outside of a body is one of these.
    """
    core = body[1:-1, 1:-1, 1:-1]
    found = np.zeros_like(core, dtype=bool)
    for axis in range(3):
        for side in (slice(0, -2), slice(2, None)):
            beside = [slice(1, -1)] * 3
            beside[axis] = side
            found |= body[tuple(beside)] != core
    return np.asarray(found & (core != 0))
