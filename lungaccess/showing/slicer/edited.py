"""A curve of a plan that was edited in 3D Slicer: what of it still holds, and what broke."""

from dataclasses import replace

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.io.markups import Markup
from anatomy.lung import Lung
from anatomy.structures import BITS
from lungaccess.judging.checking import CheckReport, Finding, check
from lungaccess.judging.checking.findings import Findings
from lungaccess.planning.one_stage import RestOfPlan
from lungaccess.plans.assemble import SAMPLE_MM
from lungaccess.plans.curves import DeviceCurve, arc_lengths
from lungaccess.plans.plan import Plan
from lungaccess.problem.target import Target
from lungaccess.problem.task import Task
from stages.needle import (
    CURVATURE,
    LENGTH,
    ArcPath,
    Objective,
    Query,
    arc_transform,
    direct_path,
    needle_environment,
    violation,
)

DEVICES = ("scope", "tubes", "needle")
MOVED_MM = 0.01
"""Points nearer to the planned curve are taken to lie on it: drawn on a screen, none is moved by less."""
EDITED = "edited in 3D Slicer"
"""The method of a plan with such a needle is called so."""
SAME_MM = 1e-6
"""Arcs are joined to one whose ends are as near as this, and points nearer to each other are one."""


@frozen_record
class EditedCurve:
    """An edited curve, and what is said of the plan with it.

    Args:
        device: "scope", "tubes" or "needle".
        words: What was edited, in a sentence.
        plan: With the needle that runs through the points; as it was where there is none, or where another
            curve was edited.
        report: What was looked at, and what the independent check says; accepted only if all of it holds.
    """

    device: str
    words: str
    plan: Plan
    report: CheckReport


def check_curve(plan: Plan, lung: Lung, curve: Markup) -> EditedCurve:
    """Check a plan one of whose curves was edited in 3D Slicer.

    The needle runs through its control points in their order, by one arc from each to the next: the arcs of
    a curve that was not edited are those of the plan.  Where no such arcs are within the needle's curvature,
    everything else is measured along straight lines between the points.  Scope and tubes cannot be drawn: the
    shape of the tubes follows from their mechanics, and the scope's from a motion.  Their curves have to lie
    on the planned ones.

    Args:
        curve: Its name says of which device it is; any other is that of the needle.

    Raises:
        PlanFileError: If the plan was made for another patient.
        SettingsError: If the curve is that of a needle and the plan has none, or has fewer than two separate
            points.
    """
    plan.require_lung(lung)
    named = curve.name.split(" ")[-1]
    device = named if named in DEVICES else "needle"
    planned, points = plan.curves()[DEVICES.index(device)], curve.points_lps
    away = _distances(points, planned.points_lps)
    made, findings = plan, _of_body(device, planned, points, away, lung)
    if device == "needle":
        if plan.needle is None:
            raise SettingsError(
                f"The plan has no needle, but {curve.name!r} is edited",
                expected="a plan with a needle",
                remedy="Only needles can be drawn; plan again for another system",
            )
        ends = np.stack([plan.needle.lps_from_start[:3, 3], plan.needle.end_lps])
        ends_mm = np.linalg.norm(points[[0, -1]] - ends, axis=1)
        if max(away.max(), ends_mm.max()) > MOVED_MM:
            path = _path_of_points(points, np.asarray(plan.needle.lps_from_start))
            findings = _too_tight(path, points, plan)
            if findings:
                findings += _of_polyline(plan, lung, points)
                report = CheckReport(accepted=False, findings=findings)
                return EditedCurve(
                    device=device, words=_words(device, away, points), plan=plan, report=report
                )
            made, findings = _with_needle(plan, lung, path)
    checked = check(made, lung)
    accepted = checked.accepted and all(each.ok is not False for each in findings)
    report = CheckReport(accepted=accepted, findings=(*findings, *checked.findings))
    return EditedCurve(device=device, words=_words(device, away, points), plan=made, report=report)


