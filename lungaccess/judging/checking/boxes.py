"""A lung as the check sees it: exact distances from points and segments to structures as solid boxes.

The surface voxels of every structure are found tile by tile when they are asked for, and kept.
"""

from collections.abc import Iterator
from functools import cached_property
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from anatomy import structures
from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.typed import Bool, Float, Int, Labels
from anatomy.grid import Grid
from anatomy.meshes import MeshDistance, SurfaceMesh, box_surface

if TYPE_CHECKING:
    from anatomy.lung import Lung


@frozen_value
class Select:
    """Tells from labels which voxels belong to a structure: those that have any of some bits.

    Airway voxels of the branches `but` are left out; with `complement` all other voxels are taken instead.
    """

    bits: int
    but: tuple[int, ...] = ()
    complement: bool = False

    def __call__(self, labels: Labels) -> Bool:
        """Return which voxels are selected."""
        found = (labels & self.bits) != 0
        if self.but:
            found &= ((labels & structures.AIRWAY) == 0) | ~np.isin(branch_of(labels), self.but)
        return np.asarray(found != self.complement)


def has(bits: int) -> Select:
    """Select the voxels that have any of `bits`."""
    return Select(bits=bits)


def airway_except(*branches: int) -> Select:
    """Select the airway voxels that belong to none of some branches."""
    return Select(bits=structures.AIRWAY, but=branches)


not_lumen = Select(bits=structures.LUMEN, complement=True)
"""Selects everything that is not lumen."""


def branch_of(labels: Labels) -> Int:
    """Return the branch of airway voxels, -1 for others."""
    return (np.asarray(labels).astype(np.int64) >> structures.BRANCH_SHIFT) - 1


def labels_at(lung: "Lung", points_lps: Float) -> Labels:
    """Return the labels `(N,)` of the voxels that hold the points; beyond the grid all is OUTSIDE."""
    points = np.asarray(points_lps, dtype=np.float64).reshape(-1, 3)
    axes = lung.grid.lps_from_ijk[:3, :3]
    index = np.rint(np.linalg.solve(axes, (points - lung.grid.lps_from_ijk[:3, 3]).T).T).astype(np.int64)
    inside = ((index >= 0) & (index < np.asarray(lung.labels.shape))).all(axis=1)
    labels = np.full(len(points), structures.OUTSIDE, dtype=np.uint16)
    labels[inside] = lung.labels[tuple(index[inside].T)]
    return labels


def _window_of(lung: "Lung", low: Int, high: Int) -> Labels:
    """Return the labels of the voxels `low <= ijk < high`, OUTSIDE beyond the lung's grid."""
    low, high = np.asarray(low), np.asarray(high)
    labels = np.full(tuple(high - low), structures.OUTSIDE, dtype=np.uint16, order="F")
    first, last = np.maximum(low, 0), np.minimum(high, lung.labels.shape)
    if (last > first).all():
        source = tuple(slice(a, b) for a, b in zip(first, last, strict=True))
        target = tuple(slice(a, b) for a, b in zip(first - low, last - low, strict=True))
        labels[target] = lung.labels[source]
    return labels


@frozen_record
class Region:
    """The part of a lung around some points, labels `(ni, nj, nk)`, OUTSIDE beyond the lung's grid."""

    grid: Grid
    labels: Labels


def region_around(lung: "Lung", points_lps: Float, reach_mm: float) -> Region:
    """Cut out the region that holds everything within `reach_mm` of the points."""
    fraction = lung.grid.ijk(points_lps)
    reach = reach_mm / lung.grid.spacing_mm + 2.0
    low = np.floor(fraction.min(axis=0) - reach).astype(np.int64)
    high = np.ceil(fraction.max(axis=0) + reach).astype(np.int64) + 1
    low, high = np.maximum(low, -2), np.minimum(high, np.asarray(lung.labels.shape) + 2)
    high = np.maximum(high, low + 1)
    return Region(grid=lung.grid.crop(low, high), labels=_window_of(lung, low, high))


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
            for key in ([NOT_LUMEN] if select.complement else [bit for bit in BITS if select.bits & bit])
            for cluster in self._clusters(key, tile)
            if cluster.branch not in select.but
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
        body = _bodies(key, _window_of(self.lung, begin - 1, begin + TILE + 1))
        core = body[1:-1, 1:-1, 1:-1]
        if not core.any():
            return
        index = np.argwhere(_on_surface(body))
        names = core[tuple(index.T)]
        for name in np.unique(names):
            voxels = index[names == name] + begin
            yield Cluster(
                voxels=voxels,
                centres_mm=voxels * self.spacing_mm,
                half_mm=0.5 * self.spacing_mm,
                branch=int(name) - 2 if key == structures.AIRWAY else -1,
            )


