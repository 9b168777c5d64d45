"""A plan as motion: what a page needs to play scope, tubes and needle, and their costs up to each point."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.typed import Bool, Float
from anatomy.kernels.sight import follow_rays
from anatomy.lung import Lung
from anatomy.poses import poses_on_arc, poses_on_pieces
from anatomy.structures import AIRWAY, FISSURE, LUMEN, OUTSIDE, VESSEL
from lungaccess.plans.bifurcations import HALF_ANGLE_RAD, camera_aside_mm, route_bifurcations
from lungaccess.plans.costs import obstacle_clearance_mm
from lungaccess.plans.curves import SHORTEST_MM, needle_pieces, tube_pieces, tube_radii
from lungaccess.plans.insertion import SHOWN_STEP_MM, shown_motion
from lungaccess.plans.plan import Plan
from lungaccess.showing.report.pack import Packed, pack
from stages.scope import ScopeMotion
from stages.tube import Neighbourhood, points_on_arcs

TUBE_STEP_MM = 1.0
"""Insertion between two stored shapes of the tubes; the page interpolates, and the bend opens slowly."""
TUBE_POINTS = 40
"""Points of a stored shape: 1 to 2 mm apart on tubes of a usual length, too near to see the corners."""
MM_PER_STEP = 0.01
"""A distance across the lumen is stored in steps of this."""
CAP_MM = 15.0
"""Clearances are measured up to this distance: farther than any margin, and where the plot ends."""
COLOURED_MM = 5.0
"""The needle's colour on a page tells clearances to spare up to this distance."""
NOT_MEASURED = -1.0
"""Stands where no clearance to the airway is asked for; no distance is negative."""
DIRECTIONS = 90
"""Rays around the tip, every 4 degrees."""
FARTHEST_MM = 20.0
"""The border of the lumen is looked for along each ray as far as the radius of a wide trachea."""


def packed_plan(plan: Plan, lung: Lung, name: str, *, sections: bool = True) -> Packed:
    """Return everything by which a page shows one plan in motion.

    Cross-sections of the airway around the tip of the scope take longer than all others.
    """
    return {
        "name": name,
        "digest": plan.digest,
        "target_lps": plan.target_lps.tolist(),
        **({} if plan.aim is None else {"aim_lps": plan.aim.point_lps.tolist()}),
        "radius_mm": {
            "scope": plan.system.scope.radius_mm,
            "outer": plan.system.tubes.outermost.radius_mm,
            "middle": (plan.system.tubes.middle or plan.system.tubes.inner).radius_mm,
            "inner": plan.system.tubes.inner.radius_mm,
            "needle": plan.system.track_radius_mm,
        },
        "scope": {**_scope(plan, lung), **(_around_tip(plan, lung) if sections else {})},
        "tubes": _tubes(plan),
        "needle": {
            "points": pack(plan.curves().needle.points_lps, "f4"),
            "arc_length_mm": pack(plan.curves().needle.arc_length_mm, "f4"),
            "margin_mm": pack(_margin_mm(plan, lung), "f4"),
        },
    }


def device_points(plan: Plan) -> Float:
    """Return points `(N, 3)`, LPS mm, of the last part of the scope, the tubes and the needle."""
    scope, *others = plan.curves()
    # Length of the scope behind its tip that a view of the devices shows: about its bending section.
    near = scope.arc_length_mm >= scope.arc_length_mm[-1] - 15.0
    return np.concatenate([scope.points_lps[near], *(curve.points_lps for curve in others)])


def _scope(plan: Plan, lung: Lung) -> Packed:
    """Return the scope in its states: tips, sections and the shaft; and its camera, aside of the tip.

    "bifurcations" are those of the route, each with how far the scope has moved when it stands before it.
    """
    moving = shown_motion(plan)
    tips, length = moving.tips, moving.bending_length_mm
    # Points of a stored bending section: 1 to 2 mm apart.
    back = np.linspace(-length, 0.0, 12)
    bends = moving.states[:, 2] / length
    sections = poses_on_arc(tips, 0.0, bends, back)[..., :3, 3]
    shaft, shaft_mm = poses_on_pieces(moving.lps_from_entry, moving.pieces[:-1], SHOWN_STEP_MM)
    moved = moved_mm(moving)
    return {
        "points": pack(tips[:, :3, 3], "f4"),
        "arc_length_mm": pack(moved, "f4"),
        "forward": pack(tips[:, :3, 2], "f4"),
        "up": pack(tips[:, :3, 0], "f4"),
        "inserted_mm": pack(moving.states[:, 0] + length, "f4"),
        "sections": pack(sections, "f4"),
        "shaft": pack(shaft[:, :3, 3], "f4"),
        "shaft_mm": pack(shaft_mm, "f4"),
        "from_carina_mm": float(plan.scope.length_from_carina_mm),
        "camera_aside_mm": camera_aside_mm(plan.system),
        "half_angle_rad": HALF_ANGLE_RAD,
        "bifurcations": [
            one.as_json()
            | {"moved_mm": float(moved[one.state]), "entered_mm": float(moved[one.entered_state])}
            for one in route_bifurcations(moving, plan.scope.branches, lung, plan.system)
        ],
    }


