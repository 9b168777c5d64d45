"""The three devices of a plan as curves: poses along their axes, from the kinematics of the stages.

Reports, exports and the risk use these curves.  The independent check integrates the devices by itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from anatomy.grid import read_only
from anatomy.typed import Float
from lungaccess.plans.plan import Plan
from stages.needle import ArcPath, arc_transform
from stages.tube import tube_arcs

STEP_MM = 0.25
"""Largest distance between the poses of tubes and needle: the chord of a 40 mm arc is off by 0.2 um."""

SHORTEST_MM = 1e-6
"""Two points that are nearer to each other than this have no direction between them."""

SHORTEST_ARC_MM = 1e-9
"""A piece of tube that is shorter than this is only the rounding of its neighbours' lengths."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DeviceCurve:
    """Where a device runs; N poses.

    Parameters
    ----------
    name : str
        "scope", "tubes" or "needle".
    lps_from_device : (N, 4, 4) float64
        Pose at each point; +z points the way the device moves.
    radius_mm : (N,) float64
        Outer radius of the device there.
    arc_length_mm : (N,) float64
        Length of the device from its first pose.
    colour : tuple of float
        Red, green and blue in [0, 1].
    """

    name: str
    lps_from_device: Float
    radius_mm: Float
    arc_length_mm: Float
    colour: tuple[float, float, float]

    def __post_init__(self) -> None:
        for name in ("lps_from_device", "radius_mm", "arc_length_mm"):
            object.__setattr__(self, name, read_only(np.array(getattr(self, name), dtype=np.float64)))

    @property
    def points_lps(self) -> Float:
        """Positions, `(N, 3)` LPS mm."""
        return self.lps_from_device[:, :3, 3]


def device_curves(plan: Plan, step_mm: float = STEP_MM) -> tuple[DeviceCurve, DeviceCurve, DeviceCurve]:
    """Return scope, tubes and needle of a plan; `step_mm` is the largest distance between poses."""
    return scope_curve(plan), tube_curve(plan, step_mm), needle_curve(plan, step_mm)


def scope_curve(plan: Plan) -> DeviceCurve:
    """Return the route of the bronchoscope; its poses turn as little as possible, the last is the tip's."""
    points = np.asarray(plan.scope.points_lps)
    distinct = np.linalg.norm(np.diff(points, axis=0), axis=1) > SHORTEST_MM
    points = points[np.append(distinct, True)]
    return DeviceCurve(
        name="scope",
        lps_from_device=_carried_back(points, np.asarray(plan.scope.lps_from_scope_tip)),
        radius_mm=np.full(len(points), plan.system.scope.radius_mm),
        arc_length_mm=arc_lengths(points),
        colour=(0.12, 0.47, 0.71),
    )


def tube_curve(plan: Plan, step_mm: float = STEP_MM) -> DeviceCurve:
    """Return the axis of the tubes beyond the scope tip; the radius is the outer tube's up to its end."""
    tubes = plan.system.tubes
    frames, lengths = _poses(tube_path(plan), step_mm)
    in_outer = lengths <= plan.tube.outer_insertion_mm + SHORTEST_MM
    return DeviceCurve(
        name="tubes",
        lps_from_device=frames,
        radius_mm=np.where(in_outer, tubes.outer.radius_mm, tubes.inner.radius_mm),
        arc_length_mm=lengths,
        colour=(1.0, 0.5, 0.05),
    )


def needle_curve(plan: Plan, step_mm: float = STEP_MM) -> DeviceCurve:
    """Return the axis of the needle from the tip of the tubes; each arc bends towards +x of its poses.

    Where two arcs meet, the pose is that at the end of the first, before the turn.
    """
    frames, lengths = _poses(needle_path(plan), step_mm)
    return DeviceCurve(
        name="needle",
        lps_from_device=frames,
        radius_mm=np.full(len(lengths), plan.system.needle.radius_mm),
        arc_length_mm=lengths,
        colour=(0.1, 0.1, 0.1),
    )


def tube_path(plan: Plan) -> ArcPath:
    """Return the axis of the tubes as arcs; the first one is rolled towards the bend."""
    tube = plan.tube
    arcs = tube_arcs(plan.system.tubes, tube.outer_insertion_mm, tube.inner_insertion_mm)
    kept = arcs.length_mm[0] > SHORTEST_ARC_MM
    length, curvature = arcs.length_mm[0][kept], arcs.curvature_per_mm[kept]
    roll = np.where(np.arange(len(length)) == 0, tube.rotation_rad, 0.0)
    return ArcPath(
        lps_from_start=plan.scope.lps_from_scope_tip, arcs=np.stack([length, roll, curvature], axis=1)
    )


def needle_path(plan: Plan) -> ArcPath:
    """Return the axis of the needle as arcs."""
    arcs = [(arc.length_mm, arc.roll_rad, arc.curvature_per_mm) for arc in plan.needle.arcs]
    return ArcPath(lps_from_start=plan.needle.lps_from_start, arcs=np.array(arcs))


def arc_lengths(points: Float) -> Float:
    """Return the length in mm `(N,)` along a polyline `(N, 3)` up to each of its points."""
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))


def _poses(path: ArcPath, step_mm: float) -> tuple[Float, Float]:
    """Return poses `(N, 4, 4)` at the ends of arcs and between them, and their arc lengths `(N,)`."""
    poses, lengths, done = [path.lps_from_start], [0.0], 0.0
    for frame, (length, roll, curvature) in zip(path.frames(), path.arcs, strict=False):
        count = max(1, math.ceil(length / step_mm))
        for at in length * np.arange(1, count + 1) / count:
            poses.append(frame @ arc_transform(at, roll, curvature))
            lengths.append(done + at)
        done += length
    return np.stack(poses), np.array(lengths)


def _carried_back(points: Float, lps_from_tip: Float) -> Float:
    """Carry the pose of the tip back along a polyline `(N, 3)` by the least turns; +z stays along it."""
    ahead = np.diff(points, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    frames = np.tile(np.eye(4), (len(points), 1, 1))
    frames[:, :3, 3] = points
    frames[-1, :3, :3] = lps_from_tip[:3, :3]
    for n in range(len(points) - 2, -1, -1):
        frames[n, :3, :3] = _turn(frames[n + 1, :3, 2], ahead[n]) @ frames[n + 1, :3, :3]
    return frames


def _turn(before: Float, after: Float) -> Float:
    """Return the least rotation `(3, 3)` that takes one unit vector to another, not its opposite."""
    axis, cosine = np.cross(before, after), float(before @ after)
    cross = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / max(1.0 + cosine, SHORTEST_MM))
