"""The tubes, derived anew by the CasADi model from their insertions and rotations alone."""

import itertools
from typing import TYPE_CHECKING

import numpy as np

from anatomy.base.errors import LungaccessError
from anatomy.base.typed import Float
from lungaccess.judging.checking.channel import slots_at
from lungaccess.judging.checking.findings import Findings
from lungaccess.judging.checking.poses import ANGLE_TOLERANCE_RAD, angle_between
from lungaccess.judging.checking.shapes import Curve, distance_to_polyline, radius_at
from lungaccess.plans.plan import Plan
from stages.tube.device import Tube

if TYPE_CHECKING:
    from stages.tube.casadi_shape import DerivedShape


SHAPE_TOLERANCE_MM = 1e-3
"""Two integrations of one equilibrium differ by far less; so much more than stated may the arcs be off."""


def check_shape(plan: Plan, curve: Curve, found: Findings) -> float | None:
    """Record everything about the shape of the tubes; None if they snap.

    Returns:
        What has to be free beside radius and margins: the sweep, and how far the arcs are from the tubes, mm.
    """
    tube, tubes, shape = plan.tube, plan.system.tubes, plan.tube.shape
    from stages.tube.casadi_shape import derive_shape

    names = {name for name, _tube in tubes.named}
    if not found.true(
        "tube.rotations", set(shape.relative_rotations_rad) == names, f"of {', '.join(sorted(names))}"
    ):
        return None
    try:
        derived = derive_shape(
            tubes.nested, tube.rotations_rad(tubes)[::-1], tube.insertions_mm(tubes)[::-1],
            needle=plan.system.needle_tube if plan.system.needle_preloaded else None,
        )  # fmt: skip
    except LungaccessError as error:
        found.true("tube.stable", False, str(error))
        return None
    found.at_least("tube.stable", derived.least_determinant, 0.0, "", "least determinant on the way")
    # The least on the way is met by steps, and those of a planner and of the check are others.
    found.agrees("tube.stable.stated", shape.least_determinant, derived.least_determinant, 0.05, "")
    off_mm = _check_arcs(plan, curve, derived, found)
    _check_strain(plan, derived, found)
    return off_mm + _replay(plan, derived, found)


def _check_arcs(plan: Plan, curve: Curve, derived: "DerivedShape", found: Findings) -> float:
    """The stated arcs are the derived shape up to their stated error; return how far they are from it."""
    shape, scope = plan.tube.shape, plan.scope.lps_from_scope_tip
    length = float(shape.arcs[:, 0].sum())
    found.agrees("tube.arcs.length", length, plan.tube.inner_insertion_mm, SHAPE_TOLERANCE_MM, "mm")
    edges = np.append(0.0, np.cumsum(shape.arcs[:, 0]))
    ends = edges[:-1] + SHAPE_TOLERANCE_MM, edges[1:] - SHAPE_TOLERANCE_MM
    wrong = np.abs(shape.arcs[:, 3] - np.array([radius_at(plan, each) for each in ends]))
    wrong = wrong[:, shape.arcs[:, 0] > 2.0 * SHAPE_TOLERANCE_MM]
    found.at_most("tube.arcs.radius", float(wrong.max(initial=0.0)), 0.0, "mm", "", SHAPE_TOLERANCE_MM)
    points = derived.points_mm @ scope[:3, :3].T + scope[:3, 3]
    stated = np.stack(
        [np.interp(derived.arc_lengths_mm, curve.arc_mm, axis) for axis in curve.points.T], axis=1
    )
    off = float(np.linalg.norm(points - stated, axis=1).max())
    detail = "distance of the stated arcs from the tubes, at most as stated"
    found.at_most("tube.arcs", off, shape.arc_error_mm, "mm", detail, SHAPE_TOLERANCE_MM)
    angle = float(angle_between(scope[:3, :3] @ derived.base_from_tip[:3, 2], plan.tube.lps_from_tip[:3, 2]))
    detail = "between the stated and the derived direction of the tip"
    found.at_most("tube.tip.derived", angle, ANGLE_TOLERANCE_RAD, "rad", detail)
    return off


def _replay(plan: Plan, derived: "DerivedShape", found: Findings) -> float:
    """Compare every step of the way with the final place; return how far the tubes get from it.

    Tubes that bend in one plane state how far they get from the final shape, all others how far each place
    gets from where it ends, which is not less.
    """
    final, sweep, leader = derived.points_mm, 0.0, 0.0
    for body in derived.way:
        # Spacing of the points of a body that are compared with its final place.
        arc = np.linspace(0.0, body[-1, 0], max(int(np.ceil(body[-1, 0] / 0.5)), 1) + 1)
        points = np.stack([np.interp(arc, body[:, 0], axis) for axis in body[:, 1:].T], axis=1)
        off = distance_to_polyline(points, final)
        leader = max(leader, float(off.max()))
        if not plan.system.tubes.planar:
            off = np.linalg.norm(points - derived.at(arc), axis=1)
        sweep = max(sweep, float(off.max()))
    return check_sweep(plan, sweep, leader, len(derived.way), found)


