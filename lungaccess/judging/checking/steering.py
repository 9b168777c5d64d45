"""Fourth part of the check: the needle follows its arcs to the target, within its limits and clear of all.

A needle that was planned alone, without tubes, is checked here as well.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from anatomy import structures
from anatomy.base.typed import Bool, Float
from lungaccess.judging.checking import clearances
from lungaccess.judging.checking.boxes import Environment, Select, airway_except, branch_of, has, labels_at
from lungaccess.judging.checking.findings import (
    ANGLE_TOLERANCE_RAD,
    LENGTH_TOLERANCE_MM,
    POSITION_TOLERANCE_MM,
    CheckReport,
    Findings,
    angle_between,
    check_rigid,
    check_same_pose,
)
from lungaccess.judging.checking.outcome import check_costs, check_target, check_tool, forbidden_bits
from lungaccess.judging.checking.shapes import TINY_MM, Curve, Piece, cut_at, integrate
from lungaccess.plans.parts import NeedlePath
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import System
from stages.needle.device import Needle

if TYPE_CHECKING:
    from anatomy.lung import Lung

TURN_TOLERANCE_RAD = 1e-3
"""The turn is summed over thousands of small steps, whose rounding adds up to less than this."""


def check_needle(
    plan: Plan,
    needle: NeedlePath,
    device: Needle,
    environment: Environment,
    tube_end: Float | None,
    found: Findings,
) -> None:
    """Record everything about the needle, the target and the costs."""
    lung = environment.lung
    if not check_rigid("needle.start", needle.lps_from_start, found):
        return
    check_same_pose("needle.start", needle.lps_from_start, plan.tube.lps_from_tip, found)
    if tube_end is not None:
        check_same_pose("needle.start.integrated", needle.lps_from_start, tube_end, found)
    curve = integrate(needle.lps_from_start, cut_at(needle.arcs, plan.exemption.needle_length_mm))
    length = float(sum(arc.length_mm for arc in needle.arcs))
    found.agrees("needle.length", needle.length_mm, length, LENGTH_TOLERANCE_MM, "mm")
    turned, angle = turning(curve)
    found.agrees("needle.turn", needle.accumulated_turn_rad, turned, TURN_TOLERANCE_RAD, "rad")
    found.agrees("needle.angle", needle.max_angle_from_start_rad, angle, TURN_TOLERANCE_RAD, "rad")
    if not _check_limits(needle.arcs, device, curve, found):
        return
    found.agrees("needle.end", needle.end_lps, curve.points[-1], POSITION_TOLERANCE_MM, "mm")
    check_target(plan, lung, curve.points[-1], found)
    check_tool(plan, lung, curve.end, found)
    # The exit of the tubes settles branch and point of the exemption.
    exempt, limit = plan.exemption.needle_length_mm, device.exit_exemption_mm
    detail = "needle that may be near the pierced wall"
    found.at_most("exemption.length", exempt, limit, "mm", detail, LENGTH_TOLERANCE_MM)
    found.at_least("exemption.length.sign", exempt, 0.0, "mm")
    _check_containment(plan, lung, curve, found)
    _check_clearance(plan, device, environment, curve, found)
    check_costs(plan, environment, curve, found)


def turning(curve: Curve) -> tuple[float, float]:
    """Return the sum of all turning and the largest angle from the start, rad."""
    turned = float(angle_between(curve.tangents[:-1], curve.tangents[1:]).sum())
    return turned, float(angle_between(curve.tangents, curve.tangents[0]).max())


def _check_limits(pieces: Sequence[Piece], device: Needle, curve: Curve, found: Findings) -> bool:
    """Record whether arcs keep the limits of a needle; tell whether it is as short as the device's."""
    curvature = [piece.curvature_per_mm for piece in pieces]
    bound = device.max_curvature_per_mm
    detail = "tightest arc"
    # A planner may use all of a limit, so that rounding alone may exceed it, by this share.
    found.at_most("needle.curvature", max(curvature), bound, "1/mm", detail, 1e-9 * bound)
    found.at_least("needle.curvature.sign", min(curvature), 0.0, "1/mm", "a bend is turned by its roll")
    found.at_least("needle.arc_length", min(piece.length_mm for piece in pieces), 1e-9, "mm", "shortest arc")
    turned, angle = turning(curve)
    limit = float(np.deg2rad(device.max_accumulated_turn_deg))
    found.at_most("needle.turn.limit", turned, limit, "rad", "sum of all turning", ANGLE_TOLERANCE_RAD)
    limit = float(np.deg2rad(device.max_angle_from_start_deg))
    detail = "largest angle from the start direction"
    found.at_most("needle.angle.limit", angle, limit, "rad", detail, ANGLE_TOLERANCE_RAD)
    length, detail = float(sum(piece.length_mm for piece in pieces)), "sum of the arcs"
    return found.at_most(
        "needle.length.limit", length, device.max_length_mm, "mm", detail, LENGTH_TOLERANCE_MM
    )


