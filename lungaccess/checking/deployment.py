"""Third part of the check: the tubes follow from their insertions, leave the airway once and stay clear."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from anatomy import structures
from anatomy.records import frozen_record
from anatomy.typed import Bool, Float, Labels
from lungaccess.checking import shapes
from lungaccess.checking.clearances import REACH_MM, check_clear, check_stated_clearance
from lungaccess.checking.environment import Environment
from lungaccess.checking.findings import Findings
from lungaccess.checking.poses import POSITION_TOLERANCE_MM, check_rigid, check_same_pose
from lungaccess.checking.shapes import Curve
from lungaccess.checking.space import Select, airway_except, branch_of, has, labels_at, region_around
from lungaccess.plans.plan import Plan

if TYPE_CHECKING:
    from anatomy.lung import Lung

EXIT_TOLERANCE_MM = 0.02
"""Two bisections of the border of a voxel, on curves that differ by micrometres, agree to less than this."""
BISECTIONS = 20
"""A step of 0.05 mm is then known to less than 1e-7 mm."""
THIN_SAMPLES = 201
"""Samples within a step of 0.05 mm, to find a voxel corner that is thinner than the step."""
CORNER_MM = 0.1
"""An axis that leaves the lumen for less than this cuts the corner of a voxel: not yet an exit."""

WALL_ANGLE_TOLERANCE_RAD = 0.05
"""The centroid of the lumen's voxels jumps where one of them enters the ball; the angle by less than this."""
NORMAL_RADIUS_MM = 2.5
"""A ball of several voxels: the steps of the mask average out, and the bronchus is still nearly straight."""
WALL_ZONE_MM = 1.0
"""Behind the exit the axis may cross corners of lumen voxels of the same branch for this length."""

OUT_OF_LUMEN_MM = 0.02
"""So far the axis stays from every lumen beyond the zone of the wall."""

BRANCH_ZONE_MM = 0.25
"""The pierced branch is that of a lumen voxel which the axis meets in this last length before the exit."""

RIM_POINTS = 24
"""Points around the tube, every 15 degrees: less than half a voxel apart on usual tubes."""
SWEEP_STEP_MM = 1.0
"""Insertion between two replayed steps; the sweep changes slowly with it."""
SWEEP_POINT_MM = 0.5
"""Spacing of the points of the body that are compared with the final shape."""
SWEEP_TOLERANCE_MM = 0.02
"""So much less may a replay at steps find than a formula that takes the largest sweep."""


@frozen_record
class Exit:
    """Where the re-integrated tube leaves the lumen: frame, arc length and pierced branch."""

    frame: int
    arc_mm: float
    branch: int


def check_deployment(plan: Plan, environment: Environment, found: Findings) -> Curve | None:
    """Record everything about the tubes; return their re-integrated centreline if it can be followed."""
    tube, tubes, lung = plan.tube, plan.system.tubes, environment.lung
    if not (check_rigid("tube.tip", tube.lps_from_tip, found) and _is_pose(plan.scope.lps_from_scope_tip)):
        return None
    bend = shapes.bend_of(tubes, tube.outer_insertion_mm, tube.inner_insertion_mm)
    curve = shapes.tube_curve(plan.scope.lps_from_scope_tip, tube.rotation_rad, bend)
    check_same_pose("tube.tip", tube.lps_from_tip, curve.end, found)
    _check_limits(plan, bend, found)
    sweep_mm = _check_sweep(plan, found)
    labels = labels_at(lung, curve.points)
    way_out = _check_exit(plan, lung, curve, labels, found)
    if way_out is not None:
        curve = shapes.tube_curve(plan.scope.lps_from_scope_tip, tube.rotation_rad, bend, way_out.arc_mm)
        way_out = replace(way_out, frame=int(np.abs(curve.arc_mm - way_out.arc_mm).argmin()))
        labels = labels_at(lung, curve.points)
        _check_containment(plan, curve, labels, way_out, found)
        _check_out_of_lumen(environment, curve, way_out, found)
        _check_clearance(plan, environment, curve, way_out, sweep_mm, found)
    return curve


