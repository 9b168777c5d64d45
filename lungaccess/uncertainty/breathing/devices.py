"""Tubes and needle of a plan as points with the rule that holds for each stretch of them."""

import math

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.poses import poses_on_arc
from lungaccess.plans.curves import needle_pieces, tube_pieces, tube_radii
from lungaccess.plans.plan import Plan
from lungaccess.uncertainty.breathing.kernels.rules import (
    BEFORE_WALL,
    IN_LUMEN,
    IN_WALL,
    NEEDLE,
    NEEDLE_AT_EXIT,
    TUBE,
)

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
    zone = exit_zone_mm(hole_mm, tube.exit.wall_angle_rad)
    at_exit = (way_out - zone, way_out, way_out + zone)
    edges = _edges([*at_exit, length, *tube.insertions_mm(system.tubes)], length)
    extra = system.margins.total_mm + tube.clearance_loss_mm
    parts, rows = [], []
    for begin, end in zip(edges[:-1], edges[1:], strict=True):
        middle = 0.5 * (begin + end)
        radius = float(tube_radii(tube, system.tubes, np.array([middle]))[0])
        kind = (IN_LUMEN, BEFORE_WALL, IN_WALL, TUBE)[sum(middle > edge for edge in at_exit)]
        parts.append(_arcs(begin, end))
        rows.append((kind, radius + extra, radius))
    points = [points_on_pieces(plan.scope.lps_from_scope_tip, pieces, arcs) for arcs in parts]
    if needle is not None and system.needle is not None:
        exempt = plan.exemption.needle_length_mm
        edges = _edges([exempt, needle.length_mm], needle.length_mm)
        for begin, end in zip(edges[:-1], edges[1:], strict=True):
            kind = NEEDLE_AT_EXIT if 0.5 * (begin + end) < exempt else NEEDLE
            arcs = _arcs(begin, end)
            points.append(points_on_pieces(needle.lps_from_start, needle_pieces(needle), arcs))
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


def exit_zone_mm(hole_mm: float, wall_angle_rad: float) -> float:
    """Return how far along the tube, either way of the exit, a hole is that shifts sideways by its limit."""
    # The least angle at which the tubes of the presets may pierce a wall.
    # Length of tube that is spent on piercing the wall.
    return 1.0 + hole_mm / math.sin(max(wall_angle_rad, math.radians(10.0)))


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


def points_on_pieces(frame: Float, pieces: Float, arcs_mm: Float) -> Float:
    """Return points `(N, 3)` at rising arc lengths `(N,)` along arcs from a frame, as `poses_on_pieces`."""
    points, begin, pose = np.zeros((len(arcs_mm), 3)), 0.0, np.asarray(frame)
    for n, (length, roll, curvature) in enumerate(pieces):
        last = n == len(pieces) - 1
        here = (arcs_mm >= begin) & ((arcs_mm < begin + length) | last)
        lengths = np.append(arcs_mm[here] - begin, length)
        poses = poses_on_arc(pose, roll, curvature, lengths)
        points[here], pose, begin = poses[:-1, :3, 3], poses[-1], begin + length
    return points
