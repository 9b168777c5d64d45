"""The window of a plan: the phases of the breath in which it is proved clear and on target."""

import math
from dataclasses import replace

import numpy as np

from anatomy.base.errors import AnatomyError, SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.lung import Lung
from anatomy.motion.motion import Motion
from anatomy.poses import poses_on_arc
from anatomy.structures import AIRWAY, FISSURE, LUMEN, OUTSIDE, VESSEL, obstacle_bits
from lungaccess.plans.curves import needle_pieces, tube_pieces, tube_radii
from lungaccess.plans.plan import Plan
from lungaccess.plans.window import BreathingWindow, WindowLimit
from lungaccess.uncertainty.breathing.kernels import rules
from lungaccess.uncertainty.breathing.kernels.rigid import Rigid
from lungaccess.uncertainty.breathing.kernels.window import MOST_LEAVES, divide

SHORTEST_MM = 1e-9


@frozen_record
class DevicePoints:
    """The devices in the frame of the plan.

    Args:
        points ((N, 3) float64, LPS mm): From the tip of the scope to the end of the needle; where two
            sections meet, a point is there twice.
        arc_mm ((N,) float64): Length from the tip of the scope.
        sections ((S, 5) float64): First and last point, rule, required clearance and radius in mm, see
            `kernels.rules`.
        tube_mm: Length of the tubes.
        hole_lps ((3,) float64, LPS mm): Where the tubes pierce the wall.
        hole_mm: How far that place of the wall may shift: the radius of the tube there, so that it stays in
            its body.
    """

    points: Float
    arc_mm: Float
    sections: Float
    tube_mm: float
    hole_lps: Float
    hole_mm: float


def device_points(plan: Plan) -> DevicePoints:
    """Return tubes and needle of a plan as points, section by section."""
    system, tube, needle = plan.system, plan.tube, plan.needle
    pieces = tube_pieces(tube)
    length, way_out = float(pieces[:, 0].sum()), tube.exit.arc_length_mm
    hole_mm = float(tube_radii(tube, system.tubes, np.array([way_out]))[0])
    # Length of tube that is spent on piercing the wall, which the presets pierce at 10 degrees or more, and
    # how far along the tube, either way of the exit, a hole is that shifts sideways by its limit.
    zone = 1.0 + hole_mm / math.sin(max(tube.exit.wall_angle_rad, math.radians(10.0)))
    at_exit = (way_out - zone, way_out, way_out + zone)
    edges = _edges([*at_exit, length, *tube.insertions_mm(system.tubes)], length)
    extra = system.margins.total_mm + tube.clearance_loss_mm
    kinds = (rules.IN_LUMEN, rules.BEFORE_WALL, rules.IN_WALL, rules.TUBE)
    parts, rows = [], []
    for begin, end in zip(edges[:-1], edges[1:], strict=True):
        middle = 0.5 * (begin + end)
        radius = float(tube_radii(tube, system.tubes, np.array([middle]))[0])
        kind = kinds[sum(middle > edge for edge in at_exit)]
        parts.append(_arcs(begin, end))
        rows.append((kind, radius + extra, radius))
    points = [_points_on_pieces(plan.scope.lps_from_scope_tip, pieces, arcs) for arcs in parts]
    if needle is not None and system.needle is not None:
        exempt = plan.exemption.needle_length_mm
        edges = _edges([exempt, needle.length_mm], needle.length_mm)
        for begin, end in zip(edges[:-1], edges[1:], strict=True):
            kind = rules.NEEDLE_AT_EXIT if 0.5 * (begin + end) < exempt else rules.NEEDLE
            arcs = _arcs(begin, end)
            points.append(_points_on_pieces(needle.lps_from_start, needle_pieces(needle), arcs))
            parts.append(length + arcs)
            rows.append((kind, plan.required_clearance_mm["needle"], system.needle.radius_mm))
    last = np.cumsum([len(each) for each in parts])
    first = last - [len(each) for each in parts]
    return DevicePoints(
        points=np.ascontiguousarray(np.concatenate(points)),
        arc_mm=np.concatenate(parts),
        sections=np.array([(a, b - 1, *row) for a, b, row in zip(first, last, rows, strict=True)]),
        tube_mm=length,
        hole_lps=np.array(tube.exit.point_lps, dtype=np.float64),
        hole_mm=hole_mm,
    )


def _edges(lengths: list[float], most: float) -> list[float]:
    """Return lengths from 0 to `most` in order, each once."""
    edges = [0.0]
    for edge in sorted(min(max(each, 0.0), most) for each in lengths):
        if edge > edges[-1] + SHORTEST_MM:
            edges.append(edge)
    return edges


def _arcs(begin: float, end: float) -> Float:
    # Distance of the points: between two the chord of the tightest arc is off by less than 0.00005 mm.
    return np.linspace(begin, end, max(math.ceil((end - begin) / 0.05), 1) + 1)