def _bodies(key: int, labels: Labels) -> Labels:
    """Return 0 where the structure is not, else 1; of airways, the number of the branch plus 2."""
    if key == NOT_LUMEN:
        return np.asarray((labels & structures.LUMEN) == 0, dtype=np.uint16)
    mask = (labels & key) != 0
    return np.where(mask, branch_of(labels) + 2 if key == structures.AIRWAY else mask, 0).astype(np.uint16)


def _on_surface(body: Labels) -> Bool:
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


class Boxes:
    """One structure of a lung as solid boxes; what lies farther than `reach_mm` counts as this far."""

    def __init__(self, tiles: Tiles, select: Select, reach_mm: float) -> None:
        self._tiles = tiles
        self._select = select
        self._reach_mm = reach_mm
        self._half_diagonal = 0.5 * float(np.linalg.norm(tiles.spacing_mm))

    def holds(self, points_lps: Float) -> Bool:
        """Tell which points lie in a voxel of the structure."""
        return self._select(labels_at(self._tiles.lung, points_lps))

    def distance_mm(self, points_lps: Float) -> Float:
        """Return the `(N,)` exact distances from points to the nearest box, 0 inside, at most the reach."""
        points = np.asarray(points_lps, dtype=np.float64).reshape(-1, 3)
        local = self._tiles.local_mm(points)
        out = np.where(self.holds(points), 0.0, self._reach_mm)
        clusters = self._tiles.near(self._select, local, self._reach_mm)
        # Distances to the bounding boxes of the clusters.
        gaps = (np.maximum(np.maximum(c.low_mm - local, local - c.high_mm), 0.0) for c in clusters)
        bounds = [np.sqrt((gap**2).sum(axis=1)) for gap in gaps]
        for n in sorted(range(len(clusters)), key=lambda each: float(bounds[each].min())):
            left = np.flatnonzero(bounds[n] < out)
            if len(left):
                out[left] = self._nearer(clusters[n], local[left], out[left])
        return out

    def _nearer(self, cluster: Cluster, local: Float, known: Float) -> Float:
        """Return the distances to the boxes of a cluster where they are less than the known ones.

        The nearest box is among the boxes whose centres are nearer than it plus half a diagonal:
        neighbours are added until that is sure.
        """
        out = known.copy()
        # Nearest centres asked for at first: mostly enough to be sure of the nearest box.
        left, count = np.arange(len(local)), min(16, len(cluster.voxels))
        centres = np.vstack([cluster.centres_mm, np.full(3, np.inf)])
        while len(left):
            within = float(out[left].max()) + self._half_diagonal
            distance, index = cluster.tree.query(
                local[left], k=np.arange(1, count + 1), distance_upper_bound=within
            )
            gap = np.maximum(np.abs(local[left, None, :] - centres[index]) - cluster.half_mm, 0.0)
            out[left] = np.minimum(out[left], np.sqrt((gap**2).sum(axis=-1)).min(axis=1))
            sure = (distance[:, -1] - self._half_diagonal >= out[left]) | (count == len(cluster.voxels))
            left, count = left[~sure], min(4 * count, len(cluster.voxels))
        return out

    def surface_near(self, points: Float, within_mm: float) -> SurfaceMesh:
        """Return the exact surface of the surface voxels that come nearer than `within_mm` to a point."""
        local = self._tiles.local_mm(points)
        bound = within_mm + self._half_diagonal
        path = cKDTree(local)
        found = [np.zeros((0, 3), dtype=np.int64)]
        for cluster in self._tiles.near(self._select, local, bound):
            gap, _ = path.query(cluster.centres_mm, distance_upper_bound=bound)
            found.append(cluster.voxels[np.isfinite(gap)])
        voxels = np.concatenate(found)
        low = voxels.min(axis=0) if len(voxels) else np.zeros(3, dtype=np.int64)
        high = voxels.max(axis=0) + 1 if len(voxels) else low + 1
        grid = self._tiles.lung.grid.crop(low, high)
        mask = np.zeros(grid.shape, dtype=bool)
        mask[tuple((voxels - low).T)] = True
        return box_surface(mask, grid)


