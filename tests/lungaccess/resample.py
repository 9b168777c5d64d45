"""A plan walked again in steps of 0.02 mm, with closed forms and voxel boxes of its own."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from anatomy.base.typed import Float
from anatomy.lung import Lung
from anatomy.structures import AIRWAY, BRANCH_SHIFT, LUMEN, OUTSIDE, VESSEL, obstacle_bits
from lungaccess.plans.plan import Plan
from tests.lungaccess.tube_shapes import shared_curvatures
from tests.stages.scenes import brute_clearance

STEP_MM = 0.02
CORNER_MM = 0.06
"""In the airway the axis may cut the corner of a voxel of wall for less than this."""
REACH_MM = 4.0
"""No device with its margins and the sweep of its tubes needs as much room."""


@dataclass
class Walk:
    """Frames `(N, 4, 4)` along a curve and their arc lengths."""

    frames: Float
    s: Float

    @property
    def points(self) -> Float:
        return self.frames[:, :3, 3]

    @property
    def tangents(self) -> Float:
        return self.frames[:, :3, 2]


def rolled(frame: Float, angle: float) -> Float:
    c, s = math.cos(angle), math.sin(angle)
    return frame @ np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def arc(kappa: float, length: float) -> Float:
    a = kappa * length
    x, z = ((1 - math.cos(a)) / kappa, math.sin(a) / kappa) if abs(kappa) > 1e-9 else (0.0, length)
    return np.array(
        [[math.cos(a), 0, math.sin(a), x], [0, 1, 0, 0], [-math.sin(a), 0, math.cos(a), z], [0, 0, 0, 1.0]]
    )


def follow(frame: Float, arcs: list[tuple[float, float, float]], step: float = STEP_MM) -> Walk:
    """Walk along arcs of (length, roll before it, curvature)."""
    frames, lengths, done = [frame], [0.0], 0.0
    for length, roll, kappa in arcs:
        base = rolled(frame, roll)
        for s in np.linspace(0.0, length, max(2, math.ceil(length / step) + 1))[1:]:
            frames.append(base @ arc(kappa, s))
            lengths.append(done + s)
        frame, done = base @ arc(kappa, length), done + length
    return Walk(np.array(frames), np.array(lengths))


def needle_walk(plan: Plan) -> Walk:
    arcs = [(a.length_mm, a.roll_rad, a.curvature_per_mm) for a in plan.needle.arcs]
    return follow(plan.needle.lps_from_start, arcs)


def tube_walk(plan: Plan) -> Walk:
    """The straight outer tube and the needle bend the inner one back by the share of their stiffness."""
    tubes, outer, inner = plan.system.tubes, plan.tube.outer_insertion_mm, plan.tube.inner_insertion_mm
    kappa, overlap = shared_curvatures(plan.system)
    straight = max(inner - tubes.inner.curved_length_mm, 0.0)
    edges = [0.0, min(straight, outer), outer, max(straight, outer), inner]
    curvature = [0.0, overlap, 0.0, kappa]
    pieces = [(b - a, 0.0, k) for a, b, k in zip(edges[:-1], edges[1:], curvature, strict=True) if b > a]
    return follow(rolled(plan.scope.lps_from_scope_tip, plan.tube.rotation_rad), pieces)


def labels_at(lung: Lung, points: Float) -> np.ndarray:
    index = np.rint(lung.grid.ijk(points)).astype(int)
    inside = ((index >= 0) & (index < lung.labels.shape)).all(axis=1)
    labels = np.full(len(points), OUTSIDE, dtype=np.uint16)
    labels[inside] = lung.labels[tuple(index[inside].T)]
    return labels


def forbidden(plan: Plan) -> int:
    return obstacle_bits(plan.fissures_are_obstacles)


def clearance(lung: Lung, points: Float, bits: int, exempt_branch: int = -1) -> Float:
    return brute_clearance(lung.labels, lung.grid, points, bits, REACH_MM, exempt_branch)


def problems(plan: Plan, lung: Lung) -> list[str]:
    """Say in what a plan breaks the rules, walked again in steps of 0.02 mm."""
    return [*_scope(plan, lung), *_tubes(plan, lung), *([] if plan.needle is None else _needle(plan, lung))]


def _scope(plan: Plan, lung: Lung) -> list[str]:
    walk, out, scope = scope_walk(plan), [], plan.system.scope
    if not (labels_at(lung, walk.points) & LUMEN).all():
        out.append("the scope's axis leaves the lumen")
    if not np.allclose(walk.frames[-1], plan.scope.lps_from_scope_tip, atol=1e-6):
        out.append("the scope's tip is not at the end of its body")
    bends = np.abs(plan.scope.states[:, 2]) / scope.bending_length_mm
    if bends.max() > 1.0 / scope.min_bending_radius_mm + 1e-9:
        out.append("the section bends too tightly")
    return out


def scope_walk(plan: Plan) -> Walk:
    """The body in the last state: the shaft lies where the section led it, the section is the last arc."""
    states, length = plan.scope.states, plan.system.scope.bending_length_mm
    arcs, twist = [], 0.0
    for before, after in zip(states[:-1], states[1:], strict=True):
        if after[0] > before[0]:
            arcs.append((after[0] - before[0], after[1] - twist, after[2] / length))
            twist = after[1]
    arcs.append((length, states[-1, 1] - twist, states[-1, 2] / length))
    return follow(plan.scope.lps_from_entry, arcs, 0.2)


def _tubes(plan: Plan, lung: Lung) -> list[str]:
    walk, out, system = tube_walk(plan), [], plan.system
    if np.abs(walk.frames[-1] - plan.tube.lps_from_tip).max() > 1e-6:
        out.append("the tube tip is elsewhere")
    if plan.needle is not None and not np.allclose(plan.needle.lps_from_start, plan.tube.lps_from_tip):
        out.append("the needle does not start at the tube tip")
    behind = walk.s > plan.tube.exit.arc_length_mm
    before = walk.s < plan.tube.exit.arc_length_mm - 0.2
    if _longest_run((labels_at(lung, walk.points[before]) & LUMEN) == 0) > CORNER_MM / STEP_MM:
        out.append("the tube leaves the lumen before its exit")
    radius = np.where(
        walk.s[behind] <= plan.tube.outer_insertion_mm - 1e-9,
        system.tubes.nested[-1].outer_diameter_mm / 2,
        system.tubes.inner.outer_diameter_mm / 2,
    )
    needed = radius + system.margins.total_mm + plan.tube.lateral_sweep_mm
    gap = clearance(lung, walk.points[behind], forbidden(plan), plan.exemption.branch) - needed
    if gap.min(initial=np.inf) < -1e-6:
        out.append(f"the tube is {-gap.min():.4f} mm too near")
    return out


def _longest_run(flags: np.ndarray) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return int((edges[1::2] - edges[::2]).max(initial=0))


def _needle(plan: Plan, lung: Lung) -> list[str]:
    walk, out, needle = needle_walk(plan), [], plan.system.needle
    required = needle.diameter_mm / 2 + plan.system.margins.total_mm
    if np.linalg.norm(walk.points[-1] - plan.target_lps) > 1e-6:
        out.append("the needle does not end at the target")
    if max(a.curvature_per_mm for a in plan.needle.arcs) > needle.max_curvature_per_mm + 1e-12:
        out.append("an arc is too tight")
    if walk.s[-1] > needle.max_length_mm:
        out.append("the needle is too long")
    steps = np.arccos(np.clip((walk.tangents[1:] * walk.tangents[:-1]).sum(axis=1), -1, 1))
    if steps.max() > needle.max_curvature_per_mm * STEP_MM * 1.05 + 1e-6:
        out.append("the needle has a kink")
    angle = np.degrees(np.arccos(np.clip(walk.tangents @ walk.tangents[0], -1, 1)))
    if angle.max() > needle.max_angle_from_start_deg + 1e-6:
        out.append("the needle turns too far from its start")
    turn = sum(a.length_mm * a.curvature_per_mm for a in plan.needle.arcs)
    if math.degrees(turn) > needle.max_accumulated_turn_deg + 1e-6:
        out.append("the needle turns too much in all")
    return [*out, *_needle_clearance(plan, lung, walk, required)]


def _needle_clearance(plan: Plan, lung: Lung, walk: Walk, required: float) -> list[str]:
    out = []
    bits, branch, needle = forbidden(plan), plan.exemption.branch, plan.system.needle
    at_first = walk.s < needle.exit_exemption_mm - 1e-9
    gap = clearance(lung, walk.points[at_first], bits, branch)
    if gap.min(initial=np.inf) < required - 1e-6:
        out.append(f"at the exit the needle is {required - gap.min():.4f} mm too near")
    lumen = clearance(lung, walk.points[at_first], LUMEN)
    if lumen.min(initial=np.inf) < needle.diameter_mm / 2 - 1e-6:
        out.append("the needle touches a lumen")
    rest = clearance(lung, walk.points[~at_first], bits)
    if rest.min(initial=np.inf) < required - 1e-6:
        out.append(f"the needle is {required - rest.min():.4f} mm too near")
    return out


def branch_of(labels: np.ndarray) -> np.ndarray:
    return np.asarray((labels >> BRANCH_SHIFT).astype(int) - 1)


def put_vessel(lung: Lung, point: Float) -> Lung:
    """A copy of the lung in which the voxel that holds a point is a vessel; only the labels know."""
    from dataclasses import replace

    labels = lung.labels.copy(order="F")
    labels[tuple(np.rint(lung.grid.ijk(point)).astype(int))] = VESSEL
    return replace(lung, labels=labels)


def is_free(lung: Lung, point: Float) -> bool:
    return bool(labels_at(lung, point[None])[0] & (AIRWAY | VESSEL | OUTSIDE) == 0)
