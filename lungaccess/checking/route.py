"""Second part of the check: the bronchoscope fits where it runs, and its tip is on the airway axis."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from anatomy import structures
from anatomy.typed import Float
from lungaccess.checking.environment import AirwayAxis, Environment
from lungaccess.checking.findings import Findings
from lungaccess.checking.poses import ANGLE_TOLERANCE_RAD, POSITION_TOLERANCE_MM, angle_between, check_rigid
from lungaccess.checking.space import labels_at, not_lumen
from lungaccess.plans.parts import ScopeRoute
from lungaccess.plans.plan import Plan

if TYPE_CHECKING:
    from anatomy.airway_tree import AirwayTree

SAMPLE_MM = 0.1
"""Spacing of the points of the route that are looked up, well below a voxel."""
AXIS_TOLERANCE_MM = 0.01
"""Routes are copied from the airway tree, so that only rounding lies between them."""
SAME_MM = 1e-6
"""Points of a route that are nearer than this are the same."""

MAX_STEP_MM = 5.0
"""Points of the airway tree lie closer; a longer step would jump from branch to branch."""
REACH_MM = 15.0
"""Lumen radii are recomputed up to this, more than that of any trachea."""
RADIUS_TOLERANCE_MM = 0.05
"""Radii are stated at points; between two points the lumen may be this much narrower."""

MAX_CHORD_ANGLE_RAD = np.deg2rad(45.0) + 1e-6
"""Between the tip and the last `CHORD_MM` of the route: a tip must look where the scope is going."""

CHORD_MM = 2.0
"""Length of the last chord of the route: a few of its points, so that one of them does not decide."""

MAX_OFF_AXIS_MM = 20.0
"""Only so near to its tip may a scope with a turned tip be beside the medial axis."""

BENDING_RADIUS_MM = 10.0
"""Smallest radius with which a scope bends there."""


def check_route(plan: Plan, environment: Environment, found: Findings) -> None:
    """Record everything about the bronchoscope."""
    route, lung = plan.scope, environment.lung
    astray_mm = _check_on_tree(route, environment.axis, found)
    samples = _resample(route.points_lps, SAMPLE_MM)
    in_lumen = (labels_at(lung, samples) & structures.LUMEN) != 0
    detail = f"{int((~in_lumen).sum())} of {len(samples)} samples outside"
    found.true("scope.in_lumen", in_lumen.all(), detail)
    if astray_mm <= REACH_MM:
        _check_fit(plan, environment, samples, found)
    _check_tip(route, environment.axis, found)
    _check_statements(route, lung.tree, found)


def _resample(points: Float, step_mm: float) -> Float:
    """Return points along a polyline at most `step_mm` apart, the given ones among them."""
    pieces = [points[:1]]
    for a, b in zip(points[:-1], points[1:], strict=True):
        count = max(int(np.ceil(np.linalg.norm(b - a) / step_mm)), 1)
        pieces.append(a + (b - a) * (np.arange(1, count + 1) / count)[:, None])
    return np.concatenate(pieces)


def _check_on_tree(route: ScopeRoute, axis: AirwayAxis, found: Findings) -> float:
    """The route begins at the root and keeps to the edges of the airway tree; return how far it strays."""
    points, tree = route.points_lps, axis.tree
    start = float(np.linalg.norm(points[0] - tree.points_lps[0]))
    found.at_most("scope.start", start, AXIS_TOLERANCE_MM, "mm", "first point to the root of the airway tree")
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    found.at_most("scope.connected", float(steps.max()), MAX_STEP_MM, "mm", "largest step of the route")
    samples = _resample(points, 10.0 * SAMPLE_MM)
    gaps = axis.distance_mm(samples)
    before_tip = np.linalg.norm(np.diff(samples, axis=0), axis=1)
    before_tip = np.append(np.cumsum(before_tip[::-1])[::-1], 0.0)
    if _is_turned(route, axis):
        _check_bend(points, gaps, before_tip, found)
        gaps = gaps[before_tip > MAX_OFF_AXIS_MM] if before_tip[0] > MAX_OFF_AXIS_MM else gaps[:1]
    found.at_most("scope.on_axis", float(gaps.max()), AXIS_TOLERANCE_MM, "mm", "route to airway axis")
    nearest = axis.nearest_points(points, 3)
    same = (tree.branch_of_point[nearest] == route.branches[:, None]).any(axis=1)
    found.true("scope.branches", bool(same.all()), f"{int((~same).sum())} points name another branch")
    return float(gaps.max())


def _axis_at_tip(route: ScopeRoute, axis: AirwayAxis) -> Float:
    """Return the direction of the airway where the route ends."""
    if 0 <= route.site_point < axis.tree.n_points:
        return np.asarray(axis.tree.tangents[route.site_point])
    return axis.tangent_at(route.lps_from_scope_tip[:3, 3])


def _is_turned(route: ScopeRoute, axis: AirwayAxis) -> bool:
    """Tell whether the tip looks elsewhere than along the airway."""
    tilt = angle_between(route.lps_from_scope_tip[:3, 2], _axis_at_tip(route, axis))
    return float(tilt) > ANGLE_TOLERANCE_RAD


def _distinct(points: Float) -> Float:
    """Return a polyline without the points that are where the one before them is: they have no direction."""
    kept = [points[0]]
    for point in points[1:]:
        if np.linalg.norm(point - kept[-1]) > SAME_MM:
            kept.append(point)
    return np.array(kept)


def _check_bend(points: Float, gaps: Float, before_tip: Float, found: Findings) -> None:
    """Where the route leaves the axis it bends no tighter than a scope can."""
    steps = np.diff(_distinct(points), axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    off = before_tip[gaps > AXIS_TOLERANCE_MM].max(initial=0.0)
    within = np.flatnonzero(np.cumsum(lengths[::-1])[::-1] < off)
    turns = [
        float(angle_between(steps[n], steps[n + 1])) / max(0.5 * (lengths[n] + lengths[n + 1]), 1e-9)
        for n in within[:-1]
    ]
    found.at_most(
        "scope.bend", max(turns, default=0.0), 1.05 / BENDING_RADIUS_MM, "1/mm", "curvature beside the axis"
    )


def _check_fit(plan: Plan, environment: Environment, samples: Float, found: Findings) -> None:
    """The lumen is wide enough all along, and the stated radii and margin are not more than there is."""
    route, scope = plan.scope, plan.system.scope
    boxes = environment.boxes(not_lumen, REACH_MM)
    radius = 0.5 * scope.outer_diameter_mm
    narrowest = boxes.least_mm(samples)
    found.at_least(
        "scope.fits",
        narrowest,
        radius + scope.lumen_margin_mm,
        "mm",
        "smallest lumen radius, at points and between them; needed: radius of the scope plus its margin",
        POSITION_TOLERANCE_MM,
    )
    stated = np.minimum(route.lumen_radius_mm, REACH_MM) - boxes.distance_mm(route.points_lps)
    found.at_most("scope.lumen_radius", float(stated.max()), RADIUS_TOLERANCE_MM, "mm", "stated beyond found")
    slack = float(np.linalg.norm(environment.lung.grid.spacing_mm))
    found.at_least("scope.lumen_radius.least", float(stated.min()), -slack, "mm", "stated below found")
    over = route.min_lumen_margin_mm - (narrowest - radius)
    found.at_most("scope.margin", over, RADIUS_TOLERANCE_MM, "mm", "stated beyond recomputed margin")


def _check_tip(route: ScopeRoute, axis: AirwayAxis, found: Findings) -> None:
    """The tip is at the end of the route and looks along the airway."""
    pose, tree = route.lps_from_scope_tip, axis.tree
    if not check_rigid("scope.tip", pose, found):
        return
    found.agrees("scope.tip.position", pose[:3, 3], route.points_lps[-1], POSITION_TOLERANCE_MM, "mm")
    if 0 <= route.site_point < tree.n_points:
        site = route.site_point
        found.agrees("scope.site", route.points_lps[-1], tree.points_lps[site], POSITION_TOLERANCE_MM, "mm")
    else:
        found.true("scope.site", route.site_point == -1, f"site {route.site_point}")
        gap = float(axis.distance_mm(pose[None, :3, 3])[0])
        found.at_most("scope.site.on_axis", gap, AXIS_TOLERANCE_MM, "mm", "tip to airway axis")
    # A tip looks along the airway's axis, or along the end of a route that leaves the axis.
    end = route.points_lps[-1] - route.points_lps[-2] if len(route.points_lps) > 1 else pose[:3, 2]
    turned = _is_turned(route, axis)
    tilt = float(angle_between(pose[:3, 2], end if turned else _axis_at_tip(route, axis)))
    of_what = "tip to the end of its route" if turned else "tip to airway axis"
    found.at_most("scope.tip.tangent", tilt, ANGLE_TOLERANCE_RAD, "rad", of_what)
    back = np.linalg.norm(route.points_lps - route.points_lps[-1], axis=1) >= CHORD_MM
    before = route.points_lps[np.flatnonzero(back)[-1]] if back.any() else route.points_lps[0]
    tilt = float(angle_between(pose[:3, 2], route.points_lps[-1] - before))
    found.at_most("scope.tip.forward", tilt, float(MAX_CHORD_ANGLE_RAD), "rad", "tip to the end of the route")


def _check_statements(route: ScopeRoute, tree: AirwayTree, found: Findings) -> None:
    """Generation and lengths are what the tree and the points say."""
    branch = int(route.branches[-1])
    generation = int(tree.generation[branch]) if 0 <= branch < tree.n_branches else -1
    found.true("scope.generation", route.generation == generation, f"{route.generation} against {generation}")
    length = float(np.linalg.norm(np.diff(route.points_lps, axis=0), axis=1).sum())
    found.agrees("scope.length", route.length_mm, length, POSITION_TOLERANCE_MM, "mm")
    beyond = length - float(tree.distance_from_root_mm[tree.branch_start[1] - 1])
    stated = route.length_from_carina_mm
    wanted = beyond if stated < 0.0 else max(beyond, 0.0)
    found.agrees("scope.length_from_carina", stated, wanted, 10.0 * POSITION_TOLERANCE_MM, "mm")