def _check_strain(plan: Plan, derived: "DerivedShape", found: Findings) -> None:
    """Where several tubes lie in each other, each is bent away from its rest by the others."""
    tubes, inserted = plan.system.tubes.nested, plan.tube.insertions_mm(plan.system.tubes)[::-1]
    needle = plan.system.needle_tube if plan.system.needle_preloaded else None
    straight = np.column_stack([np.zeros(len(derived.arc_lengths_mm)), derived.relative_rad])
    worst = max(curvature * _strained_mm(tube) for tube in tubes for _, _, curvature, _ in _pieces(tube))
    for (begin, end), angles in zip(
        itertools.pairwise(derived.arc_lengths_mm.tolist()), straight[1:], strict=True
    ):
        middle, here = 0.5 * (begin + end), []
        for tube, out_mm, angle in zip(tubes, inserted, angles.tolist(), strict=True):
            if middle < out_mm and end > begin:
                here.append((tube, _rest(tube, out_mm - middle, angle), _stiffness(tube, out_mm - middle)))
        if not here:
            continue
        total = sum(stiffness for *_, stiffness in here)
        if needle is not None:
            total += _stiffness(needle, inserted[0] - middle)
        shared = sum(stiffness * rest for _, rest, stiffness in here) / total
        worst = max(
            worst, *(_strained_mm(tube) * float(np.linalg.norm(shared - rest)) for tube, rest, _ in here)
        )
    detail = "largest strain of the tube material"
    found.at_most("tube.strain", worst, plan.system.tubes.max_strain, "", detail)


def _pieces(tube: Tube) -> list[tuple[float, float, float, float]]:
    """Return the bent pieces of a tube: begin and end from its tip in mm, curvature, direction in rad."""
    if not tube.bent_pieces:
        return [(0.0, tube.curved_length_mm, tube.precurvature_per_mm, 0.0)]
    ends = np.cumsum([piece.length_mm for piece in reversed(tube.bent_pieces)]).tolist()
    return [
        (end - piece.length_mm, end, piece.precurvature_per_mm, float(np.deg2rad(piece.direction_deg)))
        for piece, end in zip(reversed(tube.bent_pieces), ends, strict=True)
    ]


def _rest(tube: Tube, from_tip_mm: float, angle_rad: float) -> Float:
    """Return the precurvature `(2,)` at a place of a tube that is turned by an angle, 1/mm."""
    for begin, end, curvature, direction in _pieces(tube):
        if begin <= from_tip_mm < end:
            towards = angle_rad + direction
            return curvature * np.array([np.cos(towards), np.sin(towards)])
    return np.zeros(2)


def _stiffness(tube: Tube, from_tip_mm: float) -> float:
    """Return the bending stiffness of a tube at a place, up to a factor that all tubes share."""
    factor = slots_at(tube.slotted_segments, from_tip_mm)[0]
    return factor * tube.youngs_modulus_gpa * (tube.outer_diameter_mm**4 - tube.inner_diameter_mm**4)


def _strained_mm(tube: Tube) -> float:
    """Return the strain of a tube for each 1/mm of change of curvature, mm, at worst along it."""
    return (
        0.5
        * tube.outer_diameter_mm
        * max((each.strain_factor for each in tube.slotted_segments), default=1.0)
    )


SWEEP_TOLERANCE_MM = 0.02
"""A replay at steps may find so much less than a planner, which takes the largest sweep."""


def check_sweep(plan: Plan, sweep: float, leader: float, steps: int, found: Findings) -> float:
    """Record sweep and error at the tip of a replay; return the sweep, mm, that clearance allows for.

    The sweep is the farthest that any place of the tubes gets from their final shape, `leader` the farthest
    that their tip does.
    """
    tube, limit = plan.tube, plan.system.tubes.max_lateral_sweep_mm
    detail = f"sideways motion while the tubes are deployed, {steps} steps replayed"
    found.at_most("tube.sweep.limit", sweep, limit, "mm", detail, SWEEP_TOLERANCE_MM)
    detail = "sideways motion as stated"
    found.at_most("tube.sweep.stated_limit", tube.lateral_sweep_mm, limit, "mm", detail)
    stated = ((tube.lateral_sweep_mm, sweep, "sweep"), (tube.follow_the_leader_error_mm, leader, "leader"))
    for value, recomputed, name in stated:
        detail = "not less than recomputed"
        found.at_least(f"tube.{name}.stated", value, recomputed, "mm", detail, SWEEP_TOLERANCE_MM)
    return max(sweep if sweep > SWEEP_TOLERANCE_MM else 0.0, tube.lateral_sweep_mm)
