"""Third part of the check: the tubes follow from their insertions, leave the airway once and stay clear."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from anatomy import structures
from anatomy.base.typed import Float, Labels
from lungaccess.judging.checking import shapes
from lungaccess.judging.checking.boxes import PathDistances
from lungaccess.judging.checking.channel import check_channel
from lungaccess.judging.checking.clearances import (
    REACH_MM,
    check_clear,
    check_stated_clearance,
    structures_known,
)
from lungaccess.judging.checking.environment import Environment
from lungaccess.judging.checking.findings import Findings
from lungaccess.judging.checking.poses import check_rigid, check_same_pose
from lungaccess.judging.checking.shapes import Curve
from lungaccess.judging.checking.space import Select, airway_except, branch_of, has, labels_at
from lungaccess.judging.checking.tube_shape import check_shape
from lungaccess.judging.checking.wall_exit import Exit, check_exit, check_wall_run
from lungaccess.plans.plan import Plan

if TYPE_CHECKING:
    from anatomy.lung import Lung

WALL_ZONE_MM = 1.0
"""Within this length behind the exit the axis may be as near to the lumen as it likes."""
OUT_OF_LUMEN_MM = 0.02
"""So far the axis stays from every lumen beyond the zone of the wall."""

RIM_POINTS = 24
"""Points around the tube, every 15 degrees: less than half a voxel apart on usual tubes."""
ROUNDING_MM = 1e-12
"""Of an arc length: behind the end of a tube the next one begins."""
_PROTRUSION = {"middle": "tube.protrusion.middle", "inner": "tube.protrusion"}


def check_deployment(plan: Plan, environment: Environment, found: Findings) -> Float | None:
    """Record everything about the tubes; return their re-integrated tip `(4, 4)` if they can be followed."""
    tube, lung = plan.tube, environment.lung
    if not (check_rigid("tube.tip", tube.lps_from_tip, found) and _is_pose(plan.scope.lps_from_scope_tip)):
        return None
    pieces = shapes.tube_pieces(plan)
    curve = shapes.integrate(plan.scope.lps_from_scope_tip, pieces)
    tip = shapes.tube_tip(plan, curve)
    check_same_pose("tube.tip", tube.lps_from_tip, tip, found)
    _check_lengths(plan, found)
    check_channel(plan, found)
    beside_mm = check_shape(plan, curve, found)
    if beside_mm is None:
        return None
    way_out = check_exit(plan, lung, curve, found)
    if way_out is not None:
        curve = shapes.integrate(plan.scope.lps_from_scope_tip, shapes.cut_at(pieces, way_out.arc_mm))
        way_out = replace(way_out, frame=int(np.abs(curve.arc_mm - way_out.arc_mm).argmin()))
        labels = labels_at(lung, curve.points)
        _check_containment(plan, curve, labels, way_out, found)
        _check_out_of_lumen(environment, curve, way_out, found)
        _check_clearance(plan, environment, curve, way_out, beside_mm, found)
        check_wall_run(plan, environment, curve, way_out, found)
    return tip


def _is_pose(pose: Float) -> bool:
    return bool(np.abs(pose[:3, :3].T @ pose[:3, :3] - np.eye(3)).max() < 1e-3)


def _check_lengths(plan: Plan, found: Findings) -> None:
    """Insertions are within what the tubes allow; that of a tube which is not there is 0."""
    tube, tubes = plan.tube, plan.system.tubes
    found.at_most(
        "tube.extension", tube.inner_insertion_mm, tubes.max_extension_mm, "mm", "tip beyond the scope tip"
    )
    stated = {
        "outer": (tube.outer_insertion_mm, tubes.outer),
        "middle": (tube.middle_insertion_mm, tubes.middle),
        "inner": (tube.inner_insertion_mm, tubes.inner),
    }
    around = 0.0, 0.0
    for name, (inserted, device) in stated.items():
        if device is None and name == "middle" and inserted == 0.0:
            continue
        length = 0.0 if device is None else device.length_mm
        found.at_most(f"tube.{name}_length", inserted, length, "mm")
        if name != "outer":
            ahead = length - around[1]
            detail = f"{name} beyond the tube around it"
            found.at_most(_PROTRUSION[name], inserted - around[0], ahead, "mm", detail)
        around = inserted, length


def _check_containment(plan: Plan, curve: Curve, labels: Labels, way_out: Exit, found: Findings) -> None:
    """Behind the exit the axis meets no vessel, no outside, no other branch."""
    behind = labels[way_out.frame + 1 :]
    beyond_zone = curve.arc_mm[way_out.frame + 1 :] > way_out.arc_mm + WALL_ZONE_MM
    through = bool(beyond_zone.any()) and not behind[-1] & structures.LUMEN
    found.true("tube.tip_in_tissue", through, "the tip is through the wall")
    forbidden = structures.VESSEL | structures.OUTSIDE
    forbidden |= structures.FISSURE if plan.fissures_are_obstacles else 0
    other = ((behind & structures.AIRWAY) != 0) & (branch_of(behind) != way_out.branch)
    hit = ((behind & forbidden) != 0) | other
    found.true("tube.containment", not hit.any(), f"{int(hit.sum())} samples behind the exit in an obstacle")


def _check_out_of_lumen(environment: Environment, curve: Curve, way_out: Exit, found: Findings) -> None:
    """Beyond the zone of the wall no segment of the axis comes near lumen, however thin the corner."""
    begin_mm = way_out.arc_mm + WALL_ZONE_MM
    if curve.arc_mm[-1] <= begin_mm:
        return
    begin = [np.interp(begin_mm, curve.arc_mm, curve.points[:, axis]) for axis in range(3)]
    points = np.concatenate([[begin], curve.points[curve.arc_mm > begin_mm]])
    needed = np.full(len(points) - 1, OUT_OF_LUMEN_MM)
    boxes = environment.boxes(has(structures.LUMEN), REACH_MM)
    check_clear("tube.beyond_wall.lumen", boxes, points, needed, found, limited=True)


def _first_contact(lung: "Lung", curve: Curve, way_out: Exit, plan: Plan) -> int:
    """Return the frame from which on, up to the exit, the tube's rim is never wholly in the lumen."""
    phi = np.linspace(0.0, 2.0 * np.pi, RIM_POINTS, endpoint=False)
    frames = curve.frames[: way_out.frame + 1, None, :3]
    radius = shapes.radius_at(plan, curve.arc_mm[: way_out.frame + 1])
    across = np.cos(phi)[:, None] * frames[..., 0] + np.sin(phi)[:, None] * frames[..., 1]
    rim = frames[..., 3] + radius[:, None, None] * across
    wet = ((labels_at(lung, rim) & structures.LUMEN) != 0).reshape(len(radius), RIM_POINTS).all(axis=1)
    return int(np.flatnonzero(wet)[-1]) if wet.any() else 0