def _around_tip(plan: Plan, lung: Lung) -> Packed:
    """Return what is free around the tip of the scope in each of its M states, mm.

    "border" is the distance `(M, DIRECTIONS)` from the tip's axis to the first voxel that is no lumen, in the
    plane across it, clockwise from the top of the picture; 0 where the axis itself is beyond the lumen, at
    most `FARTHEST_MM`.  "gap_mm" is the least of them minus the radius of the scope, in the direction
    "nearest".  "depth_gap_mm" is free all around the tip, not only in the plane, as the depth of the lumen
    proves.
    """
    tips, radius_mm = shown_motion(plan).tips, plan.system.scope.radius_mm
    axes, up, right = tips[:, :3, 3], tips[:, :3, 0], tips[:, :3, 1]
    angle = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    rays = np.cos(angle)[None, :, None] * up[:, None] + np.sin(angle)[None, :, None] * right[:, None]
    rays = rays.reshape(-1, 3)
    starts = np.repeat(axes, DIRECTIONS, axis=0)
    away, ends = np.zeros(len(rays)), np.zeros(len(rays), dtype=np.int64)
    follow_rays(lung.labels, lung.geometry, LUMEN, starts, rays, FARTHEST_MM, away, ends)
    border = away.reshape(-1, DIRECTIONS)
    return {
        "border_step_mm": MM_PER_STEP,
        "border": pack(np.rint(border / MM_PER_STEP).astype(np.uint16), "u2"),
        "gap_mm": pack(border.min(axis=1) - radius_mm, "f4"),
        "nearest": pack(border.argmin(axis=1), "u1"),
        "depth_gap_mm": pack(lung.lumen_depth.lower_bound_mm(axes) - radius_mm, "f4"),
    }


def moved_mm(motion: ScopeMotion) -> Float:
    """Return how far the tip has moved up to each state `(M,)`; a turn counts by half a section."""
    steps = np.abs(np.diff(motion.states, axis=0))
    lever = 0.5 * motion.bending_length_mm
    return np.append(0.0, np.cumsum(steps[:, 0] + lever * steps[:, 1:].max(axis=1)))


def _tubes(plan: Plan) -> Packed:
    """Return the tubes at every step of their deployment, each as `TUBE_POINTS` points of equal distance."""
    tube = plan.tube
    inserted = plan.tube.insertions_mm(plan.system.tubes)
    inner = _insertions(inserted)
    outer = np.minimum(inner, tube.outer_insertion_mm)
    return {
        "points": pack(np.array(_shapes_lps(plan, inner)), "f4"),
        "inner_mm": pack(inner, "f4"),
        "outer_mm": pack(outer, "f4"),
        "middle_mm": pack(np.minimum(inner, max(tube.outer_insertion_mm, tube.middle_insertion_mm)), "f4"),
        "three": plan.system.tubes.middle is not None,
    }


def _shapes_lps(plan: Plan, inner_mm: Float) -> list[Float]:
    """Return the tubes where the inner one is out so far: each stops at its own insertion."""
    tube, tubes, pose = plan.tube, plan.system.tubes, np.asarray(plan.scope.lps_from_scope_tip)
    inserted = np.array(tube.insertions_mm(tubes))[::-1]
    turned = np.array(tube.rotations_rad(tubes))[::-1] - tube.rotation_rad
    shapes = [np.repeat(pose[None, :3, 3], TUBE_POINTS, axis=0)]
    first = np.minimum(inserted, inner_mm[1])
    around = Neighbourhood.of(tubes.nested, first, turned, needle=tubes.needle_shaft)
    for out_mm in inner_mm[1:].tolist():
        found = around.at(np.minimum(inserted, out_mm), turned)
        if found is None:
            raise SettingsError("The tubes of the plan snap on the way", remedy="Check it: lungaccess check")
        at_mm = np.linspace(0.0, out_mm, TUBE_POINTS)
        shapes.append(points_on_arcs(np.asarray(found.arcs), pose, tube.rotation_rad, at_mm))
        around = around.moved(found)
    return shapes


def _insertions(inserted_mm: Sequence[float]) -> Float:
    """Return insertions of the inner tube: it goes out with those around it, which stop one by one."""
    parts = [np.zeros(1)]
    for begin, end in pairwise((0.0, *inserted_mm)):
        count = max(int(np.ceil((end - begin) / TUBE_STEP_MM)), 1)
        parts.append(np.linspace(begin, end, count + 1)[1:])
    return np.unique(np.concatenate(parts))


