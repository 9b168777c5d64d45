"""A plan as motion: what a page needs to play scope, tubes and needle, and what they cost on the way."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from anatomy.structures import AIRWAY, FISSURE, OUTSIDE, VESSEL
from anatomy.typed import Bool, Float
from lungaccess.checking import shapes
from lungaccess.plans.costs import obstacle_clearance_mm
from lungaccess.report.geometry import needle_polyline, tube_centreline
from lungaccess.report.html.pack import Packed, pack
from stages.needle import Objective

if TYPE_CHECKING:
    from anatomy.lung import Lung
    from lungaccess.plans.plan import Plan


TUBE_STEP_MM = 1.0
TUBE_POINTS = 40
SMOOTH_MM = 3.0
BLEND_MM = 8.0
CAP_MM = 15.0
"""Clearances are measured up to this distance."""
NOT_MEASURED = -1.0
FLOOR_MM = 0.1
"""1 / clearance counts a clearance as no less than this [Kuntz2015, eq. 1]."""


def packed_plan(plan: Plan, lung: Lung, name: str) -> Packed:
    """Return everything by which a page shows one plan in motion and along its path."""
    return {
        "name": name,
        "digest": plan.digest,
        "target_lps": plan.target_lps.tolist(),
        "radius_mm": {
            "scope": 0.5 * plan.system.scope.outer_diameter_mm,
            "outer": 0.5 * plan.system.tubes.outer.outer_diameter_mm,
            "inner": 0.5 * plan.system.tubes.inner.outer_diameter_mm,
            "needle": 0.5 * plan.system.needle.diameter_mm,
        },
        "scope": _scope(plan),
        "tubes": _tubes(plan),
        "needle": _needle(plan),
        "profile": profile(plan, lung),
        "costs": {key: float(value) for key, value in plan.costs.items()},
        "objective": plan.objective,
        "objective_words": Objective.of(plan.objective).words,
    }


def device_points(plan: Plan) -> Float:
    """Return points `(N, 3)`, LPS mm, of the last part of the scope, the tubes and the needle."""
    tube, _ = tube_centreline(plan)
    needle, _ = needle_polyline(plan.needle)
    return np.concatenate([np.asarray(plan.scope.points_lps)[-20:], tube, needle])


def _scope(plan: Plan) -> Packed:
    points = np.asarray(plan.scope.points_lps)
    forward, up = camera_axes(points, plan.scope.lps_from_scope_tip)
    return {
        "points": pack(points, "f4"),
        "along_mm": pack(arc_lengths(points), "f4"),
        "forward": pack(forward, "f4"),
        "up": pack(up, "f4"),
        "lumen_radius_mm": pack(plan.scope.lumen_radius_mm, "f4"),
        "from_carina_mm": float(plan.scope.length_from_carina_mm),
    }


def arc_lengths(points: Float) -> Float:
    """Return the arc length `(N,)` in mm at each of the points `(N, 3)`."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def camera_axes(points: Float, lps_from_scope_tip: Float) -> tuple[Float, Float]:
    """Return forward and up `(N, 3)` of the camera along a route: the patient's front is up at its beginning.

    Forward is the tangent of the smoothed route and turns into that of the tip over the last millimetres;
    up is carried along without roll.
    """
    from scipy.ndimage import gaussian_filter1d

    along = arc_lengths(points)
    spacing = max(along[-1] / max(len(points) - 1, 1), 1e-6)
    smooth = gaussian_filter1d(points, SMOOTH_MM / spacing, axis=0, mode="nearest")
    tangent = np.gradient(smooth, axis=0) if len(points) > 1 else np.zeros_like(points)
    tip = np.asarray(lps_from_scope_tip)[:3, 2]
    share = np.clip(1.0 - (along[-1] - along) / BLEND_MM, 0.0, 1.0)[:, None]
    forward = _unit((1.0 - share) * _unit(tangent, tip) + share * tip, tip)
    up = np.zeros_like(forward)
    held = np.array([0.0, -1.0, 0.0])
    for n, ahead in enumerate(forward):
        aside = held - (held @ ahead) * ahead
        held = aside / max(float(np.linalg.norm(aside)), 1e-9)
        up[n] = held
    return forward, up


def _unit(vectors: Float, otherwise: Float) -> Float:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(np.where(length > 1e-9, vectors / np.maximum(length, 1e-9), otherwise))


def _tubes(plan: Plan) -> Packed:
    """Return the tubes at every step of their deployment, each as `TUBE_POINTS` points of equal distance."""
    tube, pose = plan.tube, plan.scope.lps_from_scope_tip
    outer, inner = tube.outer_insertion_mm, tube.inner_insertion_mm
    bends = shapes.deployment_bends(plan.system.tubes, outer, inner, TUBE_STEP_MM)
    shapes_lps = [np.repeat(np.asarray(pose)[None, :3, 3], TUBE_POINTS, axis=0)]
    lengths = [0.0]
    for bend in bends:
        curve = shapes.tube_curve(pose, tube.rotation_rad, bend)
        share = np.linspace(0.0, curve.arc_mm[-1], TUBE_POINTS)
        columns = [np.interp(share, curve.arc_mm, curve.points[:, axis]) for axis in range(3)]
        shapes_lps.append(np.stack(columns, axis=1))
        lengths.append(float(curve.arc_mm[-1]))
    return {
        "points": pack(np.array(shapes_lps), "f4"),
        "inner_mm": pack(lengths, "f4"),
        "outer_mm": pack(np.minimum(lengths, outer), "f4"),
    }