def _path_of_points(points_lps: Float, lps_from_start: Float) -> ArcPath:
    """Return the arcs through points `(N, 3)`, one from each to the next, in the direction of a start pose.

    Arcs that continue one another are joined.  Raises SettingsError if fewer than two points are apart from
    each other.
    """
    frame = np.array(lps_from_start)
    frame[:3, 3] = points_lps[0]
    start, arcs = frame, np.zeros((0, 3))
    for point in points_lps[1:]:
        if np.linalg.norm(point - frame[:3, 3]) <= SAME_MM:
            continue
        step = direct_path(frame, point)
        arcs = _joined(arcs, step.arcs[0], frame)
        frame = step.frames()[-1]
    if not len(arcs):
        raise SettingsError(
            f"The curve has {len(points_lps)} points in one place",
            expected="at least two points apart from each other",
            remedy="Draw the curve from the tip of the tubes to the target",
        )
    return ArcPath(lps_from_start=start, arcs=arcs)


def _joined(arcs: Float, arc: Float, frame: Float) -> Float:
    """Return arcs `(A, 3)` and one more from their end, as one with the last where it continues that."""
    if len(arcs):
        _length, _roll, curvature = arcs[-1]
        on = frame @ arc_transform(arc[0], 0.0, curvature)
        if np.linalg.norm(on[:3, 3] - (frame @ arc_transform(*arc))[:3, 3]) <= SAME_MM:
            return np.vstack([arcs[:-1], arcs[-1] + [arc[0], 0.0, 0.0]])
    return np.vstack([arcs, arc])


def _distances(points: Float, curve: Float) -> Float:
    """Return the distances of points `(N, 3)` from a polyline `(M, 3)`."""
    begin, way = curve[:-1], np.diff(curve, axis=0)
    share = np.einsum("nmk,mk->nm", points[:, None] - begin, way) / np.maximum(
        (way**2).sum(axis=1), SAME_MM**2
    )
    nearest = begin + np.clip(share, 0.0, 1.0)[..., None] * way
    return np.asarray(np.linalg.norm(points[:, None] - nearest, axis=2).min(axis=1))


def _words(device: str, away: Float, points: Float) -> str:
    moved = np.flatnonzero(away > MOVED_MM)
    if not len(moved):
        return f"No point of the {device} was moved by more than {MOVED_MM:g} mm."
    along = np.linalg.norm(np.diff(points[: moved[0] + 1], axis=0), axis=1).sum()
    return (
        f"{len(moved)} of {len(points)} points of the {device} lie off the planned curve, by up to "
        f"{away.max():.2f} mm; the first is {along:.1f} mm from the start of the curve."
    )


def _of_body(
    device: str, planned: DeviceCurve, points: Float, away: Float, lung: Lung
) -> tuple[Finding, ...]:
    """Return the findings of a scope or of tubes, which cannot take a drawn shape; none of a needle."""
    if device == "needle":
        return ()
    why = {
        "scope": "its shape follows from a motion: `lungaccess replan --scope` plans on from a moved tip",
        "tubes": "their shape follows from the mechanics: `lungaccess plan --exit` plans for another exit",
    }
    collected = Findings()
    detail = f"distance from the planned curve; {why[device]}"
    collected.at_most(f"{device}.curve", float(away.max()), MOVED_MM, "mm", detail)
    if device == "scope":
        depth, kept = (lung.lumen_depth.lower_bound_mm(each) for each in (points, planned.points_lps))
        least = min(float(planned.radius_mm.max()), float(kept.min()))
        detail = f"depth in the lumen of point {int(depth.argmin()) + 1}, the shallowest"
        collected.at_least("scope.curve.lumen", float(depth.min()), least, "mm", detail, MOVED_MM)
    return collected.report().findings


def _too_tight(path: ArcPath, points: Float, plan: Plan) -> tuple[Finding, ...]:
    """Return where a needle would have to bend more than it can to run through points; none if nowhere."""
    most = plan.system.require_needle("An edited needle").max_curvature_per_mm
    tight = np.flatnonzero(path.arcs[:, CURVATURE] > most * (1.0 + SAME_MM))
    if not len(tight):
        return ()
    collected, least = Findings(), 1.0 / most
    begin = float(path.arcs[: tight[0], LENGTH].sum())
    end = begin + float(path.arcs[tight[0], LENGTH])
    detail = f"first arc that bends too tightly, {begin:.1f} to {end:.1f} mm from the start"
    collected.at_least(
        "needle.curve.arc", 1.0 / float(path.arcs[tight[0], CURVATURE]), least, "mm radius", detail
    )
    if len(points) > 2:
        # The radii `(N - 2,)` of the circles through three successive points, infinite on a line.
        a, b, c = points[:-2], points[1:-1], points[2:]
        sides = np.linalg.norm(b - a, axis=1) * np.linalg.norm(c - b, axis=1) * np.linalg.norm(c - a, axis=1)
        area = 2.0 * np.linalg.norm(np.cross(b - a, c - b), axis=1)
        radii = np.asarray(np.where(area > 0.0, sides / np.maximum(area, np.finfo(float).tiny), np.inf))
        along, sharp = arc_lengths(points)[1:-1], np.flatnonzero(radii < least * (1.0 - SAME_MM))
        where = f"; {len(sharp)} of {len(radii)} are too small" + (
            f", {along[sharp[0]]:.1f} to {along[sharp[-1]]:.1f} mm from the start" if len(sharp) else ""
        )
        collected.at_least(
            "needle.curve.radius", float(radii.min()), least, "mm",
            f"smallest circle through three successive points{where}", least * SAME_MM,
        )  # fmt: skip
    return collected.report().findings


