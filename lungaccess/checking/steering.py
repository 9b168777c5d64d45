"""Fourth part of the check: the needle follows its arcs to the target, within its limits and clear of all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from anatomy import structures
from anatomy.typed import Float
from lungaccess.checking.clearances import REACH_MM, check_clear, check_stated_clearance
from lungaccess.checking.environment import Environment
from lungaccess.checking.findings import Findings
from lungaccess.checking.poses import (
    ANGLE_TOLERANCE_RAD,
    POSITION_TOLERANCE_MM,
    angle_between,
    check_rigid,
    check_same_pose,
)
from lungaccess.checking.shapes import TINY_MM, Curve, Piece, cut_at, integrate
from lungaccess.checking.space import Select, airway_except, branch_of, has, labels_at
from lungaccess.plans.plan import Plan
from stages.needle.device import Needle

if TYPE_CHECKING:
    from anatomy.lung import Lung

TURN_TOLERANCE_RAD = 1e-3
"""The turn is summed over thousands of small steps, whose rounding adds up to less than this."""
LENGTH_TOLERANCE_MM = 1e-6
"""Lengths are sums of a few numbers and agree up to rounding."""
LIMIT_TOLERANCE = 1e-9
"""A planner may use all of a limit, so that rounding alone may exceed it, by this share."""
COST_TOLERANCE = 0.02
"""Share by which a planner's sampled integral may differ from the finer one of the check."""
COST_STEP_MM = 0.1
"""Step of the integral: small against the distances over which a clearance changes."""
COST_REACH_MM = 100.0
"""No point of a lung is farther than this from the pleura, so that every clearance is found."""
CLEARANCE_FLOOR_MM = 0.1
"""1 / clearance counts a clearance as no less than this [Kuntz2015, eq. 1]."""
GREATEST_VOXEL_COST = 1.0
"""Of one voxel: so much may two sums differ because one grazes a voxel that the other does not."""
GRAZED_MM = 1e-9
"""A voxel that is crossed for less than this is met at an edge only, by rounding."""
COSTS = ("inverse_clearance", "cost_map", "voxel_sum", "length_mm")
ROUNDING = 1e-12
"""Sums of four numbers agree to this share of them, whatever the order."""


def check_needle(plan: Plan, environment: Environment, tube_end: Float | None, found: Findings) -> None:
    """Record everything about the needle, the target and the costs."""
    needle, lung = plan.needle, environment.lung
    if not check_rigid("needle.start", needle.lps_from_start, found):
        return
    check_same_pose("needle.start", needle.lps_from_start, plan.tube.lps_from_tip, found)
    if tube_end is not None:
        check_same_pose("needle.start.integrated", needle.lps_from_start, tube_end, found)
    pieces = [
        Piece(length_mm=arc.length_mm, roll_rad=arc.roll_rad, curvature_per_mm=arc.curvature_per_mm)
        for arc in needle.arcs
    ]
    curve = integrate(needle.lps_from_start, cut_at(pieces, plan.exemption.needle_length_mm))
    if not _check_motion(plan, pieces, curve, found):
        return
    _check_target(plan, lung, curve, found)
    _check_exemption(plan, found)
    _check_containment(plan, lung, curve, found)
    _check_clearance(plan, environment, curve, found)
    _check_costs(plan, environment, curve, found)


def _check_motion(plan: Plan, pieces: Sequence[Piece], curve: Curve, found: Findings) -> bool:
    """Curvature, length and both turning limits; tell whether the needle is as short as the device's."""
    needle = plan.needle
    length = float(sum(arc.length_mm for arc in needle.arcs))
    found.agrees("needle.length", needle.length_mm, length, LENGTH_TOLERANCE_MM, "mm")
    turned, angle = _turning(curve)
    found.agrees("needle.turn", needle.accumulated_turn_rad, turned, TURN_TOLERANCE_RAD, "rad")
    found.agrees("needle.angle", needle.max_angle_from_start_rad, angle, TURN_TOLERANCE_RAD, "rad")
    return check_limits(pieces, plan.system.needle, curve, found)


def _turning(curve: Curve) -> tuple[float, float]:
    """Return the sum of all turning and the largest angle from the start, rad."""
    turned = float(angle_between(curve.tangents[:-1], curve.tangents[1:]).sum())
    return turned, float(angle_between(curve.tangents, curve.tangents[0]).max())


