"""Fourth part of the check: the needle follows its arcs to the target, within its limits and clear of all."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from anatomy import structures
from anatomy.base.typed import Float
from lungaccess.judging.checking.boxes import Environment, Select, airway_except, branch_of, has, labels_at
from lungaccess.judging.checking.clearances import (
    REACH_MM,
    check_clear,
    check_stated_clearance,
    structures_known,
)
from lungaccess.judging.checking.findings import (
    ANGLE_TOLERANCE_RAD,
    LENGTH_TOLERANCE_MM,
    POSITION_TOLERANCE_MM,
    Findings,
    angle_between,
    check_rigid,
    check_same_pose,
)
from lungaccess.judging.checking.outcome import check_costs, check_target, check_tool, forbidden_bits
from lungaccess.judging.checking.shapes import TINY_MM, Curve, Piece, cut_at, integrate, needle_pieces
from lungaccess.plans.parts import NeedlePath
from lungaccess.plans.plan import Plan
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
    pieces = needle_pieces(needle.arcs)
    curve = integrate(needle.lps_from_start, cut_at(pieces, plan.exemption.needle_length_mm))
    length = float(sum(arc.length_mm for arc in needle.arcs))
    found.agrees("needle.length", needle.length_mm, length, LENGTH_TOLERANCE_MM, "mm")
    turned, angle = turning(curve)
    found.agrees("needle.turn", needle.accumulated_turn_rad, turned, TURN_TOLERANCE_RAD, "rad")
    found.agrees("needle.angle", needle.max_angle_from_start_rad, angle, TURN_TOLERANCE_RAD, "rad")
    if not check_limits(pieces, device, curve, found):
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


def check_limits(pieces: Sequence[Piece], device: Needle, curve: Curve, found: Findings) -> bool:
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


def _check_clearance(
    plan: Plan, device: Needle, environment: Environment, curve: Curve, found: Findings
) -> None:
    """The needle, as capsules padded by the sagitta, keeps radius and margins from every structure."""
    radius = 0.5 * device.diameter_mm
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
    for name, select, where, needed in structures_known(cases, "needle", environment.lung, found):
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