def _points_on_pieces(frame: Float, pieces: Float, arcs_mm: Float) -> Float:
    """Return points `(N, 3)` at rising arc lengths `(N,)` along arcs from a frame, as `poses_on_pieces`."""
    points, begin, pose = np.zeros((len(arcs_mm), 3)), 0.0, np.asarray(frame)
    for n, (length, roll, curvature) in enumerate(pieces):
        last = n == len(pieces) - 1
        here = (arcs_mm >= begin) & ((arcs_mm < begin + length) | last)
        poses = poses_on_arc(pose, roll, curvature, np.append(arcs_mm[here] - begin, length))
        points[here], pose, begin = poses[:-1, :3, 3], poses[-1], begin + length
    return points


TOLERANCE_MM = 2.0
"""How far from the moving target the devices may end: half of the smallest nodules that are biopsied."""
WHOLE_BREATH = (0.0, 1.0)
TIP_BALL_MM = 10.0
"""Radius of the tissue whose mean gradient turns the scope's tip: a segmental bronchus is about so long."""
TIP_STEP_MM = 2.5
"""Distance of the places in it, half of that of the motion's nodes."""
NAMES = ((VESSEL, "vessel"), (OUTSIDE, "outside"), (FISSURE, "fissure"), (AIRWAY | LUMEN, "airway"))


def breathing_window(plan: Plan, lung: Lung, *, tolerance_mm: float = TOLERANCE_MM) -> BreathingWindow:
    """Return the phases in which tubes and needle of a plan are proved clear, and end near the moving target.

    The tip of the scope goes along with the airway around it, tubes and needle are rigid from there;
    `docs/explanation/breathing.md` says what moves with what.

    Args:
        lung: The patient of the plan, with a motion.
        tolerance_mm: How far from the moving target the devices may end, at most 2 mm.

    Raises:
        AnatomyError: If the patient has no motion.
        PlanFileError: If the plan was made for another patient.
        SettingsError: If the tolerance is not from 0 to 2 mm.
    """
    plan.require_lung(lung)
    motion = require_motion(lung)
    if not 0.0 <= tolerance_mm <= TOLERANCE_MM:
        raise SettingsError(
            f"The tolerance of the window is {tolerance_mm} mm", expected=f"0 to {TOLERANCE_MM:g} mm"
        )
    leaves, devices = _leaves(plan, lung, float(tolerance_mm), WHOLE_BREATH, all_of_it=True)
    found = _window(motion, float(tolerance_mm), leaves, devices)
    return replace(found, beside_target_mm=float(np.linalg.norm(plan.end_lps - plan.goal_lps)))


def first_limit(plan: Plan, lung: Lung, phases: tuple[float, float]) -> WindowLimit | None:
    """Return what ends the window of a plan first between two phases; None if it is proved in all of them.

    The stretches are those of `breathing_window`, which then holds these phases, without a gap.
    """
    leaves, devices = _leaves(plan, lung, TOLERANCE_MM, phases, all_of_it=False)
    last = leaves[-1]
    return None if last[2] == rules.CLEAR else _limit(last, max(float(last[0]), phases[0]), devices)


def _leaves(
    plan: Plan, lung: Lung, tolerance_mm: float, phases: tuple[float, float], *, all_of_it: bool
) -> tuple[Float, DevicePoints]:
    """Return the stretches of `divide` between two phases, and the devices that they speak of."""
    motion = require_motion(lung)
    side, devices = motion.side_of(plan.target_lps), device_points(plan)
    tip = plan.scope.lps_from_scope_tip[:3, 3]
    leaves, end = np.zeros((MOST_LEAVES, 5)), devices.points[-1]
    target = np.array(plan.goal_lps), miss_allowed(motion, tolerance_mm, distance_mm(end, tip))
    hole_mm = miss_allowed(motion, devices.hole_mm, distance_mm(devices.hole_lps, tip))
    about = _tissue_of(plan, lung), breath_of(motion, side), carrier(motion, tip, side)
    what = *about, devices.points, devices.arc_mm, devices.sections, *target, devices.hole_lps, hole_mm
    breath = float(motion.amplitude), float(motion.masks_phase)
    count = divide(*what, *breath, phases, all_of_it, leaves)
    return leaves[:count], devices


def with_window(plan: Plan, lung: Lung) -> Plan:
    """Return a plan with its window of breathing; itself if no breathing is known."""
    return plan if lung.motion is None else replace(plan, window=breathing_window(plan, lung))


