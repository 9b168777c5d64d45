"""Where the tubes of a plan leave the lumen for good, at which angle, and how far they run in the wall."""

from typing import TYPE_CHECKING

import numpy as np

from anatomy import structures
from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float, Int
from lungaccess.judging.checking.boxes import Environment, branch_of, has, labels_at, region_around
from lungaccess.judging.checking.findings import POSITION_TOLERANCE_MM, Findings
from lungaccess.judging.checking.shapes import Curve, radius_at
from lungaccess.plans.plan import Plan

if TYPE_CHECKING:
    from anatomy.lung import Lung

EXIT_TOLERANCE_MM = 0.02
"""Two bisections of the border of a voxel, on curves that differ by micrometres, agree to less than this."""
SAMPLES = 25
"""Samples in a step of the curve, 0.002 mm apart: voxel corners thinner than the step are found."""
SLIVER_MM = 0.03
"""Lumen that is met for less than this behind the exit may be overlooked by a search point by point."""

WALL_ANGLE_TOLERANCE_RAD = 0.05
"""The centroid of the lumen's voxels jumps where one of them enters the ball; the angle by less than this."""
NORMAL_RADIUS_MM = 2.5
"""A ball of several voxels: the steps of the mask average out, and the bronchus is still nearly straight."""


@frozen_record
class Exit:
    """Where the re-integrated tube leaves the lumen for good: frame before it, arc length, pierced branch."""

    frame: int
    arc_mm: float
    branch: int


@frozen_record
class _Samples:
    """Points along a curve, and branch and lumen where they lie, S of them."""

    arc_mm: Float
    points: Float
    branch: Int
    in_lumen: Bool


def check_exit(plan: Plan, lung: "Lung", curve: Curve, found: Findings) -> Exit | None:
    """Derive the exit anew and compare it with what the plan states and exempts."""
    stated, exemption = plan.tube.exit, plan.exemption
    samples = _samples_of(lung, curve)
    if not found.true("tube.starts_in_lumen", samples.in_lumen[0], "tip of the scope"):
        return None
    detail = "the tube leaves the airway lumen"
    if not found.true("tube.leaves", not samples.in_lumen[-1], detail):
        return None
    last, out_mm = _last_in_lumen(samples, stated.arc_length_mm)
    detail = "longest stretch out of the lumen before the exit; so far a corner of a voxel is cut"
    # An axis that is out of the lumen for no more than this cuts the corner of a voxel: not an exit.
    # Both ends of such a stretch are known to a sample.
    found.at_most("tube.one_exit", out_mm, 0.05, "mm", detail, 0.005)
    arc_mm, point = _border(lung, samples, last)
    # The pierced branch is that of a lumen voxel which the axis meets in this last length before the exit.
    near = samples.in_lumen & (np.abs(samples.arc_mm - samples.arc_mm[last]) <= 0.25)
    branches = {int(b) for b in np.unique(samples.branch[: last + 1][near[: last + 1]])}
    found.true("tube.exit.branch", stated.branch in branches, f"{stated.branch} against {sorted(branches)}")
    outside_mediastinum = stated.branch in np.flatnonzero(~lung.tree.mediastinal)
    detail = "trachea and main bronchi lie in the mediastinum"
    found.true("tube.exit.not_mediastinal", outside_mediastinum, detail)
    detail = f"{exemption.branch} against {stated.branch}"
    found.true("exemption.branch", exemption.branch == stated.branch, detail)
    found.agrees("tube.exit.arc", stated.arc_length_mm, arc_mm, EXIT_TOLERANCE_MM, "mm")
    same = found.agrees("tube.exit.point", stated.point_lps, point, EXIT_TOLERANCE_MM, "mm")
    found.agrees("exemption.point", exemption.exit_point_lps, stated.point_lps, POSITION_TOLERANCE_MM, "mm")
    frame = int(np.searchsorted(curve.arc_mm, arc_mm, side="right")) - 1
    # At the stated point, if it is the same: between the two a voxel may enter or leave the ball.
    angle = wall_angle_rad(lung, np.asarray(stated.point_lps) if same else point, curve.tangents[frame])
    found.agrees("tube.exit.angle", stated.wall_angle_rad, angle, WALL_ANGLE_TOLERANCE_RAD, "rad")
    limit = float(np.deg2rad(plan.system.tubes.min_wall_angle_deg))
    found.at_least("tube.exit.angle.stated_limit", stated.wall_angle_rad, limit, "rad")
    detail = "recomputed angle to the wall"
    found.at_least("tube.exit.angle.limit", angle, limit, "rad", detail, WALL_ANGLE_TOLERANCE_RAD)
    return Exit(frame=frame, arc_mm=arc_mm, branch=exemption.branch)


def derived_exit(lung: "Lung", curve: Curve) -> tuple[Exit, Float] | None:
    """Return where a curve leaves the lumen for good, and that point `(3,)`; None where it does not.

    Of several places that `check_exit` would accept it is the first.
    """
    samples = _samples_of(lung, curve)
    if not samples.in_lumen[0] or samples.in_lumen[-1]:
        return None
    last, _out_mm = _last_in_lumen(samples, 0.0)
    arc_mm, point = _border(lung, samples, last)
    frame = int(np.searchsorted(curve.arc_mm, arc_mm, side="right")) - 1
    return Exit(frame=frame, arc_mm=arc_mm, branch=int(samples.branch[last])), point


