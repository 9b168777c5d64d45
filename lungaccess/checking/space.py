"""Own view of the anatomy: voxel labels at points, and exact distances to solid voxel boxes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from anatomy import structures
from anatomy.grid import Float, Grid
from anatomy.meshes import MeshDistance, box_surface

Labels = NDArray[np.uint16]
Bools = NDArray[np.bool_]
Select = Callable[[Labels], Bools]

if TYPE_CHECKING:
    from anatomy.lung import Lung

FIRST_NEIGHBOURS = 32


def has(bits: int) -> Select:
    """Select the voxels that have any of `bits`."""

    def select(labels: Labels) -> Bools:
        return np.asarray((labels & bits) != 0)

    return select


def airway_except(branch: int) -> Select:
    """Select the airway voxels that do not belong to `branch`."""

    def select(labels: Labels) -> Bools:
        return np.asarray(((labels & structures.AIRWAY) != 0) & (branch_of(labels) != branch))

    return select


def not_lumen(labels: Labels) -> Bools:
    """Select everything that is not lumen."""
    return np.asarray((labels & structures.LUMEN) == 0)


def branch_of(labels: Labels) -> NDArray[np.int64]:
    """Return the branch of airway voxels, -1 for others."""
    return (np.asarray(labels).astype(np.int64) >> structures.BRANCH_SHIFT) - 1


def labels_at(lung: Lung, points_lps: Float) -> Labels:
    """Return the labels `(N,)` of the voxels that hold the points; beyond the grid all is OUTSIDE."""
    points = np.asarray(points_lps, dtype=np.float64).reshape(-1, 3)
    axes = lung.grid.lps_from_ijk[:3, :3]
    fraction = np.linalg.solve(axes, (points - lung.grid.lps_from_ijk[:3, 3]).T).T
    index = np.rint(fraction).astype(np.int64)
    inside = ((index >= 0) & (index < np.asarray(lung.labels.shape))).all(axis=1)
    labels = np.full(len(points), structures.OUTSIDE, dtype=np.uint16)
    labels[inside] = lung.labels[tuple(index[inside].T)]
    return labels


@dataclass(frozen=True, kw_only=True, eq=False)
class Region:
    """The part of a lung around some points, OUTSIDE beyond the lung's grid.

    Parameters
    ----------
    grid : Grid
    labels : (ni, nj, nk) uint16
    reach_mm : float
        The region holds everything within this distance of the points.
    """

    grid: Grid
    labels: Labels
    reach_mm: float


def region_around(lung: Lung, points_lps: Float, reach_mm: float) -> Region:
    """Cut out the region that holds everything within `reach_mm` of the points."""
    fraction = lung.grid.ijk(points_lps)
    reach = reach_mm / lung.grid.spacing_mm + 2.0
    low = np.floor(fraction.min(axis=0) - reach).astype(np.int64)
    high = np.ceil(fraction.max(axis=0) + reach).astype(np.int64) + 1
    low, high = np.maximum(low, -2), np.minimum(high, np.asarray(lung.labels.shape) + 2)
    high = np.maximum(high, low + 1)
    grid = lung.grid.crop(low, high)
    labels = np.full(grid.shape, structures.OUTSIDE, dtype=np.uint16, order="F")
    first, last = np.maximum(low, 0), np.minimum(high, lung.labels.shape)
    if (last > first).all():
        source = tuple(slice(a, b) for a, b in zip(first, last, strict=True))
        target = tuple(slice(a, b) for a, b in zip(first - low, last - low, strict=True))
        labels[target] = lung.labels[source]
    return Region(grid=grid, labels=labels, reach_mm=reach_mm)


def surface_voxels(mask: Bools) -> NDArray[np.int64]:
    """Return the indices `(K, 3)` of the voxels of `mask` with a face neighbour that is not in it.

    The voxel nearest to a point outside the mask is one of these.  The border of the array counts as mask,
    so that cutting out a region adds no surface.
    """
    padded = np.pad(mask, 1, constant_values=True)
    buried = np.ones_like(mask)
    for axis in range(3):
        for side in (slice(0, -2), slice(2, None)):
            window = [slice(1, -1)] * 3
            window[axis] = side
            buried &= padded[tuple(window)]
    return np.asarray(np.argwhere(mask & ~buried), dtype=np.int64)


class Boxes:
    """The selected voxels of a region as solid boxes.

    Parameters
    ----------
    region : Region
    select : callable
        Tells from the labels which voxels belong to the structure.
    """

    def __init__(self, region: Region, select: Select) -> None:
        self._region = region
        self._select = select
        self._spacing = region.grid.spacing_mm
        self._half_diagonal = 0.5 * float(np.linalg.norm(self._spacing))
        self._voxels = surface_voxels(select(region.labels))
        self._centres = cKDTree(self._voxels * self._spacing) if len(self._voxels) else None

    def distance_mm(self, points_lps: Float) -> Float:
        """Return the `(N,)` exact distances from points to the nearest box, at most the region's reach.

        The nearest box is among the boxes whose centres are nearer than the nearest centre plus half a
        diagonal: neighbours are added until that is sure.  Inside a structure the distance is 0.
        """
        points = np.asarray(points_lps, dtype=np.float64).reshape(-1, 3)
        local = self._region.grid.ijk(points) * self._spacing
        out = np.full(len(points), self._region.reach_mm)
        if self._centres is None:
            return out
        left, wanted = np.arange(len(points)), min(FIRST_NEIGHBOURS, len(self._voxels))
        while len(left):
            found, farthest = self._nearest(local[left], wanted)
            out[left] = np.minimum(found, out[left])
            unsure = (farthest - self._half_diagonal < out[left]) & (wanted < len(self._voxels))
            left, wanted = left[unsure], min(4 * wanted, len(self._voxels))
        out[self.holds(points)] = 0.0
        return out

    def _nearest(self, local: Float, count: int) -> tuple[Float, Float]:
        """Return the smallest box distance among `count` centres, and the distance of the last centre."""
        if self._centres is None:
            return np.full(len(local), np.inf), np.full(len(local), np.inf)
        distance, index = self._centres.query(local, k=[count] if count == 1 else count)
        distance, index = distance.reshape(len(local), -1), index.reshape(len(local), -1)
        centres = self._voxels[index] * self._spacing
        gap = np.maximum(np.abs(local[:, None, :] - centres) - 0.5 * self._spacing, 0.0)
        return np.sqrt((gap**2).sum(axis=-1)).min(axis=1), distance[:, -1]

    def holds(self, points_lps: Float) -> Bools:
        """Tell which points lie in a voxel of the structure."""
        index = np.rint(self._region.grid.ijk(points_lps)).astype(np.int64)
        inside = ((index >= 0) & (index < np.asarray(self._region.labels.shape))).all(axis=-1)
        labels = np.full(len(index), structures.OUTSIDE, dtype=np.uint16)
        labels[inside] = self._region.labels[tuple(index[inside].T)]
        return self._select(labels)

    def mesh_near(self, points_lps: Float, within_mm: float) -> MeshDistance:
        """Return the exact surface of the boxes that come nearer than `within_mm` to any of the points."""
        mask = np.zeros(self._region.labels.shape, dtype=bool)
        if self._centres is not None:
            path = cKDTree(self._region.grid.ijk(points_lps) * self._spacing)
            bound = within_mm + self._half_diagonal
            gap, _ = path.query(self._voxels * self._spacing, distance_upper_bound=bound)
            mask[tuple(self._voxels[np.isfinite(gap)].T)] = True
        return MeshDistance(box_surface(*_trimmed(mask, self._region.grid)))


def _trimmed(mask: Bools, grid: Grid) -> tuple[Bools, Grid]:
    """Cut a mask to its bounding box; a single empty voxel remains of an empty one."""
    if not mask.any():
        return mask[:1, :1, :1], grid.crop((0, 0, 0), (1, 1, 1))
    voxels = np.argwhere(mask)
    low, high = voxels.min(axis=0), voxels.max(axis=0) + 1
    return mask[tuple(slice(a, b) for a, b in zip(low, high, strict=True))], grid.crop(low, high)


def segment_clearance_mm(boxes: Boxes, points_lps: Float, within_mm: float) -> Float:
    """Return the `(N - 1,)` distances from the segments between consecutive points to the boxes.

    Measured with FCL to the exact surface of the boxes nearer than `within_mm`, 0 where an end lies inside
    them, and at most `within_mm`.
    """
    points = np.asarray(points_lps, dtype=np.float64)
    mesh = boxes.mesh_near(points, within_mm)
    distance = np.minimum(mesh.segment_distance_mm(points[:-1], points[1:]), within_mm)
    inside = boxes.holds(points)
    distance[inside[:-1] | inside[1:]] = 0.0
    return distance
