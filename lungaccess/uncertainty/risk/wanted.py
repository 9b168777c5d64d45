"""What counts as a hit: the last tip in a ball about the target, or enough of the nodule in the tool."""

from __future__ import annotations

import math

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.typed import Float, Int, UInt8
from anatomy.grid import Grid
from anatomy.lung import Lung
from anatomy.morphology import components
from lungaccess.problem.tools import Tool
from lungaccess.uncertainty.risk.kernels.outcomes import Wanted


def wanted_of(
    tool: Tool | None, radius_mm: float, own: Int | None = None, grid: Grid | None = None
) -> Wanted:
    """Return what has to be in a tool, for kernels.

    Parameters
    ----------
    tool : Tool or None
        None for the last tip itself, which has to end within the radius of the target.
    radius_mm : float
        Of the nodule as a ball about the target.
    own : (V, 3) int64, optional
        Voxels of the nodule, which is the ball without them.
    grid : Grid, optional
        On which they are.
    """
    if tool is None:
        return Wanted(np.zeros((1, 3)), 1.0, *_NO_VOXELS, radius_mm, 0.0, 1.0)
    points = np.ascontiguousarray(tool.points())
    tissue, geometry, within = *_NO_VOXELS, radius_mm + tool.margin_mm
    beyond = max(radius_mm - tool.rim_mm, 0.0) if tool.rim_mm else 0.0
    volume = 4.0 / 3.0 * math.pi * (within**3 - beyond**3)
    if own is not None and grid is not None:
        tissue, geometry = _counted(tool, own, grid)
        volume = float(np.count_nonzero(tissue)) * grid.voxel_volume_mm3
    whole = {"mm": tool.length_mm, "mm3": tool.volume_mm3, "share": tool.volume_mm3 / volume}[tool.unit]
    # Half a point less: what is counted in points is as often too much as too little.
    weight = whole / len(points)
    return Wanted(points, weight, tissue, geometry, within, beyond, tool.least - 0.5 * weight)


_NO_VOXELS = np.zeros((0, 0, 0), dtype=np.uint8), np.zeros((3, 4))


def _counted(tool: Tool, own: Int, grid: Grid) -> tuple[UInt8, Float]:
    """Return the voxels that count about a nodule, and the map from LPS mm to them."""
    import edt

    pad = np.ceil(tool.margin_mm / grid.spacing_mm).astype(np.int64) + 1
    low = own.min(axis=0) - pad
    solid = np.zeros(own.max(axis=0) - low + 1 + pad, dtype=bool)
    solid[tuple((own - low).T)] = True
    spacing = tuple(map(float, grid.spacing_mm))
    counted = solid
    if tool.margin_mm:
        counted = counted | (edt.edt(~solid, anisotropy=spacing) <= tool.margin_mm)
    if tool.rim_mm:
        counted = counted & (edt.edt(solid, anisotropy=spacing) <= tool.rim_mm)
    geometry = np.array(grid.ijk_from_lps[:3])
    # Voxel number i spans i to i + 1 of the box.
    geometry[:, 3] += 0.5 - low
    return counted.astype(np.uint8), geometry


def goal_radius(lung: Lung, target_lps: Float, radius_mm: float | None = None) -> tuple[float, str]:
    """Return the radius of the goal about a target in mm, and its origin in words.

    It is the given one, or that of the ball as large as the target's nodule; see `RiskAssessor`.
    """
    if radius_mm is not None:
        if not 0.0 < radius_mm < math.inf:
            raise SettingsError(
                f"The radius of the goal is {radius_mm} mm",
                expected="a finite length above 0",
                remedy="Choose a radius in mm, such as 5",
            )
        return float(radius_mm), "given"
    own = own_nodule(lung, target_lps)
    if own is not None:
        volume = float(len(own)) * lung.nodules.grid.voxel_volume_mm3
        return (0.75 * volume / math.pi) ** (1.0 / 3.0), "ball of the nodule's volume"
    # Radius of the goal where the target is no nodule of the nodule mask: one of 10 mm.
    return 5.0, "assumed: the target lies in no nodule of a mask"


def own_nodule(lung: Lung, target_lps: Float) -> Int | None:
    """Return the voxels `(V, 3)` of the nodule of the mask in which a target lies; None if it lies in none."""
    nodules = lung.nodules
    if nodules is None or not nodules.at(target_lps, False):
        return None
    voxels, part = components(nodules.array)
    own = part[(voxels == nodules.grid.voxels(target_lps)).all(axis=1)]
    return voxels[part == own]
