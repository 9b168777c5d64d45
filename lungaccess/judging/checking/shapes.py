"""Own kinematics of the check: poses re-integrated with matrix exponentials, shapes by quadrature."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from lungaccess.plans.plan import Plan
from stages.tube.device import ConcentricTubes

TINY_MM = 1e-9
"""A piece shorter than this is rounding, and is not cut off."""
TERMS = 14
"""Of the exponential series for a matrix of norm 1/4: the next term is less than 1e-20."""

STEP_MM = 0.05
"""Largest integration step; the sagitta of one step at a curvature of 0.025 / mm is 8e-6 mm."""


@frozen_record
class Piece:
    """A piece of constant curvature: turn about the tangent, then advance."""

    length_mm: float
    roll_rad: float
    curvature_per_mm: float


@frozen_record
class Curve:
    """Frames along a curve, S + 1 of them, at most `STEP_MM` apart.

    Parameters
    ----------
    frames : (S + 1, 4, 4) float64
        `lps_from_frame`, +z along the curve.
    arc_mm : (S + 1,) float64
        Arc length of each frame.
    sagitta_mm : (S,) float64
        Largest distance between the true curve and the chord of each step.
    """

    frames: Float
    arc_mm: Float
    sagitta_mm: Float

    @property
    def points(self) -> Float:
        """Positions, `(S + 1, 3)` LPS mm."""
        return self.frames[:, :3, 3]

    @property
    def tangents(self) -> Float:
        """Unit tangents, `(S + 1, 3)`."""
        return self.frames[:, :3, 2]

    @property
    def end(self) -> Float:
        """The last frame, `(4, 4)`."""
        return np.asarray(self.frames[-1])


def expm(matrix: Float) -> Float:
    """Return the exponential of a small matrix: the power series of a fraction of it, squared up again."""
    size = float(np.abs(matrix).sum(axis=0).max())
    halvings = max(int(np.ceil(np.log2(max(size, 1e-300)))) + 2, 0)
    fraction = matrix / 2.0**halvings
    term = total = np.eye(len(matrix))
    for n in range(1, TERMS + 1):
        term = term @ fraction / n
        total = total + term
    for _ in range(halvings):
        total = total @ total
    return total


def twist(curvature_per_mm: float) -> Float:
    """Return the `(4, 4)` unicycle twist: forward along +z at unit speed, bending towards +x."""
    matrix = np.zeros((4, 4))
    matrix[0, 2], matrix[2, 0] = curvature_per_mm, -curvature_per_mm
    matrix[2, 3] = 1.0
    return matrix


def turn(angle_rad: float) -> Float:
    """Return the `(4, 4)` rotation about +z, as the exponential of its generator."""
    generator = np.zeros((4, 4))
    generator[1, 0], generator[0, 1] = angle_rad, -angle_rad
    return expm(generator)


def integrate(lps_from_start: Float, pieces: Sequence[Piece]) -> Curve:
    """Follow the pieces from a pose, step by step."""
    frame = np.array(lps_from_start, dtype=np.float64)
    frames, arcs, sagittas, travelled = [frame], [0.0], [0.0], 0.0
    for piece in pieces:
        frame = frame @ turn(piece.roll_rad)
        count = max(int(np.ceil(piece.length_mm / STEP_MM)), 1)
        step_mm = piece.length_mm / count
        step = expm(twist(piece.curvature_per_mm) * step_mm)
        for n in range(count):
            frame = frame @ step
            frames.append(frame)
            arcs.append(travelled + step_mm * (n + 1))
            sagittas.append(abs(piece.curvature_per_mm) * step_mm**2 / 8.0)
        travelled += piece.length_mm
    return Curve(frames=np.array(frames), arc_mm=np.array(arcs), sagitta_mm=np.array(sagittas[1:]))


def cut_at(pieces: Sequence[Piece], at_mm: float) -> list[Piece]:
    """Cut the piece that passes the arc length `at_mm` in two, so that there is a frame exactly there."""
    cut: list[Piece] = []
    begin = 0.0
    for piece in pieces:
        end = begin + piece.length_mm
        if begin + TINY_MM < at_mm < end - TINY_MM:
            cut.append(replace(piece, length_mm=at_mm - begin))
            cut.append(replace(piece, length_mm=end - at_mm, roll_rad=0.0))
        else:
            cut.append(piece)
        begin = end
    return cut


def beyond(curve: Curve, begin_mm: float) -> Curve:
    """Return what lies beyond an arc length of a curve; at least its end."""
    begin_mm = min(begin_mm, float(curve.arc_mm[-1]))
    first = int(np.searchsorted(curve.arc_mm, begin_mm, side="right")) - 1
    frames = curve.frames[first:].copy()
    frames[0, :3, 3] = [np.interp(begin_mm, curve.arc_mm, curve.points[:, axis]) for axis in range(3)]
    arc_mm = curve.arc_mm[first:] - begin_mm
    arc_mm[0] = 0.0
    return Curve(frames=frames, arc_mm=arc_mm, sagitta_mm=curve.sagitta_mm[first:])


def up_to(curve: Curve, end_mm: float) -> Curve:
    """Return what lies before an arc length at which a curve has a frame, or nearly."""
    last = int(np.abs(curve.arc_mm - end_mm).argmin())
    return Curve(
        frames=curve.frames[: last + 1], arc_mm=curve.arc_mm[: last + 1], sagitta_mm=curve.sagitta_mm[:last]
    )


@frozen_record
class Bend:
    """Curvature of the deployed tubes along their length from the scope tip: `per_mm` between `edges_mm`."""

    edges_mm: tuple[float, ...]
    per_mm: tuple[float, ...]


def bend_of(tubes: ConcentricTubes, outer_mm: float, inner_mm: float) -> Bend:
    """Return the curvature of the tubes inserted by `outer_mm` and `inner_mm` (inner >= outer).

    The inner tube is curved over its last `curved_length_mm`.  Where it lies in the straight outer tube the
    bending moments balance: the curvature is that of the inner tube times its share of the bending
    stiffness.  The outer tube never bends alone.
    """
    inner, outer = tubes.inner, tubes.outer
    stiffness_outer = 0.0
    stiffness_inner = inner.youngs_modulus_gpa * (inner.outer_diameter_mm**4 - inner.inner_diameter_mm**4)
    if outer is not None:
        stiffness_outer = outer.youngs_modulus_gpa * (outer.outer_diameter_mm**4 - outer.inner_diameter_mm**4)
    share = stiffness_inner / (stiffness_inner + stiffness_outer)
    curved_from = max(0.0, inner_mm - inner.curved_length_mm)
    edges = sorted({0.0, min(curved_from, inner_mm), outer_mm, inner_mm})
    values = []
    for start, stop in zip(edges[:-1], edges[1:], strict=True):
        middle = 0.5 * (start + stop)
        if middle < curved_from:
            values.append(0.0)
        else:
            values.append(inner.precurvature_per_mm * (share if middle < outer_mm else 1.0))
    return Bend(edges_mm=tuple(edges), per_mm=tuple(values))


def tube_pieces(plan: Plan) -> list[Piece]:
    """Return the tubes of a plan as pieces: planar ones from their insertions, others as their arcs say."""
    tube = plan.tube
    if tube.shape is None:
        bend = bend_of(plan.system.tubes, tube.outer_insertion_mm, tube.inner_insertion_mm)
        return planar_pieces(tube.rotation_rad, bend)
    pieces, turned = [], -tube.rotation_rad
    for length, direction, curvature, _radius in tube.shape.arcs.tolist():
        if length > TINY_MM:
            pieces.append(Piece(length_mm=length, roll_rad=direction - turned, curvature_per_mm=curvature))
            turned = direction
    return pieces


def planar_pieces(rotation_rad: float, bend: Bend) -> list[Piece]:
    """Return planar tubes, turned by an angle, as pieces."""
    rolls = [rotation_rad] + [0.0] * len(bend.per_mm)
    lengths = np.diff(bend.edges_mm)
    return [
        Piece(length_mm=float(length), roll_rad=roll, curvature_per_mm=curvature)
        for length, roll, curvature in zip(lengths, rolls, bend.per_mm, strict=False)
    ]


def tube_tip(plan: Plan, curve: Curve) -> Float:
    """Return the frame that a plan has to state where its tubes end, from the end of their curve."""
    arcs = () if plan.tube.shape is None else plan.tube.shape.arcs
    directions = [float(arc[1]) for arc in arcs if arc[0] > TINY_MM]
    return np.asarray(curve.end @ turn(-directions[-1])) if directions else curve.end


def radius_at(plan: Plan, arc_mm: Float) -> Float:
    """Return the radius of the outermost tube at places `(n,)` beyond the scope tip, its own end included."""
    radius = np.zeros(len(arc_mm))
    inserted = plan.tube.insertions_mm(plan.system.tubes)
    for (_name, tube), end_mm in reversed(list(zip(plan.system.tubes.named, inserted, strict=True))):
        here = (arc_mm <= end_mm) | (radius == 0.0)
        radius = np.where(here, 0.5 * tube.outer_diameter_mm, radius)
    return radius


def planar_shape(bend: Bend, step_mm: float) -> Float:
    """Return points `(n, 2)` (sideways, forward) of the bent tubes by quadrature, `step_mm` apart or less.

    The heading is the integral of the curvature, exact for pieces; the position is its integral by
    Simpson's rule.
    """
    edges = np.asarray(bend.edges_mm)
    count = max(int(np.ceil(edges[-1] / step_mm)), 1)
    arc = np.linspace(0.0, edges[-1], 2 * count + 1)
    turned = np.concatenate([[0.0], np.cumsum(np.diff(edges) * np.asarray(bend.per_mm))])
    heading = np.interp(arc, edges, turned)
    speed = np.stack([np.sin(heading), np.cos(heading)], axis=1)
    width = arc[2] - arc[0]
    steps = width / 6.0 * (speed[:-2:2] + 4.0 * speed[1::2] + speed[2::2])
    return np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])


def deployment_bends(tubes: ConcentricTubes, outer_mm: float, inner_mm: float, step_mm: float) -> list[Bend]:
    """Return the shapes of a deployment [Kuntz2015]: both flush to `outer_mm`, then the inner one."""
    flush = np.linspace(0.0, outer_mm, max(int(np.ceil(outer_mm / step_mm)), 1) + 1)[1:]
    alone = np.linspace(outer_mm, inner_mm, max(int(np.ceil((inner_mm - outer_mm) / step_mm)), 1) + 1)
    together = [bend_of(tubes, float(e), float(e)) for e in flush if e > 0.0]
    return together + [bend_of(tubes, outer_mm, float(e)) for e in alone if e > 0.0]


def distance_to_polyline(points: Float, line: Float) -> Float:
    """Return the `(n,)` distances from points `(n, d)` to a polyline `(m, d)`, m >= 2."""
    start, step = line[:-1], np.diff(line, axis=0)
    length = np.maximum((step**2).sum(axis=1), 1e-300)
    away = points[:, None, :] - start
    along = np.clip((away * step).sum(axis=2) / length, 0.0, 1.0)
    gap = away - along[:, :, None] * step
    return np.asarray(np.sqrt((gap**2).sum(axis=2).min(axis=1)))
