"""Last part of the check: devices end at the target, enough of it in the tool, and cost what is stated."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy import ndimage

from anatomy import structures
from anatomy.base.errors import LungaccessError
from anatomy.base.typed import Bool, Float, Int
from lungaccess.judging.checking.boxes import Environment, has, labels_at
from lungaccess.judging.checking.clearances import REACH_MM
from lungaccess.judging.checking.findings import (
    LENGTH_TOLERANCE_MM,
    POSITION_TOLERANCE_MM,
    Findings,
    angle_between,
)
from lungaccess.judging.checking.shapes import Curve, beyond, cut_at, integrate, radius_at, tube_pieces, up_to
from lungaccess.plans.plan import Plan

if TYPE_CHECKING:
    from anatomy.lung import Lung
    from lungaccess.problem.tools import Tool

COST_TOLERANCE = 0.02
"""Share by which a planner's sampled integral may differ from the finer one of the check."""
COST_REACH_MM = 100.0
"""No point of a lung is farther than this from the pleura, so that every clearance is found."""
GREATEST_VOXEL_COST = 1.0
"""Of one voxel: so much may two sums differ because one grazes a voxel that the other does not."""
GRAZED_MM = 1e-9
"""A voxel that is crossed for less than this is met at an edge only, by rounding."""
LATER_COSTS = frozenset({"voxel_sum", "tissue"})
"""Costs that a plan may leave out: one of an earlier version, or whose tubes cross an infinite cost."""


def check_tubes_at_target(
    plan: Plan, environment: Environment, tube_tip: Float | None, found: Findings
) -> None:
    """Without a needle the tip of the tubes is at the target; they are what the plan's costs are of.

    The costs count from where the axis leaves the lumen, those of the map from behind the wall.
    """
    found.at_most("exemption.length", plan.exemption.needle_length_mm, 0.0, "mm", "there is no needle")
    if tube_tip is None:
        return
    check_target(plan, environment.lung, tube_tip[:3, 3], found)
    miss, detail = float(np.linalg.norm(tube_tip[:3, 3] - plan.end_lps)), "tip of the tubes to the target"
    found.at_most("tube.at_target", miss, POSITION_TOLERANCE_MM, "mm", detail)
    curve = integrate(plan.scope.lps_from_scope_tip, tube_pieces(plan))
    way_out = plan.tube.exit
    in_tissue = beyond(curve, way_out.arc_length_mm)
    check_costs(plan, environment, in_tissue, found, beyond(in_tissue, way_out.wall_run_mm))


class Recomputed(NamedTuple):
    """A cost as the check finds it, by how much a stated one may differ, and its unit."""

    value: float
    tolerance: float
    unit: str


def recomputed_costs(
    plan: Plan, environment: Environment, curve: Curve, mapped_curve: Curve | None = None
) -> dict[str, Recomputed]:
    """Return every cost by its name, of a re-integrated curve; those of the map of another if given."""
    along = inverse_clearance(plan, environment, curve)
    mapped, summed = _cost_map_integral_and_sum(environment.lung, mapped_curve or curve)
    crossed = tissue(plan, environment, curve)
    return {
        "inverse_clearance": Recomputed(along, COST_TOLERANCE * along, ""),
        "cost_map": Recomputed(mapped, COST_TOLERANCE * mapped + 1e-6, "mm"),
        "voxel_sum": Recomputed(summed, COST_TOLERANCE * summed + GREATEST_VOXEL_COST, ""),
        "length_mm": Recomputed(float(curve.arc_mm[-1]), LENGTH_TOLERANCE_MM, "mm"),
        "tissue": Recomputed(crossed, COST_TOLERANCE * crossed + 1e-6, "mm"),
    }


def check_target(plan: Plan, lung: Lung, end: Float, found: Findings) -> None:
    """The needle, or the tubes, end at the target, which lies in the lung and in no obstacle.

    Devices with an aim end there instead: how near that is to the target, its window says, or for a tool
    `check_tool`.
    """
    miss = float(np.linalg.norm(end - plan.end_lps))
    if plan.aim is not None:
        found.at_most("target.aim", miss, POSITION_TOLERANCE_MM, "mm", "end of the devices to the aim")
        if plan.target_origin.startswith("nodule"):
            found.true("target.in_nodule", _in_nodule(lung, plan.target_lps[None]), "the target is nodule")
    elif plan.target_origin.startswith("nodule"):
        ends = np.stack([end, plan.target_lps])
        found.true("target.in_nodule", _in_nodule(lung, ends), "end of the devices and target are nodule")
    else:
        found.at_most("target.reached", miss, POSITION_TOLERANCE_MM, "mm", "end of the devices to the target")
    label = int(labels_at(lung, plan.target_lps)[0])
    found.true("target.in_lung", not label & structures.OUTSIDE, "the target is lung")
    found.true("target.free", not label & forbidden_bits(plan), "the target lies in no obstacle")