def _needle(plan: Plan) -> Packed:
    points, along = needle_polyline(plan.needle)
    return {"points": pack(points, "f4"), "along_mm": pack(along, "f4")}


def profile(plan: Plan, lung: Lung) -> Packed:
    """Return clearances, curvature and cost along tubes and needle, by distance from the scope's tip.

    "clearance_mm" holds the exact distance of the axis to each structure, voxels as solid boxes, up to
    `CAP_MM`; for "airway" the pierced branch is passed over as long as it is exempt, and up to the exit
    there is only `NOT_MEASURED`.  "margin_mm" is the least of them against "required_mm" on the needle.
    """
    tube, tube_arc = tube_centreline(plan)
    needle, needle_arc = needle_polyline(plan.needle)
    points = np.concatenate([tube, needle[1:]])
    along = np.concatenate([tube_arc, tube_arc[-1] + needle_arc[1:]])
    start = float(tube_arc[-1])
    clearances = _clearances(plan, lung, points, along <= start + plan.exemption.needle_length_mm)
    clearances["airway"][along < plan.tube.exit.arc_length_mm] = NOT_MEASURED
    outer = plan.tube.outer_insertion_mm
    needed = plan.required_clearance_mm
    required = np.where(
        along <= outer, needed["outer_tube"], np.where(along <= start, needed["inner_tube"], needed["needle"])
    )
    judged = [v for k, v in clearances.items() if k != "fissure" or plan.fissures_are_obstacles]
    margin = np.min(judged, axis=0) - required
    return {
        "along_mm": pack(along, "f4"),
        "tube_mm": start,
        "exit_mm": float(plan.tube.exit.arc_length_mm),
        "exempt_to_mm": start + float(plan.exemption.needle_length_mm),
        "fissures_are_obstacles": plan.fissures_are_obstacles,
        "cap_mm": CAP_MM,
        "clearance_mm": {name: pack(values, "f4") for name, values in clearances.items()},
        "required_mm": pack(required, "f4"),
        "margin_mm": pack(margin[-len(needle_arc) :], "f4"),
        "curvature_per_mm": pack(_curvature(plan, along, start), "f4"),
        "most_curvature_per_mm": 1.0 / plan.system.needle.min_radius_of_curvature_mm,
        "cost": _cost_so_far(plan, lung),
    }


def _clearances(plan: Plan, lung: Lung, points: Float, exempt: Bool) -> dict[str, Float]:
    found = {}
    for name, bits in (("airway", AIRWAY), ("vessel", VESSEL), ("pleura", OUTSIDE), ("fissure", FISSURE)):
        if name == "fissure" and not lung.has_fissures:
            continue
        found[name] = lung.exact_clearance_mm(points, bits, cap_mm=CAP_MM)
    found["airway"][exempt] = lung.exact_clearance_mm(
        points[exempt], AIRWAY, cap_mm=CAP_MM, exempt_branch=plan.exemption.branch
    )
    return found


def _curvature(plan: Plan, along: Float, start: float) -> Float:
    bend = shapes.bend_of(plan.system.tubes, plan.tube.outer_insertion_mm, plan.tube.inner_insertion_mm)
    edges = np.concatenate([bend.edges_mm, start + np.cumsum([arc.length_mm for arc in plan.needle.arcs])])
    values = np.array([*bend.per_mm, *(arc.curvature_per_mm for arc in plan.needle.arcs)])
    place = np.clip(np.searchsorted(edges, along, side="left") - 1, 0, len(values) - 1)
    return np.asarray(np.abs(values[place]))


def _cost_so_far(plan: Plan, lung: Lung) -> dict[str, Any]:
    """Return the integral of 1 / clearance up to each point of the needle, and of the cost map if any."""
    points, along = needle_polyline(plan.needle)
    clearance = obstacle_clearance_mm(lung, points, with_fissures=plan.fissures_are_obstacles)
    rates = {"inverse_clearance": 1.0 / np.maximum(clearance, FLOOR_MM)}
    if lung.cost is not None:
        ijk = np.floor(lung.cost.grid.ijk(points) + 0.5).astype(np.int64)
        ijk = np.clip(ijk, 0, np.array(lung.cost.grid.shape) - 1)
        values = np.asarray(lung.cost.array, dtype=np.float64)[tuple(ijk.T)]
        if np.isfinite(values).all():
            rates["cost_map"] = values
    steps = np.diff(along)
    return {
        key: pack(np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * steps)]), "f4")
        for key, rate in rates.items()
    }
