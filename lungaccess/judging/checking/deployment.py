"""Third part of the check: the tubes follow from their insertions, leave the airway once and stay clear."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from anatomy import structures
from anatomy.base.errors import LungaccessError
from anatomy.base.typed import Float, Labels
from anatomy.shafts import SlottedSegment
from lungaccess.judging.checking import clearances, shapes
from lungaccess.judging.checking.boxes import (
    Environment,
    PathDistances,
    airway_except,
    branch_of,
    has,
    labels_at,
)
from lungaccess.judging.checking.findings import (
    ANGLE_TOLERANCE_RAD,
    Findings,
    angle_between,
    check_rigid,
    check_same_pose,
)
from lungaccess.judging.checking.scope import motion_of
from lungaccess.judging.checking.shapes import Curve, distance_to_polyline, radius_at
from lungaccess.judging.checking.wall_exit import Exit, check_exit, check_wall_run
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import System
from stages.needle.device import Needle
from stages.tube.device import AIRWAY_MM, Tube

if TYPE_CHECKING:
    from stages.tube.casadi_shape import DerivedShape

STEP_MM = 0.5
"""Spacing of the places of channel and tube that are looked at; what is between two is counted with both."""


def _check_channel(plan: Plan, found: Findings) -> None:
    """Record strain of tubes and needle all along the channel, and the bend that the handle must set."""
    scope, device, tubes = plan.scope, plan.system.scope, plan.system.tubes
    motion = motion_of(scope.lps_from_entry, scope.states, device.bending_length_mm)
    which, lengths_mm = motion.body_pieces()
    behind_mm, bent = np.cumsum(lengths_mm[::-1])[::-1], np.linalg.norm(motion.bends[which], axis=1)
    tightest = float(bent.max(initial=0.0))
    limit = tubes.max_channel_curvature_per_mm
    if limit is not None:
        detail = "curvature of the channel that the tubes pass"
        found.at_most("tube.channel", tightest, limit, "1/mm", detail, 1e-9)
    inserted = plan.tube.insertions_mm(tubes)
    for (name, tube), length in zip(tubes.named, inserted, strict=True):
        strain = max(_strains(tube, behind_mm, bent, length))
        detail = f"largest strain of the {name} tube on its way through the channel"
        found.at_most(f"tube.strain.{name}", strain, tubes.max_strain, "", detail, 1e-9)
    needle = plan.system.needle
    if needle is not None:
        # Tubes that share a bend are bent by no more than the most bent of them is at rest.
        at_rest = max(curvature for tube in tubes.nested for _begin, _end, curvature in _bent_at_rest(tube))
        strain = 0.5 * needle.diameter_mm * _largest_factor(plan.system) * max(tightest, at_rest)
        detail = "largest strain of the needle on its way through channel and tubes"
        found.at_most("needle.strain", strain, needle.max_strain, "", detail, 1e-9)
    _check_handle(plan, inserted, found)


def _strains(tube: Tube, behind_mm: Float, bent: Float, inserted_mm: float) -> Iterator[float]:
    """Yield the strain of every part of a tube in the most bent place that it comes to, and held straight."""
    for at in np.arange(0.0, inserted_mm + float(behind_mm[0]) + STEP_MM, STEP_MM):
        # A part `at` mm from the tube's tip comes to every place that is so far behind the scope's tip.
        passed = bent[behind_mm >= at - inserted_mm - STEP_MM]
        most = float(passed.max(initial=0.0))
        for end in (max(at - STEP_MM, 0.0), at):
            rest = max(k for begin, stop, k in _bent_at_rest(tube) if begin <= end <= stop)
            yield 0.5 * tube.outer_diameter_mm * _slots_at(tube.slotted_segments, end)[1] * (most + rest)


def _bent_at_rest(tube: Tube) -> list[tuple[float, float, float]]:
    """Return the parts of a tube: begin and end in mm from its tip, and precurvature in 1/mm."""
    parts = [(begin, end, curvature) for begin, end, curvature, _direction in _pieces(tube)]
    return [*parts, (parts[-1][1], np.inf, 0.0)]


def _slots_at(segments: Sequence[SlottedSegment], from_tip_mm: float) -> tuple[float, float]:
    """Return how stiff and how strained a shaft is at a place, as shares of a plain one's."""
    for segment in segments:
        if segment.from_tip_mm <= from_tip_mm <= segment.from_tip_mm + segment.length_mm:
            return segment.stiffness_factor, segment.strain_factor
    return 1.0, 1.0