class PathDistances:
    """Distances from the points of a path, `(N, 3)` LPS mm, and the segments between them to boxes."""

    def __init__(self, boxes: Boxes, path_lps: Float) -> None:
        self._boxes = boxes
        self._points = np.asarray(path_lps, dtype=np.float64).reshape(-1, 3)
        self._at_most, self._at_least = self._bounds_mm()

    def _bounds_mm(self) -> tuple[float, Float]:
        """Return the least distance of some of the points, and lower bounds `(N,)` for all.

        The distance changes no faster than one walks along the path.
        """
        points = self._points
        # Along a path every so manieth point is measured first; the others are skipped where it tells enough.
        chosen = np.unique(np.append(np.arange(0, len(points), 16), len(points) - 1))
        exact = self._boxes.distance_mm(points[chosen])
        walked = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
        behind = np.searchsorted(chosen, np.arange(len(points)), side="right") - 1
        ahead = np.minimum(behind + 1, len(chosen) - 1)
        bounds = np.maximum(
            exact[behind] - np.abs(walked - walked[chosen[behind]]),
            exact[ahead] - np.abs(walked - walked[chosen[ahead]]),
        )
        return float(exact.min()), np.maximum(bounds, 0.0)

    def least_mm(self) -> float:
        """Return the smallest of the exact distances from the points."""
        open_points = self._at_least < self._at_most
        if not open_points.any():
            return self._at_most
        return min(self._at_most, float(self._boxes.distance_mm(self._points[open_points]).min()))

    def segments_mm(self, within_mm: float) -> Float:
        """Return the `(N - 1,)` distances from the segments between consecutive points to the boxes.

        Measured with FCL to the exact surface of the boxes nearer than `within_mm`, 0 where an end lies
        inside them, and at most `within_mm`.  FCL overlooks what is nearest to some segments that are
        parallel to faces, so a segment is never farther away than either of its ends.
        """
        points, bounds = self._points, self._at_least
        length = np.linalg.norm(np.diff(points, axis=0), axis=1)
        out = np.full(len(points) - 1, within_mm)
        near = np.flatnonzero(np.maximum(bounds[:-1], bounds[1:]) - length < within_mm)
        if len(near):
            ends = np.union1d(near, near + 1)
            surface = self._boxes.surface_near(points[ends], within_mm + float(length.max()))
            distance = MeshDistance(surface).segment_distance_mm(points[near], points[near + 1])
            out[near] = np.minimum(distance, within_mm)
            exact = np.full(len(points), within_mm)
            exact[ends] = self._boxes.distance_mm(points[ends])
            out = np.minimum(out, np.minimum(exact[:-1], exact[1:]))
        inside = self._boxes.holds(points)
        out[inside[:-1] | inside[1:]] = 0.0
        return out


class Environment:
    """A lung, which must not change, its structures as solid boxes, and the points of its airway tree."""

    def __init__(self, lung: "Lung") -> None:
        self.lung = lung
        self._tiles = Tiles(lung)

    def boxes(self, select: Select, reach_mm: float) -> Boxes:
        """Return a structure as solid boxes; what lies beyond the reach counts as so far."""
        return Boxes(self._tiles, select, reach_mm)

    @cached_property
    def _tree_points(self) -> cKDTree:
        return cKDTree(self.lung.tree.points_lps)

    def nearest_tree_points(self, point_lps: Float, count: int) -> Int:
        """Return the indices of the tree points nearest to a point `(3,)`, the nearest first."""
        count = min(count, self.lung.tree.n_points)
        return np.asarray(self._tree_points.query(point_lps, k=np.arange(1, count + 1))[1], dtype=np.int64)