def _in_nodule(lung: Lung, points: Float) -> bool:
    if lung.nodules is None:
        return False
    index = np.rint(lung.nodules.grid.ijk(points)).astype(np.int64)
    if ((index < 0) | (index >= np.asarray(lung.nodules.grid.shape))).any():
        return False
    return bool(lung.nodules.array[tuple(index.T)].all())


def forbidden_bits(plan: Plan) -> int:
    """Return the structures that the needle must stay clear of."""
    return structures.obstacle_bits(plan.fissures_are_obstacles)


def check_costs(
    plan: Plan, environment: Environment, curve: Curve, found: Findings, mapped_curve: Curve | None = None
) -> None:
    """The stated costs are those of a re-integrated curve, those of the map of another if there is one."""
    stated: Mapping[str, float] = plan.costs
    costs = recomputed_costs(plan, environment, curve, mapped_curve)
    named = set(costs) - LATER_COSTS <= set(stated) <= {*costs, plan.objective}
    if not found.true("costs.names", named, ", ".join(stated)):
        return
    weights = _objective_weights(plan.objective)
    known = plan.objective in stated and weights is not None and set(weights) <= set(costs) & set(stated)
    if (
        found.true("costs.objective", known, plan.objective)
        and plan.objective not in costs
        and weights is not None
    ):
        total = sum(weight * stated[name] for name, weight in weights.items())
        # Sums of four numbers agree to this share of them, whatever the order.
        tolerance = 1e-12 * abs(total)
        found.agrees("costs.objective.sum", stated[plan.objective], total, tolerance, "")
    for name, (value, tolerance, unit) in costs.items():
        if name in stated:
            largest = tolerance if np.isfinite(value) else 0.0
            found.agrees(f"costs.{name}", stated[name], value, largest, unit)


def _objective_weights(objective: str) -> dict[str, float] | None:
    """Return the weights of an objective by the names of costs; None if its text is not one.

    The text is the name of a cost, or a sum such as "cost_map=0.5,length_mm=1".
    """
    weights: dict[str, float] = {}
    for part in objective.split(","):
        name, equals, weight = part.partition("=")
        try:
            weights[name] = float(weight) if equals else 1.0
        except ValueError:
            return None
    return weights if all(0.0 < weight < np.inf for weight in weights.values()) else None


def inverse_clearance(plan: Plan, environment: Environment, curve: Curve) -> float:
    """Return the integral of 1 / clearance over the length of a curve [Kuntz2015], by the trapezoid rule.

    The clearance to the nearest obstacle, voxels as solid boxes, is not taken below 0.1 mm nor above
    `COST_REACH_MM`, which is farther than any point of a lung lies from its pleura.
    """
    length = float(curve.arc_mm[-1])
    # Step of the integral: small against the distances over which a clearance changes.
    arc = np.linspace(0.0, length, max(int(np.ceil(length / 0.1)), 1) + 1)
    points = np.stack([np.interp(arc, curve.arc_mm, curve.points[:, axis]) for axis in range(3)], axis=1)
    obstacles = has(forbidden_bits(plan))
    clearance = environment.boxes(obstacles, REACH_MM).distance_mm(points)
    far = clearance >= REACH_MM
    if far.any():
        clearance[far] = environment.boxes(obstacles, COST_REACH_MM).distance_mm(points[far])
    # 1 / clearance counts a clearance as no less than this [Kuntz2015, eq. 1].
    return float(np.trapezoid(1.0 / np.maximum(clearance, 0.1), arc))


def tissue(plan: Plan, environment: Environment, curve: Curve) -> float:
    """Return the integral over all in tissue of the width times 1 / clearance and the cost map, in mm.

    The tubes count from behind the wall, each stretch with the diameter of the tube that is outermost there,
    then the needle, if there is one, whose curve is `curve`.  A map counts where there is one.
    """
    inserted = plan.tube.insertions_mm(plan.system.tubes)
    begin_mm = plan.tube.exit.arc_length_mm + plan.tube.exit.wall_run_mm
    pieces = tube_pieces(plan)
    for end_mm in inserted:
        pieces = cut_at(pieces, end_mm)
    tubes = integrate(plan.scope.lps_from_scope_tip, pieces)
    parts = [] if plan.system.needle is None else [(curve, plan.system.needle.diameter_mm)]
    for end_mm in inserted:
        if end_mm > begin_mm:
            part = beyond(up_to(tubes, end_mm), begin_mm)
            middle_mm = np.array([0.5 * (begin_mm + end_mm)])
            parts.append((part, 2.0 * float(radius_at(plan, middle_mm)[0])))
            begin_mm = end_mm
    total = 0.0
    for part, width_mm in parts:
        mapped, _summed = _cost_map_integral_and_sum(environment.lung, part)
        total += width_mm * (inverse_clearance(plan, environment, part) + mapped)
    return total


