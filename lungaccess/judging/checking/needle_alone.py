"""The check of a needle that was planned alone: its motion, its target, and its distance from everything."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from anatomy import structures
from anatomy.base.typed import Bool, Float
from lungaccess.judging.checking.boxes import Environment, branch_of, has, labels_at, region_around
from lungaccess.judging.checking.clearances import (
    CLEARANCE_TOLERANCE_MM,
    REACH_MM,
    check_clear,
    structures_known,
)
from lungaccess.judging.checking.findings import POSITION_TOLERANCE_MM, CheckReport, Findings, check_rigid
from lungaccess.judging.checking.shapes import TINY_MM, Curve, Piece, cut_at, integrate
from lungaccess.judging.checking.steering import check_limits, run_of_frames
from lungaccess.problem.system import System

if TYPE_CHECKING:
    from anatomy.lung import Lung

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
        if check_limits(pieces, needle, curve, found):
            miss = float(np.linalg.norm(curve.end[:3, 3] - target_lps))
            found.at_most(
                "target.reached", miss, POSITION_TOLERANCE_MM, "mm", "end of the needle to the target"
            )
            exempt = curve.arc_mm < exempt_mm - TINY_MM
            _check_clear(Environment(lung), system, curve, exempt, found)
            _check_exit(lung, system, curve, exempt, branches, at_wall, found)
    return found.report()


def _check_clear(
    environment: Environment, system: System, curve: Curve, exempt: Bool, found: Findings
) -> None:
    """Everything but the airway along all of the needle, and the airway beyond the exempt length."""
    everywhere = np.ones(len(curve.points), dtype=bool)
    required = system.track_radius_mm + system.margins.total_mm
    cases = [
        ("vessel", structures.VESSEL, everywhere),
        ("outside", structures.OUTSIDE, everywhere),
        ("fissure", structures.FISSURE, everywhere),
        ("airway", structures.AIRWAY, ~exempt),
    ]
    for name, bits, where in structures_known(cases, "needle", environment.lung, found):
        first, last = run_of_frames(where)
        if last - first < 1:
            continue
        check_clear(
            f"needle.clearance.{name}",
            environment.boxes(has(bits), REACH_MM),
            curve.points[first : last + 1],
            required + curve.sagitta_mm[first:last],
            found,
            limited=name != "fissure" or not system.fissures_allowed,
        )
    labels = labels_at(environment.lung, curve.points)
    forbidden = structures.obstacle_bits(not system.fissures_allowed)
    hit = (labels & np.where(exempt, forbidden & ~structures.AIRWAY, forbidden)) != 0
    found.true("needle.containment", not hit.any(), f"{int(hit.sum())} samples in an obstacle")


def _check_exit(
    lung: "Lung",
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
    region = region_around(lung, points, REACH_MM)
    airway = (region.labels & structures.AIRWAY) != 0
    others = airway & ~np.isin(branch_of(region.labels), list(branches))
    required = system.track_radius_mm + system.margins.total_mm
    gap = float(_box_distance(points, region.grid.lps(np.argwhere(others)), lung).min())
    tolerance = CLEARANCE_TOLERANCE_MM
    found.at_least("needle.clearance.other_airway", gap, required, "mm", "to branches not pierced", tolerance)
    kept = np.full(len(points), system.track_radius_mm)
    if at_wall:
        # The rule at the wall, stated a second time: docs/theory/proofs.md.
        kept = np.clip(np.sin(np.radians(10.0)) * (arc - WALL_ZONE_MM), 0.0, kept)
        points, kept = points[arc >= WALL_ZONE_MM - TINY_MM], kept[arc >= WALL_ZONE_MM - TINY_MM]
    if not len(points):
        return
    lumen = region.grid.lps(np.argwhere((region.labels & structures.LUMEN) != 0))
    distance = _box_distance(points, lumen, lung)
    worst = int((distance - kept).argmin())
    found.at_least(
        "needle.clearance.lumen", float(distance[worst]), float(kept[worst]), "mm", "near the exit", tolerance
    )
    outside = (labels_at(lung, points) & structures.LUMEN) == 0
    found.true("needle.not_in_lumen", outside.all(), f"{int((~outside).sum())} samples in an airway")


def _box_distance(points: Float, centres: Float, lung: "Lung") -> Float:
    """Return the distance `(N,)` of points from voxels as solid boxes, at most `REACH_MM`."""
    axes = lung.grid.lps_from_ijk[:3, :3] / lung.grid.spacing_mm
    half = 0.5 * lung.grid.spacing_mm
    least = np.full(len(points), REACH_MM)
    for number, point in enumerate(points):
        aside = np.abs((centres - point) @ axes) - half
        gaps = np.linalg.norm(np.maximum(aside, 0.0), axis=1)
        least[number] = min(least[number], gaps.min(initial=REACH_MM))
    return least
