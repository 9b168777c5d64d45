"""Masks as picture layers: thickness along a view, and cuts along any plane."""

from functools import cached_property
from typing import Any

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Array, Bool, Float, Int
from anatomy.grid import Grid
from anatomy.kept_records import kept
from anatomy.organ import Organ
from anatomy.structures import BITS, OUTSIDE
from lungaccess.showing.report.pack import Packed, pack, unpack
from lungaccess.showing.report.views import STANDARD, View

PROJECTIONS_VERSION = 2
SEEN_THROUGH = ("lung", "fissure", "vessel", "airway", "lumen", "nodule")
"""The masks that pictures show from a standard view, or count."""


@frozen_record
class Footprint:
    """A mask seen through: `thickness_mm[row, column]`, the first row at the bottom.

    The extent is left, right, bottom and top in picture coordinates.
    """

    thickness_mm: Float
    extent_mm: tuple[float, float, float, float]


class Layers:
    """The masks of one patient, seen through and cut."""

    def __init__(self, lung: Organ) -> None:
        self._lung = lung
        self._points: dict[str, tuple[Float, int]] = {}

    @cached_property
    def _projections(self) -> dict[str, Any]:
        """Return voxels of each structure and, by structure and view, its footprints; kept with the lung."""
        return dict(kept(self._lung, "projections", PROJECTIONS_VERSION, self._project))

    def _project(self) -> dict[str, Any]:
        """Make what `_projections` returns, mask by mask, so that only one is in memory."""
        made: dict[str, Any] = {"voxels": {}, "footprints": {}}
        for name in SEEN_THROUGH:
            mask = self._mask(name)
            made["voxels"][name] = 0 if mask is None else int(np.count_nonzero(mask))
            seen: dict[str, Packed] = {}
            made["footprints"][name] = seen
            if mask is not None and made["voxels"][name]:
                points, stride = _unfold(mask, self._lung.grid)
                seen |= {view.name: _counted(points, stride, view, self._lung.grid) for view in STANDARD}
        return made

    def _mask(self, name: str) -> Array | None:
        """Return a mask of `Organ.mask` as `[i, j, k]`, or None where the patient has none."""
        return self._lung.mask(name).array if self.has(name) else None

    def has(self, name: str) -> bool:
        """Tell whether a mask of fissures, or of nodules, came with the patient; the others always do."""
        if name == "nodule":
            return self._lung.nodules is not None
        return name != "fissure" or self._lung.has_fissures

    def count(self, name: str) -> int:
        """Return the number of voxels of a mask of `SEEN_THROUGH`; 0 where the patient has none."""
        return int(self._projections["voxels"][name])

    def footprint(self, name: str, view: View) -> Footprint | None:
        """Sum a mask of `SEEN_THROUGH` along a standard view; None where there is nothing to see."""
        found = self._projections["footprints"][name].get(view.name)
        if found is None:
            return None
        count = unpack(found["count"]).astype(np.float64)
        left, right, bottom, top = (float(each) for each in found["extent_mm"])
        return Footprint(thickness_mm=count * found["mm_per_point"], extent_mm=(left, right, bottom, top))

    def labels(self, lps: Float) -> Int:
        """Return the label of the voxel of each point `(..., 3)`; OUTSIDE alone beyond the grid."""
        return self._lung.grid.values_at(self._lung.labels, lps, OUTSIDE).astype(np.int64)

    def cut(self, name: str, lps: Float, labels: Int | None = None) -> Bool:
        """Tell which points `(..., 3)` lie in a mask (nearest voxel; beyond the grid: in "outside" only).

        Whoever asks for several structures gives the `labels` of the points as well.
        """
        if name == "nodule":
            nodules = self._lung.nodules
            if nodules is None:
                return np.zeros(lps.shape[:-1], dtype=np.bool_)
            return nodules.at(lps, False)
        there = self.labels(lps) if labels is None else labels
        held = (there & OUTSIDE) == 0 if name == "lung" else (there & BITS[name]) != 0
        return np.asarray(held)


def _unfold(mask: Array, grid: Grid) -> tuple[Float, int]:
    """List the voxel centres of a mask, thinned out evenly where there are very many."""
    # A mask of more voxels is thinned out evenly: the picture has fewer pixels.
    stride = max(1, int(np.ceil((np.count_nonzero(mask) / 3_000_000) ** (1 / 3))))
    thin = mask[::stride, ::stride, ::stride]
    return grid.lps(np.argwhere(thin) * stride), stride


def _counted(points: Float, stride: int, view: View, grid: Grid) -> Packed:
    """Count points per pixel, and state by what the count is to be multiplied for millimetres of depth."""
    directions = np.abs(grid.lps_from_ijk[:3, :3]) * stride
    pixel = np.array([float(np.abs(side) @ directions.sum(axis=1)) for side in (view.right, view.up)])
    uv = view.project(points)
    low = uv.min(axis=0) - 2.5 * pixel
    column, row = np.floor((uv - low) / pixel).astype(np.int64).T
    columns, rows = int(column.max()) + 3, int(row.max()) + 3
    count = np.bincount(row * columns + column, minlength=rows * columns).reshape(rows, columns)
    high = low + np.array([columns, rows]) * pixel
    return {
        "count": pack(count, "i4"),
        "mm_per_point": float(grid.voxel_volume_mm3 * stride**3 / pixel.prod()),
        "extent_mm": [float(each) for each in (low[0], high[0], low[1], high[1])],
    }
