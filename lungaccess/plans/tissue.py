"""What counts as success: the last tip in a ball about the target, or enough of the nodule in the tool."""

import math

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.typed import Float, Int, UInt8
from anatomy.grid import Grid
from anatomy.lung import Lung
from lungaccess.plans.kernels.tissue import Wanted
from lungaccess.problem.tools import Tool

_NO_POINTS = np.zeros((0, 3))
_NO_VOXELS = np.zeros((0, 0, 0), dtype=np.uint8), np.zeros((3, 4))
_BALL_STEPS = 12


def wanted_of(lung: Lung, target_lps: Float, tool: Tool | None, radius_mm: float | None = None) -> Wanted:
    """Return what has to be in a tool, for kernels; errors as `goal_radius`.

    Args:
        target_lps: (3,) float64.
        tool: None for the last tip itself, which has to end within the radius of the goal, see `goal_radius`.
        radius_mm: The nodule counts as a ball of that radius; if None, it is that of the mask where there is
            one.
    """
    target, (radius, _origin) = (
        np.array(target_lps, dtype=np.float64),
        goal_radius(lung, target_lps, radius_mm),
    )
    if tool is None:
        tip = np.zeros((1, 3))
        return Wanted(target, tip, 1.0, *_NO_VOXELS, 0.0, radius, _NO_POINTS, 0.0, 0.0, 0.0, False, 1.0)
    points, covered, (tissue, geometry) = tool.points(), _NO_POINTS, _NO_VOXELS
    outer = radius + tool.margin_mm
    inner = max(radius - tool.rim_mm, 0.0) if tool.rim_mm else 0.0
    own = own_nodule(lung, target_lps) if radius_mm is None else None
    if own is not None:
        tissue, geometry = _counted(tool, own, lung.grid)
    weight = {"mm": tool.length_mm, "mm3": tool.volume_mm3, "share": 0.0}[tool.unit] / len(points)
    if tool.unit == "share":
        covered = _spread_over(tissue, geometry, target, (inner, outer))
        weight = 1.0 / len(covered)
    # Half a point less: what is counted in points is as often too much as too little.
    return Wanted(
        target, np.ascontiguousarray(points), weight, tissue, geometry, inner, outer, covered,
        tool.beyond_mm, 0.5 * tool.length_mm, 0.5 * tool.diameter_mm, tool.shape == "ellipsoid",
        tool.least - 0.5 * weight,
    )  # fmt: skip


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
    geometry[:, 3] += 0.5 - low
    return counted.astype(np.uint8), geometry


def _spread_over(tissue: UInt8, geometry: Float, target: Float, between_mm: tuple[float, float]) -> Float:
    """Return points `(M, 3)` spread over a nodule, LPS mm from the target."""
    if tissue.size:
        # About so many points of a nodule say which share of it is in a tool: to a thousandth.
        voxels = np.argwhere(tissue)[:: max(1, int(tissue.sum()) // 1000)] + 0.5
        return np.asarray(np.linalg.solve(geometry[:, :3], (voxels - geometry[:, 3]).T).T - target)
    inner, outer = between_mm
    side = outer * ((2.0 * np.arange(_BALL_STEPS) + 1.0) / _BALL_STEPS - 1.0)
    points = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3)
    away = np.linalg.norm(points, axis=1)
    return np.asarray(points[(inner <= away) & (away <= outer)])


def goal_radius(lung: Lung, target_lps: Float, radius_mm: float | None = None) -> tuple[float, str]:
    """Return the radius of the goal about a target in mm, and its origin in words.

    It is the given one, or that of the ball as large as the target's nodule, or 5 mm, of a nodule of 10 mm,
    where the target lies in none of the mask.  SettingsError is raised if a given one is no length.
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
        volume = float(len(own)) * lung.grid.voxel_volume_mm3
        return (0.75 * volume / math.pi) ** (1.0 / 3.0), "ball of the nodule's volume"
    return 5.0, "assumed: the target lies in no nodule of a mask"


def own_nodule(lung: Lung, target_lps: Float) -> Int | None:
    """Return the voxels `(V, 3)` of the nodule of the mask in which a target lies; None without one."""
    nodules, (voxels, part) = lung.nodules, lung.nodule_parts
    if nodules is None or not nodules.at(target_lps, False):
        return None
    own = part[(voxels == nodules.grid.voxels(target_lps)).all(axis=1)]
    return np.asarray(voxels[part == own])