def _check_containment(plan: Plan, lung: "Lung", curve: Curve, found: Findings) -> None:
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


Case = tuple[str, Select, Bool, float]
"""The name of a structure, which voxels it has, frames of the needle, and the distance that they keep."""


def _check_clearance(
    plan: Plan, device: Needle, environment: Environment, curve: Curve, found: Findings
) -> None:
    """The needle keeps radius and margins from every structure, and what is stated of that is true."""
    required = device.radius_mm + plan.system.margins.total_mm
    everywhere = np.ones(len(curve.points), dtype=bool)
    exempt = curve.arc_mm < plan.exemption.needle_length_mm - TINY_MM
    cases: list[Case] = [
        ("vessel", has(structures.VESSEL), everywhere, required),
        ("outside", has(structures.OUTSIDE), everywhere, required),
        ("airway", has(structures.AIRWAY), ~exempt, required),
        ("other_airway", airway_except(plan.exemption.branch), exempt, required),
        ("lumen", has(structures.LUMEN), exempt, device.radius_mm),
        ("fissure", has(structures.FISSURE), everywhere, required),
    ]
    nearest = _check_clear(cases, environment, curve, found, fissures=plan.fissures_are_obstacles)
    # Towards the airway counts all of it behind the exempt length, and other branches before.
    airway = min(nearest.pop("airway", clearances.REACH_MM), nearest.pop("other_airway", clearances.REACH_MM))
    nearest.pop("lumen", None)
    diagonal = float(np.linalg.norm(environment.lung.grid.spacing_mm))
    for name, exact in {**nearest, "airway": airway}.items():
        clearances.check_stated_clearance(plan, "needle", name, (exact, exact), diagonal, found)


def _check_clear(
    cases: Sequence[Case], environment: Environment, curve: Curve, found: Findings, *, fissures: bool
) -> dict[str, float]:
    """Record whether a needle, as capsules padded by the sagitta, keeps its distances; return the least."""
    nearest: dict[str, float] = {}
    for name, select, where, needed in clearances.structures_known(cases, "needle", environment.lung, found):
        frames = np.flatnonzero(where)
        if not len(frames) or frames[0] == len(where) - 1:
            continue
        # An exempt run reaches the next frame.
        first, last = int(frames[0]), min(int(frames[-1]) + 1, len(where) - 1)
        nearest[name] = clearances.check_clear(
            f"needle.clearance.{name}",
            environment.boxes(select, clearances.REACH_MM),
            curve.points[first : last + 1],
            needed + curve.sagitta_mm[first:last],
            found,
            limited=name != "fissure" or fissures,
        )
    return nearest


WALL_ZONE_MM = 1.0