def _is_pose(pose: Float) -> bool:
    return bool(np.abs(pose[:3, :3].T @ pose[:3, :3] - np.eye(3)).max() < 1e-3)


def _check_limits(plan: Plan, bend: shapes.Bend, found: Findings) -> None:
    """Insertions and strains are within what the tubes allow."""
    tube, tubes = plan.tube, plan.system.tubes
    outer, inner = tube.outer_insertion_mm, tube.inner_insertion_mm
    found.at_most("tube.extension", inner, tubes.max_extension_mm, "mm", "tip beyond the scope tip")
    found.at_most("tube.outer_length", outer, tubes.outer.length_mm, "mm")
    found.at_most("tube.inner_length", inner, tubes.inner.length_mm, "mm")
    ahead = tubes.inner.length_mm - tubes.outer.length_mm
    found.at_most("tube.protrusion", inner - outer, ahead, "mm", "inner beyond outer tube")
    # Straightened in the scope the inner tube is bent by its whole precurvature; the outer one bends with it.
    strains = [tubes.inner.precurvature_per_mm * tubes.inner.outer_diameter_mm / 2]
    in_overlap = [k for k, end in zip(bend.per_mm, bend.edges_mm[1:], strict=True) if end <= outer]
    strains += [k * tubes.outer.outer_diameter_mm / 2 for k in in_overlap]
    found.at_most("tube.strain", max(strains), tubes.max_strain, "", "largest strain of the tube material")


def _check_sweep(plan: Plan, found: Findings) -> float:
    """Replay the deployment and return how far the tubes get from their final shape."""
    tube, tubes = plan.tube, plan.system.tubes
    outer, inner = tube.outer_insertion_mm, tube.inner_insertion_mm
    final = shapes.planar_shape(shapes.bend_of(tubes, outer, inner), SWEEP_POINT_MM)
    sweep = leader = 0.0
    bends = shapes.deployment_bends(tubes, outer, inner, SWEEP_STEP_MM)
    for bend in bends:
        distances = shapes.distance_to_polyline(shapes.planar_shape(bend, SWEEP_POINT_MM), final)
        sweep, leader = max(sweep, float(distances.max())), max(leader, float(distances[-1]))
    limit = tubes.max_lateral_sweep_mm
    detail = f"sideways motion while the tubes are deployed, {len(bends)} steps replayed"
    found.at_most("tube.sweep.limit", sweep, limit, "mm", detail, SWEEP_TOLERANCE_MM)
    detail = "sideways motion as stated"
    found.at_most("tube.sweep.stated_limit", tube.lateral_sweep_mm, limit, "mm", detail)
    stated = ((tube.lateral_sweep_mm, sweep, "sweep"), (tube.follow_the_leader_error_mm, leader, "leader"))
    for value, recomputed, name in stated:
        detail = "not less than recomputed"
        found.at_least(f"tube.{name}.stated", value, recomputed, "mm", detail, SWEEP_TOLERANCE_MM)
    return max(sweep if sweep > SWEEP_TOLERANCE_MM else 0.0, tube.lateral_sweep_mm)