def _cost_map_integral_and_sum(lung: Lung, curve: Curve) -> tuple[float, float]:
    """Return the line integral of the cost map in mm, and its sum over the set of voxels crossed.

    The chords of the curve, shorter than a voxel, are cut at the faces of voxels.  Without a map both are
    0; both are infinite off the grid and in voxels of infinite cost.
    """
    if lung.cost is None:
        return 0.0, 0.0
    place = lung.cost.grid.ijk(curve.points) + 0.5
    cell = np.floor(place)
    cuts = [curve.arc_mm]
    for axis in range(3):
        step = np.flatnonzero(cell[1:, axis] != cell[:-1, axis])
        begin, end = place[step, axis], place[step + 1, axis]
        share = (np.maximum(cell[step, axis], cell[step + 1, axis]) - begin) / (end - begin)
        cuts.append(curve.arc_mm[step] + share * np.diff(curve.arc_mm)[step])
    arc = np.sort(np.concatenate(cuts))
    length = np.diff(arc)
    middle = 0.5 * (arc[1:] + arc[:-1])[length > GRAZED_MM]
    index = np.stack([np.floor(np.interp(middle, curve.arc_mm, place[:, n])) for n in range(3)], axis=1)
    inside = ((index >= 0) & (index < np.asarray(lung.cost.grid.shape))).all(axis=1)
    if not inside.all():
        return float("inf"), float("inf")
    voxels, which = np.unique(index.astype(np.int64), axis=0, return_inverse=True)
    values = lung.cost.array[tuple(voxels.T)].astype(np.float64)
    if not np.isfinite(values).all():
        return float("inf"), float("inf")
    return float((values[which.ravel()] * length[length > GRAZED_MM]).sum()), float(values.sum())


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


NEEDLE_LOAD = "tube.needle_load"
"""The finding has this name: it states what the needle does to the tip of the tubes."""
STILL_MM = 1e-3
"""A tip that moves less is where the plan states it."""


def check_needle_load(plan: Plan, found: Findings) -> None:
    """Record where the tubes' tip is under the needle's load, if no tissue holds the tubes.

    A needle whose tip stays at that of the tubes while they are deployed bends with them: the stated shape is
    theirs together, and it must not move them any more while it is inserted.  What any other needle does is
    counted by no plan, is not checked here, and is said.
    """
    tube, tubes, shaft, needle = plan.tube, plan.system.tubes, plan.system.needle_tube, plan.needle
    if needle is None or shaft is None:
        return
    from stages.tube.casadi_shape import derive_arrival, derive_inserted

    deployed = tubes.nested, shaft, tube.rotations_rad(tubes)[::-1], tube.insertions_mm(tubes)[::-1]
    try:
        if plan.system.needle_preloaded:
            loaded = derive_inserted(*deployed, needle.length_mm)
            stated = np.linalg.solve(plan.scope.lps_from_scope_tip, tube.lps_from_tip)
            off_mm = float(np.linalg.norm(loaded[:3, 3] - stated[:3, 3]))
            detail = "from the stated tip of the tubes to that under the load of the inserted needle"
            # The stated arcs are the tubes up to an error that clearances count.
            found.at_most(NEEDLE_LOAD, off_mm, tube.shape.arc_error_mm, "mm", detail, STILL_MM)
            return
        before, arrived = derive_arrival(*deployed)
    except LungaccessError as error:
        found.unchecked(NEEDLE_LOAD, f"no shape was found with the needle in the tubes: {error}")
        return
    shift_mm = float(np.linalg.norm(arrived[:3, 3] - before[:3, 3]))
    turn_rad = float(angle_between(arrived[:3, 2], before[:3, 2]))
    detail = (
        f"when the needle arrives, the tubes' tip moves by {shift_mm:.1f} mm and turns by "
        f"{math.degrees(turn_rad):.0f}° in the air"
    )
    if shift_mm > STILL_MM:
        found.unchecked(NEEDLE_LOAD, detail)
    else:
        found.measured(NEEDLE_LOAD, shift_mm, "mm", "motion of the tubes' tip when the needle arrives")