def _largest_factor(system: System) -> float:
    """Return the largest factor of strain along all of the needle that can come to a bend."""
    needle = system.require_needle("The strain of a needle")
    segments = needle.slotted_segments
    passing_mm = AIRWAY_MM + system.tubes.max_extension_mm + needle.max_length_mm
    covered = sum(max(min(segment.to_mm, passing_mm) - segment.from_tip_mm, 0.0) for segment in segments)
    factors = [segment.strain_factor for segment in segments if segment.from_tip_mm < passing_mm]
    return max([*factors, 1.0] if covered < passing_mm - 1e-9 else factors)


def _check_handle(plan: Plan, inserted_mm: tuple[float, ...], found: Findings) -> None:
    """Section, tubes and needle share the bending moment that the handle sets: it must bend them all."""
    device, tubes = plan.system.scope, plan.system.tubes
    stiffness = device.bending_stiffness_n_mm2
    for tube, inserted in zip(reversed(tubes.nested), inserted_mm, strict=True):
        inside = np.append(np.arange(inserted, inserted + device.bending_length_mm, STEP_MM), inserted)
        stiffness += _stiffest_n_mm2(tube, tube.outer_diameter_mm, inside)
    shaft = plan.system.needle
    if shaft is not None and plan.system.needle_preloaded:
        passes = inserted_mm[-1] + shaft.max_length_mm + device.bending_length_mm
        stiffness += _stiffest_n_mm2(shaft, shaft.diameter_mm, np.arange(0.0, passes, STEP_MM))
    bend = float(plan.scope.states[-1, 2])
    limit = np.deg2rad(device.bend_up_deg if bend >= 0.0 else device.bend_down_deg)
    detail = "bend that the handle sets so that section, tubes and needle bend as planned"
    wanted = abs(bend) * stiffness / device.bending_stiffness_n_mm2
    found.at_most("scope.handle", wanted, float(limit), "rad", detail, 1e-6)


def _stiffest_n_mm2(shaft: Tube | Needle, diameter_mm: float, from_tip_mm: Float) -> float:
    """Return the greatest bending stiffness of a shaft at places of it."""
    plain = 1e3 * shaft.youngs_modulus_gpa * np.pi / 64.0
    plain *= diameter_mm**4 - shaft.inner_diameter_mm**4
    return plain * max(_slots_at(shaft.slotted_segments, float(at))[0] for at in from_tip_mm)


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
    axes = plan.scope.lps_from_scope_tip[:3, :3]
    rigid = check_rigid("tube.tip", tube.lps_from_tip, found)
    if not (rigid and np.abs(axes.T @ axes - np.eye(3)).max() < 1e-3):
        return None
    pieces = shapes.tube_pieces(plan)
    curve = shapes.integrate(plan.scope.lps_from_scope_tip, pieces)
    tip = shapes.tube_tip(plan, curve)
    check_same_pose("tube.tip", tube.lps_from_tip, tip, found)
    _check_lengths(plan, found)
    _check_channel(plan, found)
    beside_mm = _check_shape(plan, curve, found)
    if beside_mm is None:
        return None
    way_out = check_exit(plan, lung, curve, found)
    if way_out is not None:
        curve = shapes.integrate(plan.scope.lps_from_scope_tip, shapes.cut_at(pieces, way_out.arc_mm))
        way_out = replace(way_out, frame=int(np.abs(curve.arc_mm - way_out.arc_mm).argmin()))
        _check_containment(plan, curve, labels_at(lung, curve.points), way_out, found)
        _check_out_of_lumen(environment, curve, way_out, found)
        _check_clearance(plan, environment, curve, way_out, beside_mm, found)
        check_wall_run(plan, environment, curve, way_out, found)
    return tip


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
    boxes = environment.boxes(has(structures.LUMEN), clearances.REACH_MM)
    clearances.check_clear("tube.beyond_wall.lumen", boxes, points, needed, found, limited=True)


def rim(frames: Float, radius_mm: Float) -> Float:
    """Return `RIM_POINTS` points around the axis at each of S frames, `(S RIM_POINTS, 3)`."""
    phi = np.linspace(0.0, 2.0 * np.pi, RIM_POINTS, endpoint=False)
    frames = frames[:, None, :3]
    across = np.cos(phi)[:, None] * frames[..., 0] + np.sin(phi)[:, None] * frames[..., 1]
    return np.asarray(frames[..., 3] + radius_mm[:, None, None] * across).reshape(-1, 3)


