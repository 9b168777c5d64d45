"""The three devices of a plan as poses along their axes, re-integrated from what the plan states."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from anatomy.grid import read_only
from anatomy.typed import Float
from lungaccess.checking import shapes
from lungaccess.plans.plan import Plan

STEP_MM = 1.0
"""Largest distance between the poses of tubes and needle; the chord of an arc of 40 mm radius is 3 um off."""

SHORTEST_MM = 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class Course:
    """Where a device runs; N poses.

    Parameters
    ----------
    name : str
        "scope", "tubes" or "needle".
    lps_from_device : (N, 4, 4) float64
        Pose at each point; +z points the way the device moves.
    radius_mm : (N,) float64
        Outer radius of the device there.
    along_mm : (N,) float64
        Length of the device from its first pose.
    colour : tuple of float
        Red, green and blue in [0, 1].
    """

    name: str
    lps_from_device: Float
    radius_mm: Float
    along_mm: Float
    colour: tuple[float, float, float]

    def __post_init__(self) -> None:
        for name in ("lps_from_device", "radius_mm", "along_mm"):
            object.__setattr__(self, name, read_only(np.array(getattr(self, name), dtype=np.float64)))

    @property
    def points_lps(self) -> Float:
        """Positions, `(N, 3)` LPS mm."""
        return self.lps_from_device[:, :3, 3]


def courses(plan: Plan) -> tuple[Course, Course, Course]:
    """Return scope, tubes and needle of a plan."""
    return scope_course(plan), tubes_course(plan), needle_course(plan)


def scope_course(plan: Plan) -> Course:
    """Return the way of the bronchoscope; its poses turn as little as possible and end in that of the tip."""
    points = np.asarray(plan.scope.points_lps)
    apart = np.linalg.norm(np.diff(points, axis=0), axis=1) > SHORTEST_MM
    points = points[np.append(apart, True)]
    return Course(
        name="scope",
        lps_from_device=_carried_back(points, np.asarray(plan.scope.lps_from_scope_tip)),
        radius_mm=np.full(len(points), 0.5 * plan.system.scope.outer_diameter_mm),
        along_mm=np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))),
        colour=(0.12, 0.47, 0.71),
    )


def tubes_course(plan: Plan) -> Course:
    """Return the axis of the tubes beyond the scope tip; the radius is the outer tube's up to its end."""
    tube, tubes = plan.tube, plan.system.tubes
    bend = shapes.bend_of(tubes, tube.outer_insertion_mm, tube.inner_insertion_mm)
    curve = shapes.tube_curve(
        plan.scope.lps_from_scope_tip, tube.rotation_rad, bend, frame_at_mm=tube.outer_insertion_mm
    )
    frames, along = _thinned(curve, bend.edges_mm)
    in_outer = along <= tube.outer_insertion_mm + SHORTEST_MM
    return Course(
        name="tubes",
        lps_from_device=frames,
        radius_mm=np.where(in_outer, tubes.outer.radius_mm, tubes.inner.radius_mm),
        along_mm=along,
        colour=(1.0, 0.5, 0.05),
    )


def needle_course(plan: Plan) -> Course:
    """Return the axis of the needle from the tip of the tubes; each arc bends towards +x of its poses.

    Where two arcs meet, the pose is that at the end of the first, before the turn.
    """
    needle = plan.needle
    pieces = [
        shapes.Piece(length_mm=arc.length_mm, roll_rad=arc.roll_rad, curvature_per_mm=arc.curvature_per_mm)
        for arc in needle.arcs
    ]
    curve = shapes.integrate(needle.lps_from_start, pieces)
    ends = np.append(0.0, np.cumsum([piece.length_mm for piece in pieces]))
    frames, along = _thinned(curve, tuple(ends.tolist()))
    return Course(
        name="needle",
        lps_from_device=frames,
        radius_mm=np.full(len(along), plan.system.needle.radius_mm),
        along_mm=along,
        colour=(0.1, 0.1, 0.1),
    )


def _thinned(curve: shapes.Curve, edges_mm: tuple[float, ...]) -> tuple[Float, Float]:
    """Return poses and arc lengths at the edges of the pieces, and between them `STEP_MM` apart or less."""
    wanted = [np.zeros(1)]
    for begin, end in zip(edges_mm[:-1], edges_mm[1:], strict=True):
        count = max(1, int(np.ceil((end - begin) / STEP_MM)))
        wanted.append(begin + (end - begin) * np.arange(1, count + 1) / count)
    nearest = np.searchsorted(curve.arc_mm, np.concatenate(wanted) - 0.5 * shapes.STEP_MM)
    kept = np.unique(np.minimum(nearest, len(curve.arc_mm) - 1))
    kept[-1] = len(curve.arc_mm) - 1
    return curve.frames[kept], curve.arc_mm[kept]


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
