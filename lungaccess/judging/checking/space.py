"""Own view of the anatomy: voxel labels at points, and which voxels make up a structure."""

from typing import TYPE_CHECKING

import numpy as np

from anatomy import structures
from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.typed import Bool, Float, Int, Labels
from anatomy.grid import Grid

if TYPE_CHECKING:
    from anatomy.lung import Lung


@frozen_value
class Select:
    """Tells from labels which voxels belong to a structure: those that have any of some bits.

    Airway voxels of `but_branch` are left out; with `complement` all other voxels are taken instead.
    """

    bits: int
    but_branch: int | None = None
    complement: bool = False

    def __call__(self, labels: Labels) -> Bool:
        """Return which voxels are selected."""
        found = (labels & self.bits) != 0
        if self.but_branch is not None:
            found &= ((labels & structures.AIRWAY) == 0) | (branch_of(labels) != self.but_branch)
        return np.asarray(found != self.complement)


def has(bits: int) -> Select:
    """Select the voxels that have any of `bits`."""
    return Select(bits=bits)


def airway_except(branch: int) -> Select:
    """Select the airway voxels that do not belong to `branch`."""
    return Select(bits=structures.AIRWAY, but_branch=branch)


not_lumen = Select(bits=structures.LUMEN, complement=True)
"""Selects everything that is not lumen."""


def branch_of(labels: Labels) -> Int:
    """Return the branch of airway voxels, -1 for others."""
    return (np.asarray(labels).astype(np.int64) >> structures.BRANCH_SHIFT) - 1


def labels_at(lung: "Lung", points_lps: Float) -> Labels:
    """Return the labels `(N,)` of the voxels that hold the points; beyond the grid all is OUTSIDE."""
    points = np.asarray(points_lps, dtype=np.float64).reshape(-1, 3)
    axes = lung.grid.lps_from_ijk[:3, :3]
    fraction = np.linalg.solve(axes, (points - lung.grid.lps_from_ijk[:3, 3]).T).T
    index = np.rint(fraction).astype(np.int64)
    inside = ((index >= 0) & (index < np.asarray(lung.labels.shape))).all(axis=1)
    labels = np.full(len(points), structures.OUTSIDE, dtype=np.uint16)
    labels[inside] = lung.labels[tuple(index[inside].T)]
    return labels


def window_of(lung: "Lung", low: Int, high: Int) -> Labels:
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
    return Region(grid=lung.grid.crop(low, high), labels=window_of(lung, low, high))