def last_wet(labels: Labels) -> int:
    """Return the last frame of which the rim is wholly in the lumen, 0 without one."""
    wet = ((labels & structures.LUMEN) != 0).reshape(-1, RIM_POINTS).all(axis=1)
    return int(np.flatnonzero(wet)[-1]) if wet.any() else 0


def _check_clearance(
    plan: Plan, environment: Environment, curve: Curve, way_out: Exit, beside_mm: float, found: Findings
) -> None:
    """From its first contact with the wall on, each tube keeps radius, margins and more from obstacles.

    More are the sweep, and how far the derived shape is from the curve.
    """
    # From this frame on, up to the exit, the tube's rim is never wholly in the lumen.
    before = curve.frames[: way_out.frame + 1]
    around = rim(before, shapes.radius_at(plan, curve.arc_mm[: way_out.frame + 1]))
    contact = last_wet(labels_at(environment.lung, around))
    margin = plan.system.margins.total_mm + beside_mm
    needed = shapes.radius_at(plan, curve.arc_mm[:-1] + ROUNDING_MM) + margin + curve.sagitta_mm
    # In the lumen, up to the exit, other branches are only open space.
    cases = [
        ("vessel", has(structures.VESSEL), contact),
        ("outside", has(structures.OUTSIDE), contact),
        ("fissure", has(structures.FISSURE), contact),
        ("airway", airway_except(way_out.branch), way_out.frame),
    ]
    for name, select, first in clearances.structures_known(cases, "tube", environment.lung, found):
        boxes = environment.boxes(select, clearances.REACH_MM)
        least = clearances.check_clear(
            f"tube.clearance.{name}", boxes, curve.points[first:], needed[first:], found,
            limited=name != "fissure" or plan.fissures_are_obstacles,
        )  # fmt: skip
        most = PathDistances(boxes, curve.points[way_out.frame :]).least_mm()
        diagonal = float(np.linalg.norm(environment.lung.grid.spacing_mm))
        clearances.check_stated_clearance(plan, "tube", name, (least, most), diagonal, found)


SHAPE_TOLERANCE_MM = 1e-3
"""Two integrations of one equilibrium differ by far less; so much more than stated may the arcs be off."""


def _check_shape(plan: Plan, curve: Curve, found: Findings) -> float | None:
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


SWEEP_TOLERANCE_MM = 0.02
"""A replay at steps may find so much less than a planner, which takes the largest sweep."""


def _replay(plan: Plan, derived: "DerivedShape", found: Findings) -> float:
    """Compare every step of the way with the final place; return the sweep, mm, that clearance allows for.

    The sweep is the farthest that any place gets from the final shape, of tubes that bend in one plane, or,
    of all others, from where it ends, which is not less; `leader` is the first of these for all tubes.
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
    tube, limit = plan.tube, plan.system.tubes.max_lateral_sweep_mm
    detail = f"sideways motion while the tubes are deployed, {len(derived.way)} steps replayed"
    found.at_most("tube.sweep.limit", sweep, limit, "mm", detail, SWEEP_TOLERANCE_MM)
    found.at_most("tube.sweep.stated_limit", tube.lateral_sweep_mm, limit, "mm", "sideways motion as stated")
    stated = ((tube.lateral_sweep_mm, sweep, "sweep"), (tube.follow_the_leader_error_mm, leader, "leader"))
    for value, recomputed, name in stated:
        detail = "not less than recomputed"
        found.at_least(f"tube.{name}.stated", value, recomputed, "mm", detail, SWEEP_TOLERANCE_MM)
    return max(sweep if sweep > SWEEP_TOLERANCE_MM else 0.0, tube.lateral_sweep_mm)


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
    factor = _slots_at(tube.slotted_segments, from_tip_mm)[0]
    return factor * tube.youngs_modulus_gpa * (tube.outer_diameter_mm**4 - tube.inner_diameter_mm**4)


def _strained_mm(tube: Tube) -> float:
    """Return the strain of a tube for each 1/mm of change of curvature, mm, at worst along it."""
    factor = max((each.strain_factor for each in tube.slotted_segments), default=1.0)
    return 0.5 * tube.outer_diameter_mm * factor