def _samples_of(lung: "Lung", curve: Curve) -> _Samples:
    """Return points along a curve, its end the last of them."""
    share = np.arange(SAMPLES)[:, None] / SAMPLES
    step = np.diff(curve.points, axis=0)[:, None]
    points = np.concatenate([(curve.points[:-1, None] + share * step).reshape(-1, 3), curve.points[-1:]])
    arc = (curve.arc_mm[:-1, None] + share.T * np.diff(curve.arc_mm)[:, None]).ravel()
    labels = labels_at(lung, points)
    return _Samples(
        arc_mm=np.append(arc, curve.arc_mm[-1]),
        points=points,
        branch=branch_of(labels),
        in_lumen=(labels & structures.LUMEN) != 0,
    )


def _last_in_lumen(samples: _Samples, stated_mm: float) -> tuple[int, float]:
    """Return the last sample in the lumen, and the longest stretch out of it before, mm.

    Behind it there may be lumen that is thinner than SLIVER_MM.  Of such places the one nearest to what is
    stated is returned: a planner need not see them.
    """
    turns = np.diff(np.concatenate([[False], samples.in_lumen, [False]]).astype(np.int8))
    first, last = np.flatnonzero(turns == 1), np.flatnonzero(turns == -1) - 1
    begin, end = samples.arc_mm[first], samples.arc_mm[last]
    thick = int(np.flatnonzero((end - begin >= SLIVER_MM) | (first == 0))[-1])
    chosen = thick + int(np.abs(end[thick:] - stated_mm).argmin())
    return int(last[chosen]), float((begin[1 : chosen + 1] - end[:chosen]).max(initial=0.0))


def _border(lung: "Lung", samples: _Samples, last: int) -> tuple[float, Float]:
    """Return arc length and position of the border of the lumen behind a sample, by bisection."""
    a, b = samples.points[last], samples.points[last + 1]
    inside, outside = 0.0, 1.0
    # The spacing of the samples, halved so often, is less than a nanometre.
    for _ in range(20):
        middle = 0.5 * (inside + outside)
        if labels_at(lung, a + middle * (b - a))[0] & structures.LUMEN:
            inside = middle
        else:
            outside = middle
    arc_mm = samples.arc_mm[last] + inside * (samples.arc_mm[last + 1] - samples.arc_mm[last])
    return float(arc_mm), a + inside * (b - a)


def wall_angle_rad(lung: "Lung", point_lps: Float, tangent: Float) -> float:
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


def check_wall_run(
    plan: Plan, environment: Environment, curve: Curve, way_out: Exit, found: Findings
) -> None:
    """Beyond the exit no more of the tube's body than allowed lies in the airway that it leaves."""
    stated, limit = plan.tube.exit.wall_run_mm, plan.system.tubes.max_wall_run_mm
    least, most = wall_run_mm(plan, environment, curve, way_out)
    found.at_most("tube.wall_run.limit", least, limit, "mm", "body in the wall beyond the exit")
    found.at_most("tube.wall_run.stated_limit", stated, limit, "mm", "body in the wall, as stated")
    detail = "not less than recomputed"
    found.at_least("tube.wall_run.stated", stated, least, "mm", detail, EXIT_TOLERANCE_MM)
    detail = "not more than recomputed with 0.04 mm more radius"
    found.at_most("tube.wall_run.stated.most", stated, most, "mm", detail, EXIT_TOLERANCE_MM)


def wall_run_mm(plan: Plan, environment: Environment, curve: Curve, way_out: Exit) -> tuple[float, float]:
    """Return how much of the tube's body lies in the wall beyond the exit, at least and at most, mm.

    From the distances of the ends of a step follows how much of it is nearer to the wall than the radius:
    a distance changes no faster than one walks.  Airways of other branches are farther away
    (`tube.clearance.airway`).
    """
    behind = np.flatnonzero(curve.arc_mm[1:] > way_out.arc_mm + 1e-9)
    radius = radius_at(plan, curve.arc_mm[behind + 1] - 1e-9)
    walls = environment.boxes(has(structures.AIRWAY), float(radius.max()) + 1.0)
    distance = walls.distance_mm(curve.points[np.append(behind[:1], behind + 1)])
    step = np.diff(curve.arc_mm)[behind]
    nearer = [np.clip(radius - each, 0.0, step) for each in (distance[:-1], distance[1:])]
    # A planner may count steps of half of this in which the body comes as near as half of this to the wall.
    free = distance - 0.04
    farther = [np.clip(each - radius, 0.0, step) for each in (free[:-1], free[1:])]
    least = float(np.minimum(nearer[0] + nearer[1], step).sum())
    most = float((step - np.minimum(farther[0] + farther[1], step)).sum())
    return least, most