def _check_clearance(
    plan: Plan, environment: Environment, curve: Curve, way_out: Exit, beside_mm: float, found: Findings
) -> None:
    """From its first contact with the wall on, each tube keeps radius, margins and more from obstacles.

    More are the sweep, and how far the derived shape is from the curve.
    """
    contact = _first_contact(environment.lung, curve, way_out, plan)
    margin = plan.system.margins.total_mm + beside_mm
    needed = shapes.radius_at(plan, curve.arc_mm[:-1] + ROUNDING_MM) + margin + curve.sagitta_mm
    cases = obstacles_of(way_out.branch, contact, way_out.frame)
    for name, select, first in structures_known(cases, "tube", environment.lung, found):
        boxes = environment.boxes(select, REACH_MM)
        points = curve.points[first:]
        least = check_clear(
            f"tube.clearance.{name}", boxes, points, needed[first:], found,
            limited=name != "fissure" or plan.fissures_are_obstacles,
        )  # fmt: skip
        most = PathDistances(boxes, curve.points[way_out.frame :]).least_mm()
        diagonal = float(np.linalg.norm(environment.lung.grid.spacing_mm))
        check_stated_clearance(plan, "tube", name, (least, most), diagonal, found)


def obstacles_of(branch: int, contact: int, way_out: int) -> list[tuple[str, Select, int]]:
    """Return each structure, how to select it, and the first frame that must be clear of it.

    In the lumen, up to the exit, other branches are only open space.
    """
    return [
        ("vessel", has(structures.VESSEL), contact),
        ("outside", has(structures.OUTSIDE), contact),
        ("fissure", has(structures.FISSURE), contact),
        ("airway", airway_except(branch), way_out),
    ]