def check_limits(pieces: Sequence[Piece], device: Needle, curve: Curve, found: Findings) -> bool:
    """Record whether arcs keep the limits of a needle; tell whether it is as short as the device's."""
    curvature = [piece.curvature_per_mm for piece in pieces]
    bound = device.max_curvature_per_mm
    detail = "tightest arc"
    found.at_most("needle.curvature", max(curvature), bound, "1/mm", detail, LIMIT_TOLERANCE * bound)
    found.at_least("needle.curvature.sign", min(curvature), 0.0, "1/mm", "a bend is turned by its roll")
    found.at_least("needle.arc_length", min(piece.length_mm for piece in pieces), 1e-9, "mm", "shortest arc")
    turned, angle = _turning(curve)
    limit = float(np.deg2rad(device.max_accumulated_turn_deg))
    found.at_most("needle.turn.limit", turned, limit, "rad", "sum of all turning", ANGLE_TOLERANCE_RAD)
    limit = float(np.deg2rad(device.max_angle_from_start_deg))
    detail = "largest angle from the start direction"
    found.at_most("needle.angle.limit", angle, limit, "rad", detail, ANGLE_TOLERANCE_RAD)
    length, detail = float(sum(piece.length_mm for piece in pieces)), "sum of the arcs"
    return found.at_most(
        "needle.length.limit", length, device.max_length_mm, "mm", detail, LENGTH_TOLERANCE_MM
    )


def _check_target(plan: Plan, lung: Lung, curve: Curve, found: Findings) -> None:
    """The needle ends at the target, which lies in the lung and in no obstacle."""
    end = curve.points[-1]
    found.agrees("needle.end", plan.needle.end_lps, end, POSITION_TOLERANCE_MM, "mm")
    miss = float(np.linalg.norm(end - plan.target_lps))
    if plan.target_origin.startswith("nodule"):
        ends = np.stack([end, plan.target_lps])
        found.true("target.in_nodule", _in_nodule(lung, ends), "needle end and target are nodule")
    else:
        found.at_most("target.reached", miss, POSITION_TOLERANCE_MM, "mm", "end of the needle to the target")
    label = int(labels_at(lung, plan.target_lps)[0])
    found.true("target.in_lung", not label & structures.OUTSIDE, "the target is lung")
    forbidden = forbidden_bits(plan)
    found.true("target.free", not label & forbidden, "the target lies in no obstacle")


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


def _check_exemption(plan: Plan, found: Findings) -> None:
    """The exemption is not longer than the device's; the exit of the tubes settles its branch and point."""
    exempt = plan.exemption.needle_length_mm
    limit, detail = plan.system.needle.exit_exemption_mm, "needle that may be near the pierced wall"
    found.at_most("exemption.length", exempt, limit, "mm", detail, LENGTH_TOLERANCE_MM)
    found.at_least("exemption.length.sign", exempt, 0.0, "mm")


def _check_containment(plan: Plan, lung: Lung, curve: Curve, found: Findings) -> None:
    """Every sample is in the lung and in no obstacle: a surface alone does not tell inside from outside."""
    labels = labels_at(lung, curve.points)
    outside = (labels & structures.OUTSIDE) != 0
    detail = f"{int(outside.sum())} samples outside the lung, or between the lungs"
    found.true("needle.in_lung", not outside.any(), detail)
    found.true("needle.not_in_lumen", not ((labels & structures.LUMEN) != 0).any(), "no sample in an airway")
    exempt = curve.arc_mm < plan.exemption.needle_length_mm - TINY_MM
    own_wall = ((labels & structures.AIRWAY) != 0) & (branch_of(labels) == plan.exemption.branch) & exempt
    others = forbidden_bits(plan) & ~structures.AIRWAY
    hit = ((labels & others) != 0) | (((labels & structures.AIRWAY) != 0) & ~own_wall)
    found.true("needle.containment", not hit.any(), f"{int(hit.sum())} samples in an obstacle")