def profile(plan: Plan, lung: Lung) -> dict[str, Any]:
    """Return clearances, curvature and cost along tubes and needle, by distance from the scope's tip.

    "clearance_mm" holds the exact distance of the axis to each structure, voxels as solid boxes, up to
    `CAP_MM`; for "airway" the pierced branch is passed over as long as it is exempt, and up to the exit
    there is only `NOT_MEASURED`.  "marks" are the places of the exit and of the needle's start.
    """
    device, (points, along, start) = plan.system.needle, profile_points(plan)
    clearances = _clearances(plan, lung, points, along <= start + plan.exemption.needle_length_mm)
    clearances["airway"][along < plan.tube.exit.arc_length_mm] = NOT_MEASURED
    exit_mm = float(plan.tube.exit.arc_length_mm)
    return {
        "arc_length_mm": along, "tube_mm": start, "exit_mm": exit_mm,
        "marks": {"exit": exit_mm, **({} if plan.needle is None else {"needle": start})},
        "exempt_to_mm": start + float(plan.exemption.needle_length_mm),
        "fissures_are_obstacles": plan.fissures_are_obstacles, "cap_mm": CAP_MM, "clearance_mm": clearances,
        "required_mm": required_mm(plan, along, start), "curvature_per_mm": _curvature(plan, along),
        "most_curvature_per_mm": 0.0 if device is None else device.max_curvature_per_mm,
        **_cost_so_far(plan, lung),
    }  # fmt: skip


def _margin_mm(plan: Plan, lung: Lung) -> Float:
    """Return what the needle has to spare, mm, exact up to where its colour on the page ends."""
    points, along, start = profile_points(plan)
    needle = slice(len(along) - len(plan.curves().needle.arc_length_mm), None)
    required = required_mm(plan, along, start)[needle]
    exempt = along[needle] <= start + plan.exemption.needle_length_mm
    found = _clearances(plan, lung, points[needle], exempt, float(required.max(initial=0.0)) + COLOURED_MM)
    limited = [v for k, v in found.items() if k != "fissure" or plan.fissures_are_obstacles]
    return np.asarray(np.min(limited, axis=0) - required)


def profile_points(plan: Plan) -> tuple[Float, Float, float]:
    """Return points `(N, 3)`, LPS mm, of tubes and needle, their lengths, and where the needle begins.

    Lengths in mm `(N,)` count from the tip of the scope.
    """
    _scope, tube, needle = plan.curves()
    start = float(tube.arc_length_mm[-1])
    points = np.concatenate([tube.points_lps, needle.points_lps[1:]])
    return points, np.concatenate([tube.arc_length_mm, start + needle.arc_length_mm[1:]]), start


def required_mm(plan: Plan, along: Float, start: float) -> Float:
    """Return the clearance in mm `(N,)` that the axis needs at points of `profile_points`."""
    tubes = plan.system.tubes
    extra = plan.system.margins.total_mm + plan.tube.clearance_loss_mm
    of_tube = tube_radii(plan.tube, tubes, along) + extra
    return np.where(along <= start, of_tube, plan.required_clearance_mm.get("needle", 0.0))


def _clearances(
    plan: Plan, lung: Lung, points: Float, exempt: Bool, cap_mm: float = CAP_MM
) -> dict[str, Float]:
    found = {}
    for name, bits in (("airway", AIRWAY), ("vessel", VESSEL), ("pleura", OUTSIDE), ("fissure", FISSURE)):
        if name == "fissure" and not lung.has_fissures:
            continue
        found[name] = lung.exact_clearance_mm(points, bits, cap_mm=cap_mm)
    found["airway"][exempt] = lung.exact_clearance_mm(
        points[exempt], AIRWAY, cap_mm=cap_mm, exempt_branch=plan.exemption.branch
    )
    return found


def _curvature(plan: Plan, along: Float) -> Float:
    tubes = tube_pieces(plan.tube)
    lengths, _rolls, curvatures = np.concatenate([tubes, needle_pieces(plan.needle)]).T
    place = np.searchsorted(np.cumsum(lengths), along - SHORTEST_MM)
    return np.asarray(np.abs(curvatures[np.minimum(place, len(curvatures) - 1)]))


def _cost_so_far(plan: Plan, lung: Lung) -> dict[str, Any]:
    """Return the integral of 1 / clearance along what the costs are of, and of the cost map if any.

    "cost_mm" are the distances from the scope's tip.
    """
    poses, lengths_mm = plan.costed_poses()
    points = poses[:, :3, 3]
    clearance = obstacle_clearance_mm(lung, points, with_fissures=plan.fissures_are_obstacles)
    # 1 / clearance counts a clearance as no less than this [Kuntz2015, eq. 1].
    rates = {"inverse_clearance": 1.0 / np.maximum(clearance, 0.1)}
    if lung.cost is not None:
        values = lung.cost.at(points, np.inf).astype(np.float64)
        if np.isfinite(values).all():
            rates["cost_map"] = values
    steps = np.diff(lengths_mm)
    begin_mm = plan.tube.inner_insertion_mm
    if plan.needle is None:
        begin_mm = plan.tube.exit.arc_length_mm
    so_far = {
        key: np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * steps)])
        for key, rate in rates.items()
    }
    return {"cost_mm": begin_mm + lengths_mm, "cost": so_far}
