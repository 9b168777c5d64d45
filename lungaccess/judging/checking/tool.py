"""Part of the check: enough of the nodule is in the tool as planned, counted voxel by voxel."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from anatomy.base.typed import Bool, Float, Int
from lungaccess.judging.checking.findings import Findings

if TYPE_CHECKING:
    from anatomy.lung import Lung
    from lungaccess.plans.plan import Plan
    from lungaccess.problem.tools import Tool

TISSUE = "tool.tissue"
"""The name of the finding."""
PARTS = 6
"""A voxel is cut into so many parts along each axis where a volume is counted."""
BALL_RADIUS_MM = 5.0
"""A target in no nodule of a mask counts as the centre of a nodule of this radius."""
BALL_VOXEL_MM = 0.25


def check_tool(plan: Plan, lung: Lung, lps_from_end: Float, found: Findings) -> None:
    """Record how much of the nodule is in the tool of a plan whose needle ends with a frame `(4, 4)`."""
    tool = plan.system.tool
    if tool is None:
        return
    voxels, frame = _nodule(tool, lung, np.asarray(plan.target_lps))
    # Positions in voxels, seen from the tip.
    ijk_from_tip = np.linalg.inv(frame) @ lps_from_end
    edges_mm = np.linalg.norm(frame[:3, :3], axis=0)
    if tool.unit == "mm":
        # The planner knows where a core enters and leaves the nodule, and voxels at the edge, to 0.1 mm each.
        value, tolerance = _length_in(tool, voxels, ijk_from_tip), 0.3
    else:
        inside_mm3 = float(_share_in(tool, voxels, ijk_from_tip).sum() * np.prod(edges_mm))
        whole_mm3 = len(voxels) * float(np.prod(edges_mm))
        value = inside_mm3 if tool.unit == "mm3" else inside_mm3 / whole_mm3
        # Share of what is wanted by which volumes may differ: the planner counts few points of the tool.
        tolerance = 0.1 * tool.least
    found.at_least(TISSUE, value, tool.least, tool.unit, f"wanted: {tool.words}", tolerance)


def _nodule(tool: Tool, lung: Lung, target: Float) -> tuple[Int, Float]:
    """Return the voxels `(V, 3)` that count as nodule, and the map from their indices to LPS mm."""
    nodules = lung.nodules
    frame = np.eye(4)
    if nodules is None or not nodules.at(target, False):
        reach = BALL_RADIUS_MM + tool.margin_mm + 2.0 * BALL_VOXEL_MM
        count = 2 * int(np.ceil(reach / BALL_VOXEL_MM)) + 1
        frame[:3, :3] *= BALL_VOXEL_MM
        frame[:3, 3] = target - 0.5 * (count - 1) * BALL_VOXEL_MM
        axes = [BALL_VOXEL_MM * (np.arange(count) - 0.5 * (count - 1))] * 3
        away = np.sqrt(sum(each**2 for each in np.meshgrid(*axes, indexing="ij")))
        solid = away <= BALL_RADIUS_MM
        spacing = np.full(3, BALL_VOXEL_MM)
    else:
        parts, _count = ndimage.label(nodules.array, np.ones((3, 3, 3)))
        own = parts[tuple(nodules.grid.voxels(target))]
        window = ndimage.find_objects(parts)[own - 1]
        spacing = nodules.grid.spacing_mm
        pad = np.ceil(tool.margin_mm / spacing).astype(int) + 1
        solid = np.pad(parts[window] == own, [(each, each) for each in pad])
        frame = np.array(nodules.grid.lps_from_ijk)
        frame[:3, 3] += frame[:3, :3] @ (np.array([axis.start for axis in window]) - pad)
    counted: Bool = solid
    if tool.margin_mm:
        counted = counted | (ndimage.distance_transform_edt(~solid, sampling=spacing) <= tool.margin_mm)
    if tool.rim_mm:
        counted = counted & (ndimage.distance_transform_edt(solid, sampling=spacing) <= tool.rim_mm)
    return np.argwhere(counted), frame


def _length_in(tool: Tool, voxels: Int, ijk_from_tip: Float) -> float:
    """Return the length of the tool's axis in voxels, mm: the sum of what lies in each of them."""
    begin = (ijk_from_tip @ [0.0, 0.0, tool.from_tip_mm, 1.0])[:3]
    along = (ijk_from_tip @ [0.0, 0.0, tool.to_tip_mm, 1.0])[:3] - begin
    along = np.where(np.abs(along) < 1e-12, 1e-12, along)
    sides = np.stack([(voxels - 0.5 - begin) / along, (voxels + 0.5 - begin) / along])
    enters = np.maximum(sides.min(axis=0).max(axis=1), 0.0)
    leaves = np.minimum(sides.max(axis=0).min(axis=1), 1.0)
    return float(np.maximum(leaves - enters, 0.0).sum() * tool.length_mm)


def _share_in(tool: Tool, voxels: Int, ijk_from_tip: Float) -> Float:
    """Return the share `(V,)` of each voxel that is in the tool."""
    tip_from_ijk = np.linalg.inv(ijk_from_tip)
    middle = 0.5 * (tool.from_tip_mm + tool.to_tip_mm)
    steps = (np.arange(PARTS) + 0.5) / PARTS - 0.5
    shares = np.zeros(len(voxels))
    for step in np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3):
        x, y, z = tip_from_ijk[:3, :3] @ (voxels + step).T + tip_from_ijk[:3, 3:]
        across = np.hypot(x, y) / (0.5 * tool.diameter_mm)
        along = np.abs(z - middle) / (0.5 * tool.length_mm)
        reaches = np.hypot(across, along) if tool.shape == "ellipsoid" else np.maximum(across, along)
        shares += reaches <= 1.0
    return shares / PARTS**3