def _check_exit(plan: Plan, lung: Lung, curve: Curve, labels: Labels, found: Findings) -> Exit | None:
    """Derive the exit anew and compare it with what the plan states and exempts."""
    stated, exemption = plan.tube.exit, plan.exemption
    in_lumen = (labels & structures.LUMEN) != 0
    left = np.flatnonzero(~in_lumen)
    if not found.true("tube.starts_in_lumen", in_lumen[0], "tip of the scope"):
        return None
    if not found.true("tube.leaves", len(left) > 0, "the tube leaves the airway lumen"):
        return None
    last, inside, outside = _exit_step(lung, curve, in_lumen, stated.arc_length_mm)
    arc_mm, point = _border(lung, curve, last, inside, outside)
    before = curve.arc_mm[last] - curve.arc_mm
    near = (before >= 0.0) & (before <= BRANCH_ZONE_MM)
    branches = {int(b) for b in branch_of(labels[near & in_lumen])}
    found.true("tube.exit.branch", stated.branch in branches, f"{stated.branch} against {sorted(branches)}")
    outside_mediastinum = stated.branch in np.flatnonzero(~lung.tree.mediastinal)
    detail = "trachea and main bronchi lie in the mediastinum"
    found.true("tube.exit.not_mediastinal", outside_mediastinum, detail)
    detail = f"{exemption.branch} against {stated.branch}"
    found.true("exemption.branch", exemption.branch == stated.branch, detail)
    found.agrees("tube.exit.arc", stated.arc_length_mm, arc_mm, EXIT_TOLERANCE_MM, "mm")
    found.agrees("tube.exit.point", stated.point_lps, point, EXIT_TOLERANCE_MM, "mm")
    found.agrees("exemption.point", exemption.exit_point_lps, stated.point_lps, POSITION_TOLERANCE_MM, "mm")
    angle = wall_angle_rad(lung, point, curve.tangents[last])
    found.agrees("tube.exit.angle", stated.wall_angle_rad, angle, WALL_ANGLE_TOLERANCE_RAD, "rad")
    limit = float(np.deg2rad(plan.system.tubes.min_wall_angle_deg))
    found.at_least("tube.exit.angle.stated_limit", stated.wall_angle_rad, limit, "rad")
    detail = "recomputed angle to the wall"
    found.at_least("tube.exit.angle.limit", angle, limit, "rad", detail, WALL_ANGLE_TOLERANCE_RAD)
    return Exit(frame=last, arc_mm=arc_mm, branch=exemption.branch)


def _exit_step(lung: Lung, curve: Curve, in_lumen: Bool, stated_mm: float) -> tuple[int, float, float]:
    """Return the last frame in the lumen, and shares of the step behind it that are in the lumen and not.

    Of the exit and the voxel corners that are cut on the way to it, the one nearest to what is stated; a
    corner may be thinner than the step.
    """
    leaves = np.flatnonzero(in_lumen[:-1] & ~in_lumen[1:])
    enters = np.append(np.flatnonzero(~in_lumen[:-1] & in_lumen[1:]), len(in_lumen) - 1)
    back = enters[np.searchsorted(enters, leaves)]
    away = curve.arc_mm[back] - curve.arc_mm[leaves]
    away[back == len(in_lumen) - 1] = np.inf
    candidates = leaves[: int(np.argmax(away > CORNER_MM)) + 1]
    stated = int(np.searchsorted(curve.arc_mm, stated_mm, side="right")) - 1
    if 0 <= stated < candidates[-1] and in_lumen[stated] and in_lumen[stated + 1]:
        share = np.linspace(0.0, 1.0, THIN_SAMPLES)
        a, b = curve.points[stated], curve.points[stated + 1]
        wet = (labels_at(lung, a + share[:, None] * (b - a)) & structures.LUMEN) != 0
        if not wet.all():
            out = int(np.argmin(wet))
            return stated, float(share[out - 1]), float(share[out])
    return int(candidates[np.argmin(np.abs(curve.arc_mm[candidates] - stated_mm))]), 0.0, 1.0


def _border(lung: Lung, curve: Curve, frame: int, inside: float, outside: float) -> tuple[float, Float]:
    """Return arc length and position of the border of the lumen in the step behind a frame, by bisection."""
    a, b = curve.points[frame], curve.points[frame + 1]
    for _ in range(BISECTIONS):
        middle = 0.5 * (inside + outside)
        if labels_at(lung, a + middle * (b - a))[0] & structures.LUMEN:
            inside = middle
        else:
            outside = middle
    arc_mm = curve.arc_mm[frame] + inside * (curve.arc_mm[frame + 1] - curve.arc_mm[frame])
    return float(arc_mm), a + inside * (b - a)