def require_motion(lung: Lung) -> Motion:
    """Return the motion of a lung, or raise AnatomyError that says how to give it one."""
    if lung.motion is None:
        raise AnatomyError(
            f"Nothing is known of the breathing of {lung.name}",
            expected="a [motion] in the patient.toml of its folder, which may hold nothing else",
            remedy='Write into it motion = { file = "field.nrrd", maps_from = "end-exhale", '
            "masks_phase = 0.0 }, or landmarks.csv as its file, or "
            "motion = { population = true, masks_phase = 0.0 } for a warning without data; "
            "docs/explanation/breathing.md says more",
        )
    return lung.motion


def miss_allowed(motion: Motion, limit_mm: float, lever_mm: float) -> float:
    """Return the distance by the motion that stays within a limit wherever tissue strays, mm.

    A place of tissue so far from a point of the devices is at most `lever_mm` and this from the scope's tip.
    """
    return (limit_mm - motion.hysteresis * lever_mm) / (1.0 + motion.hysteresis)


def distance_mm(point: Float, other: Float) -> float:
    """Return the distance of two points `(3,)`."""
    return float(np.linalg.norm(np.asarray(point) - other))


def breath_of(motion: Motion, side: int) -> rules.Breath:
    """Return the motion of one lung for the kernels."""
    return rules.Breath(motion.nodes[side], motion.frame, motion.cells[side], float(motion.hysteresis))


def carrier(motion: Motion, tip_lps: Float, side: int) -> Rigid:
    """Return what carries the devices: the place of the scope's tip and the mean gradient about it.

    The gradient is that of the least-squares affine motion of the places in a ball, which are symmetric.
    """
    steps = np.arange(-TIP_BALL_MM, TIP_BALL_MM + 1e-9, TIP_STEP_MM)
    ball = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    ball = ball[(ball**2).sum(axis=1) <= TIP_BALL_MM**2]
    moved = motion.displacements_mm(tip_lps + ball, side)
    return Rigid(
        centre=np.array(tip_lps, dtype=np.float64),
        displacement=motion.displacements_mm(tip_lps[None], side)[0],
        gradient=np.ascontiguousarray(moved.T @ ball / (ball[:, 0] ** 2).sum()),
    )


def _tissue_of(plan: Plan, lung: Lung) -> rules.Tissue:
    """Return what the devices of a plan collide with, for the kernels."""
    field = lung.obstacle_field(with_fissures=plan.fissures_are_obstacles)
    return rules.Tissue(
        clearance=field.corners,
        labels=lung.labels,
        geometry=field.geometry,
        bits=obstacle_bits(plan.fissures_are_obstacles),
        lumen=lung.lumen_depth.corners,
        lumen_geometry=lung.lumen_depth.geometry,
        branch=int(plan.exemption.branch),
    )


def _window(motion: Motion, tolerance_mm: float, leaves: Float, devices: DevicePoints) -> BreathingWindow:
    clear = leaves[:, 2] == rules.CLEAR
    turns = np.diff(np.concatenate([[0], clear.astype(int), [0]]))
    first, last = np.flatnonzero(turns == 1), np.flatnonzero(turns == -1) - 1
    limits = []
    for a, b in zip(first, last, strict=True):
        limits += [_limit(leaves[a - 1], float(leaves[a, 0]), devices)] if a > 0 else []
        limits += [_limit(leaves[b + 1], float(leaves[b, 1]), devices)] if b + 1 < len(leaves) else []
    if not len(first):
        nearest = int(np.abs(leaves[:, :2].mean(axis=1) - motion.masks_phase).argmin())
        limits = [_limit(leaves[nearest], float(leaves[nearest, :2].mean()), devices)]
    undecided = leaves[leaves[:, 2] == rules.UNDECIDED]
    return BreathingWindow(
        motion_key=motion.key,
        motion_source=motion.source,
        warning_only=motion.warning_only,
        masks_phase=motion.masks_phase,
        amplitude=motion.amplitude,
        tolerance_mm=tolerance_mm,
        phases=np.stack([leaves[first, 0], leaves[last, 1]], axis=1),
        undecided_share=float((undecided[:, 1] - undecided[:, 0]).sum()),
        limits=tuple(limits),
        hysteresis=float(motion.hysteresis),
    )


def _limit(leaf: Float, phase: float, devices: DevicePoints) -> WindowLimit:
    """Return what a stretch that is not clear says of the phase where it begins or ends."""
    reason, point = int(leaf[3]), int(leaf[4])
    arc, in_tube = float(devices.arc_mm[point]), devices.arc_mm[point] <= devices.tube_mm
    named = {rules.TARGET_MISSED: "target", rules.LEAVES_LUMEN: "lumen", rules.HOLE_SHIFTS: "hole"}.get(
        reason
    )
    return WindowLimit(
        phase=phase,
        reason=named or next((name for bits, name in NAMES if reason & bits), "airway"),
        device="tube" if in_tube else "needle",
        arc_length_mm=arc if in_tube else arc - devices.tube_mm,
        place_lps=devices.points[point],
    )