def _check_clearance(plan: Plan, environment: Environment, curve: Curve, found: Findings) -> None:
    """The needle, as capsules padded by the sagitta, keeps radius and margins from every structure."""
    radius = 0.5 * plan.system.needle.diameter_mm
    required = radius + plan.system.margins.total_mm
    everywhere = np.ones(len(curve.points), dtype=bool)
    exempt = curve.arc_mm < plan.exemption.needle_length_mm - TINY_MM
    cases: list[tuple[str, Select, np.ndarray, float]] = [
        ("vessel", has(structures.VESSEL), everywhere, required),
        ("outside", has(structures.OUTSIDE), everywhere, required),
        ("airway", has(structures.AIRWAY), ~exempt, required),
        ("other_airway", airway_except(plan.exemption.branch), exempt, required),
        ("lumen", has(structures.LUMEN), exempt, radius),
        ("fissure", has(structures.FISSURE), everywhere, required),
    ]
    nearest: dict[str, float] = {}
    for name, select, where, needed in cases:
        first, last = run_of_frames(where)
        if last - first < 1:
            continue
        nearest[name] = check_clear(
            f"needle.clearance.{name}",
            environment.boxes(select, REACH_MM),
            curve.points[first : last + 1],
            needed + curve.sagitta_mm[first:last],
            found,
            limited=name != "fissure" or plan.fissures_are_obstacles,
        )
    # Towards the airway counts all of it behind the exempt length, and other branches before.
    airway = min(nearest.pop("airway", REACH_MM), nearest.pop("other_airway", REACH_MM))
    nearest.pop("lumen", None)
    diagonal = float(np.linalg.norm(environment.lung.grid.spacing_mm))
    for name, exact in {**nearest, "airway": airway}.items():
        check_stated_clearance(plan, "needle", name, (exact, exact), diagonal, found)


def run_of_frames(where: np.ndarray) -> tuple[int, int]:
    """Return first and last frame of a run of True frames; an exempt run reaches the next frame."""
    frames = np.flatnonzero(where)
    if not len(frames):
        return 0, 0
    return int(frames[0]), min(int(frames[-1]) + 1, len(where) - 1)


def _check_costs(plan: Plan, environment: Environment, curve: Curve, found: Findings) -> None:
    """The stated costs are those of the re-integrated needle."""
    stated: Mapping[str, float] = plan.costs
    required = set(COSTS) - {"voxel_sum"}
    named = required <= set(stated) <= {*COSTS, plan.objective}
    if not found.true("costs.names", named, ", ".join(stated)):
        return
    weights = objective_weights(plan.objective)
    known = plan.objective in stated and weights is not None and set(weights) <= set(stated)
    is_sum = plan.objective not in COSTS
    if found.true("costs.objective", known, plan.objective) and is_sum and weights is not None:
        total = sum(weight * stated[name] for name, weight in weights.items())
        tolerance = ROUNDING * abs(total)
        found.agrees("costs.objective.sum", stated[plan.objective], total, tolerance, "")
    found.agrees("costs.length_mm", stated["length_mm"], curve.arc_mm[-1], LENGTH_TOLERANCE_MM, "mm")
    recomputed = inverse_clearance(plan, environment, curve)
    tolerance = COST_TOLERANCE * recomputed
    found.agrees("costs.inverse_clearance", stated["inverse_clearance"], recomputed, tolerance, "")
    mapped, summed = cost_map_integral_and_sum(environment.lung, curve)
    found.agrees("costs.cost_map", stated["cost_map"], mapped, COST_TOLERANCE * mapped + 1e-6, "mm")
    if "voxel_sum" in stated:
        tolerance = COST_TOLERANCE * summed + GREATEST_VOXEL_COST
        found.agrees("costs.voxel_sum", stated["voxel_sum"], summed, tolerance, "")


def objective_weights(objective: str) -> dict[str, float] | None:
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
    in_range = all(0.0 < weight < np.inf for weight in weights.values())
    return weights if in_range and set(weights) <= set(COSTS) else None


def inverse_clearance(plan: Plan, environment: Environment, curve: Curve) -> float:
    """Return the integral of 1 / clearance over the needle's length [Kuntz2015], by the trapezoid rule.

    The clearance to the nearest obstacle, voxels as solid boxes, is not taken below 0.1 mm nor above
    `COST_REACH_MM`, which is farther than any point of a lung lies from its pleura.
    """
    length = float(curve.arc_mm[-1])
    arc = np.linspace(0.0, length, max(int(np.ceil(length / COST_STEP_MM)), 1) + 1)
    points = np.stack([np.interp(arc, curve.arc_mm, curve.points[:, axis]) for axis in range(3)], axis=1)
    obstacles = has(forbidden_bits(plan))
    clearance = environment.boxes(obstacles, REACH_MM).distance_mm(points)
    far = clearance >= REACH_MM
    if far.any():
        clearance[far] = environment.boxes(obstacles, COST_REACH_MM).distance_mm(points[far])
    return float(np.trapezoid(1.0 / np.maximum(clearance, CLEARANCE_FLOOR_MM), arc))


def cost_map_integral_and_sum(lung: Lung, curve: Curve) -> tuple[float, float]:
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