def _of_polyline(plan: Plan, lung: Lung, points: Float) -> tuple[Finding, ...]:
    """Return start, end, length and distances of the straight lines between points."""
    collected, needle = Findings(), plan.system.require_needle("An edited needle")
    start, target = plan.tube.lps_from_tip[:3, 3], plan.end_lps
    name, detail = "needle.curve.start", "distance from the tip of the tubes"
    collected.at_most(name, float(np.linalg.norm(points[0] - start)), MOVED_MM, "mm", detail)
    name, detail = "needle.curve.end", "distance from the target"
    collected.at_most(name, float(np.linalg.norm(points[-1] - target)), MOVED_MM, "mm", detail)
    along = arc_lengths(points)
    collected.at_most("needle.curve.length", float(along[-1]), needle.max_length_mm, "mm", "sum of the lines")
    places = np.arange(0.0, along[-1], SAMPLE_MM)
    samples = np.stack([np.interp(places, along, column) for column in points.T], axis=1)
    required = plan.required_clearance_mm["needle"]
    structures = {name: bit for name, bit in BITS.items() if name in plan.clearance_mm["needle"]}
    for name, bit in structures.items():
        cap = 2.0 * required
        distances = lung.exact_clearance_mm(samples, bit, cap_mm=cap)
        if name == "airway":
            exempt = places < plan.exemption.needle_length_mm
            distances[exempt] = lung.exact_clearance_mm(
                samples[exempt], bit, cap_mm=cap, exempt_branch=plan.exemption.branch
            )
        detail = f"nearest {places[int(distances.argmin())]:.1f} mm from the start"
        detail = detail if distances.min() < cap else "or more"
        collected.at_least(f"needle.curve.clearance.{name}", float(distances.min()), required, "mm", detail)
    collected.unchecked("needle", "no needle runs through these points: their straight lines were measured")
    return collected.report().findings


def _with_needle(plan: Plan, lung: Lung, path: ArcPath) -> tuple[Plan, tuple[Finding, ...]]:
    """Return a plan with another needle, all of it evaluated anew, and what the planner's own proof says."""
    system = plan.system
    needle = system.require_needle("An edited needle")
    target = Target(lps_mm=plan.end_lps, origin=plan.target_origin)
    task = Task(
        lung=lung, system=system, target=target, objective=Objective.of(plan.objective), seed=plan.seed
    )
    branch = plan.exemption.branch
    rest = RestOfPlan(
        task=task, lps_from_measured=plan.tube.lps_from_tip, deployment=None, path=path, branch=branch
    )
    made = replace(
        plan, needle=rest.needle, clearance_mm={**plan.clearance_mm, **rest.clearance_mm}, costs=rest.costs,
        method=EDITED, chance=None, window=None, cost_bound=0.0,
    )  # fmt: skip
    environment = needle_environment(lung, needle, system.margins, with_fissures=task.with_fissures)
    query = Query(lps_from_start=np.asarray(plan.tube.lps_from_tip), target=plan.end_lps, branch=branch)
    broken = violation(environment, query, path, goal_tolerance_mm=MOVED_MM)
    collected = Findings()
    collected.true("needle.proof", not broken, broken or "clear and within all limits")
    missed = float(np.linalg.norm(path.frames()[-1][:3, 3] - plan.end_lps))
    collected.at_most("needle.curve.end", missed, MOVED_MM, "mm", "distance from the target")
    return made, collected.report().findings