def check_needle_alone(
    lung: "Lung",
    system: System,
    lps_from_start: Float,
    arcs: ArrayLike,
    target_lps: Float,
    *,
    branches: Sequence[int] = (),
    at_wall: bool = False,
) -> CheckReport:
    """Check a needle path that no tube leads to, independently of how it was made.

    Args:
        lps_from_start: (4, 4) float64.
        arcs ((A, 3) array_like): Length in mm, roll in rad before it, curvature in 1/mm.
        target_lps: (3,) float64, LPS mm.
        branches: Pierced branches of the airway tree.
        at_wall: Whether the needle begins at the wall and pierces it itself.
    """
    found = Findings()
    needle = system.require_needle("The check of a needle alone")
    if check_rigid("needle.start", lps_from_start, found):
        pieces = [
            Piece(length_mm=float(length), roll_rad=float(roll), curvature_per_mm=float(curvature))
            for length, roll, curvature in np.asarray(arcs, dtype=np.float64).reshape(-1, 3)
        ]
        exempt_mm = needle.exit_exemption_mm if branches else 0.0
        curve = integrate(lps_from_start, cut_at(cut_at(pieces, exempt_mm), WALL_ZONE_MM))
        if _check_limits(pieces, needle, curve, found):
            miss = float(np.linalg.norm(curve.end[:3, 3] - target_lps))
            found.at_most(
                "target.reached", miss, POSITION_TOLERANCE_MM, "mm", "end of the needle to the target"
            )
            exempt = curve.arc_mm < exempt_mm - TINY_MM
            environment = Environment(lung)
            _check_alone(environment, system, curve, exempt, found)
            _check_exit(environment, system, curve, exempt, branches, at_wall, found)
    return found.report()


def _check_alone(
    environment: Environment, system: System, curve: Curve, exempt: Bool, found: Findings
) -> None:
    """Everything but the airway along all of the needle, and the airway beyond the exempt length."""
    everywhere = np.ones(len(curve.points), dtype=bool)
    required = system.track_radius_mm + system.margins.total_mm
    cases: list[Case] = [
        ("vessel", has(structures.VESSEL), everywhere, required),
        ("outside", has(structures.OUTSIDE), everywhere, required),
        ("fissure", has(structures.FISSURE), everywhere, required),
        ("airway", has(structures.AIRWAY), ~exempt, required),
    ]
    _check_clear(cases, environment, curve, found, fissures=not system.fissures_allowed)
    labels = labels_at(environment.lung, curve.points)
    forbidden = structures.obstacle_bits(not system.fissures_allowed)
    hit = (labels & np.where(exempt, forbidden & ~structures.AIRWAY, forbidden)) != 0
    found.true("needle.containment", not hit.any(), f"{int(hit.sum())} samples in an obstacle")


def _check_exit(
    environment: Environment,
    system: System,
    curve: Curve,
    exempt: Bool,
    branches: Sequence[int],
    at_wall: bool,
    found: Findings,
) -> None:
    """Near the exit: other branches as everywhere, and the lumen by the radius or by the rule at the wall."""
    if not exempt.any():
        return
    points, arc = curve.points[exempt], curve.arc_mm[exempt]
    required, tolerance = system.track_radius_mm + system.margins.total_mm, clearances.CLEARANCE_TOLERANCE_MM
    gap = float(environment.boxes(airway_except(*branches), clearances.REACH_MM).distance_mm(points).min())
    found.at_least("needle.clearance.other_airway", gap, required, "mm", "to branches not pierced", tolerance)
    kept = np.full(len(points), system.track_radius_mm)
    if at_wall:
        # The rule at the wall, stated a second time: docs/theory/proofs.md.
        kept = np.clip(np.sin(np.radians(10.0)) * (arc - WALL_ZONE_MM), 0.0, kept)
        points, kept = points[arc >= WALL_ZONE_MM - TINY_MM], kept[arc >= WALL_ZONE_MM - TINY_MM]
    if not len(points):
        return
    distance = environment.boxes(has(structures.LUMEN), clearances.REACH_MM).distance_mm(points)
    worst = int((distance - kept).argmin())
    found.at_least(
        "needle.clearance.lumen", float(distance[worst]), float(kept[worst]), "mm", "near the exit", tolerance
    )
    outside = (labels_at(environment.lung, points) & structures.LUMEN) == 0
    found.true("needle.not_in_lumen", outside.all(), f"{int((~outside).sum())} samples in an airway")