def wall_angle_rad(lung: Lung, point_lps: Float, tangent: Float) -> float:
    """Return the angle between a tangent and the lumen's border; pi/2 is perpendicular to the wall.

    The border faces away from the centroid of the lumen voxels whose centres lie within
    `NORMAL_RADIUS_MM` of the point.
    """
    region = region_around(lung, point_lps[None], NORMAL_RADIUS_MM)
    centres = region.grid.lps(np.argwhere((region.labels & structures.LUMEN) != 0))
    near = centres[np.linalg.norm(centres - point_lps, axis=1) <= NORMAL_RADIUS_MM]
    if not len(near):
        return 0.0
    outwards = point_lps - near.mean(axis=0)
    size = float(np.linalg.norm(outwards))
    return float(np.arcsin(np.clip(outwards @ tangent / size, -1.0, 1.0))) if size > 1e-9 else 0.0


def _check_containment(plan: Plan, curve: Curve, labels: Labels, way_out: Exit, found: Findings) -> None:
    """Behind the exit the axis meets no lumen again, no vessel, no outside, no other branch."""
    behind = labels[way_out.frame + 1 :]
    beyond_zone = curve.arc_mm[way_out.frame + 1 :] > way_out.arc_mm + WALL_ZONE_MM
    lumen = (behind & structures.LUMEN) != 0
    again = lumen & (beyond_zone | (branch_of(behind) != way_out.branch))
    found.true("tube.one_exit", not again.any(), "the axis enters no lumen again")
    through = bool(beyond_zone.any()) and not lumen[-1:].any()
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


def _first_contact(lung: Lung, curve: Curve, way_out: Exit, plan: Plan) -> int:
    """Return the frame from which on, up to the exit, the tube's rim is never wholly in the lumen."""
    phi = np.linspace(0.0, 2.0 * np.pi, RIM_POINTS, endpoint=False)
    device, frames = plan.system.tubes, curve.frames[: way_out.frame + 1, None, :3]
    radius = 0.5 * np.where(
        curve.arc_mm[: way_out.frame + 1] <= plan.tube.outer_insertion_mm,
        device.outer.outer_diameter_mm,
        device.inner.outer_diameter_mm,
    )
    across = np.cos(phi)[:, None] * frames[..., 0] + np.sin(phi)[:, None] * frames[..., 1]
    rim = frames[..., 3] + radius[:, None, None] * across
    wet = ((labels_at(lung, rim) & structures.LUMEN) != 0).reshape(len(radius), RIM_POINTS).all(axis=1)
    return int(np.flatnonzero(wet)[-1]) if wet.any() else 0


def _check_clearance(
    plan: Plan, environment: Environment, curve: Curve, way_out: Exit, sweep_mm: float, found: Findings
) -> None:
    """From its first contact with the wall on, each tube keeps radius, margins and sweep from obstacles."""
    contact = _first_contact(environment.lung, curve, way_out, plan)
    margin = plan.system.margins.total_mm + sweep_mm
    tubes = plan.system.tubes
    radius = np.where(
        curve.arc_mm[:-1] < plan.tube.outer_insertion_mm,
        0.5 * tubes.outer.outer_diameter_mm,
        0.5 * tubes.inner.outer_diameter_mm,
    )
    needed = radius + margin + curve.sagitta_mm
    for name, select, first in obstacles_of(way_out.branch, contact, way_out.frame):
        boxes = environment.boxes(select, REACH_MM)
        points = curve.points[first:]
        least = check_clear(
            f"tube.clearance.{name}", boxes, points, needed[first:], found,
            limited=name != "fissure" or plan.fissures_are_obstacles,
        )  # fmt: skip
        most = boxes.least_mm(curve.points[way_out.frame :])
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
