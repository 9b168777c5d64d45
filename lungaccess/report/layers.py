"""Masks as picture layers: thickness along a view, and cuts along any plane."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from anatomy.records import frozen_record
from anatomy.typed import Array, Bool, Float
from lungaccess.report.views import View

if TYPE_CHECKING:
    from anatomy.grid import Grid, Volume
    from anatomy.lung import Lung


LUNG_POINTS = 3_000_000
"""A mask of more voxels is thinned out evenly: the picture has fewer pixels."""


@frozen_record
class Footprint:
    """A mask seen through: `thickness_mm[row, column]`, the first row at the bottom.

    The extent is left, right, bottom and top in picture coordinates.
    """

    thickness_mm: Float
    extent_mm: tuple[float, float, float, float]


class Layers:
    """The masks of one patient, each fetched and unfolded into points only once."""

    def __init__(self, lung: Lung) -> None:
        self._lung = lung
        self._points: dict[str, tuple[Float, int]] = {}
        self._masks: dict[str, Array | None] = {}

    @property
    def grid(self) -> Grid:
        """The grid of all masks."""
        return self._lung.grid

    def mask(self, name: str) -> Array | None:
        """Return a bool mask `[i, j, k]`, or None where the patient has none.

        `name` is one of `Lung.mask`, or "lung" for what is not outside.
        """
        if name not in self._masks:
            self._masks[name] = self._fetch(name)
        return self._masks[name]

    def _fetch(self, name: str) -> Array | None:
        lung = self._lung
        if name == "fissure" and not lung.has_fissures:
            return None
        if name == "nodule":
            return _array(lung.nodules)
        if name == "lung":
            return ~np.asarray(_array(lung.mask("outside")), dtype=np.bool_)
        return _array(lung.mask(name))

    def count(self, name: str) -> int:
        """Return the number of voxels of a mask; 0 where the patient has none."""
        mask = self.mask(name)
        return 0 if mask is None else int(np.count_nonzero(mask))

    def points(self, name: str) -> tuple[Float, int]:
        """Return voxel centres `(n, 3)`, LPS mm, and how many voxels each stands for along an axis."""
        if name not in self._points:
            mask = self.mask(name)
            if mask is None:
                self._points[name] = np.zeros((0, 3)), 1
            else:
                self._points[name] = _unfold(mask, self.grid)
        return self._points[name]

    def footprint(self, name: str, view: View) -> Footprint | None:
        """Sum a mask along a view; None where there is nothing to see."""
        points, stride = self.points(name)
        if len(points) == 0:
            return None
        directions = np.abs(self.grid.lps_from_ijk[:3, :3]) * stride
        pixel_u = float(np.abs(view.right) @ directions.sum(axis=1))
        pixel_v = float(np.abs(view.up) @ directions.sum(axis=1))
        return _thickness(view.project(points), pixel_u, pixel_v, self._voxel_mm3 * stride**3)

    @cached_property
    def _voxel_mm3(self) -> float:
        return self.grid.voxel_volume_mm3

    def cut(self, name: str, lps: Float) -> Bool:
        """Tell which points `(..., 3)` lie in a mask (nearest voxel; beyond the grid: in "outside" only)."""
        mask = self.mask(name)
        found = np.zeros(lps.shape[:-1], dtype=np.bool_)
        if mask is None:
            return found
        inside = self.grid.contains(lps)
        ijk = np.floor(self.grid.ijk(lps[inside]) + 0.5).astype(np.int64)
        found[inside] = mask[ijk[:, 0], ijk[:, 1], ijk[:, 2]]
        if name == "outside":
            found[~inside] = True
        return found


def _array(volume: Volume | None) -> Array | None:
    return None if volume is None else volume.array


def _unfold(mask: Array, grid: Grid) -> tuple[Float, int]:
    """List the voxel centres of a mask, thinned out evenly where there are very many."""
    stride = max(1, int(np.ceil((np.count_nonzero(mask) / LUNG_POINTS) ** (1 / 3))))
    thin = mask[::stride, ::stride, ::stride]
    return grid.lps(np.argwhere(thin) * stride), stride


def _thickness(uv: Float, pixel_u: float, pixel_v: float, mm3_per_point: float) -> Footprint:
    """Count points per pixel and turn the count into millimetres of depth."""
    low = uv.min(axis=0) - 2.5 * np.array([pixel_u, pixel_v])
    column = np.floor((uv[:, 0] - low[0]) / pixel_u).astype(np.int64)
    row = np.floor((uv[:, 1] - low[1]) / pixel_v).astype(np.int64)
    columns, rows = int(column.max()) + 3, int(row.max()) + 3
    count = np.bincount(row * columns + column, minlength=rows * columns).reshape(rows, columns)
    extent = (low[0], low[0] + columns * pixel_u, low[1], low[1] + rows * pixel_v)
    return Footprint(
        thickness_mm=np.asarray(count * mm3_per_point / (pixel_u * pixel_v), dtype=np.float64),
        extent_mm=(float(extent[0]), float(extent[1]), float(extent[2]), float(extent[3])),
    )
