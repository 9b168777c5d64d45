"""Own kinematics of the check: poses re-integrated with matrix exponentials, shapes by quadrature."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from lungaccess.plans.parts import NeedleArc
from lungaccess.plans.plan import Plan

TINY_MM = 1e-9
"""A piece shorter than this is rounding, and is not cut off."""
TERMS = 14
"""Of the exponential series for a matrix of norm 1/4: the next term is less than 1e-20."""

Piece = NeedleArc
"""A stretch of constant curvature of tubes or needle, which turns about its tangent, then advances."""
STEP_MM = 0.05
"""Largest integration step; the sagitta of one step at a curvature of 0.025 / mm is 8e-6 mm."""


@frozen_record
class Curve:
    """Frames along a curve, S + 1 of them, at most `STEP_MM` apart.

    Args:
        frames ((S + 1, 4, 4) float64): `lps_from_frame`, +z along the curve.
        arc_mm ((S + 1,) float64): Arc length of each frame.
        sagitta_mm ((S,) float64): Largest distance between the true curve and the chord of each step.
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


def tube_pieces(plan: Plan) -> list[Piece]:
    """Return the tubes of a plan as pieces, as their arcs say."""
    tube = plan.tube
    pieces, turned = [], -tube.rotation_rad
    for length, direction, curvature, _radius in tube.shape.arcs.tolist():
        if length > TINY_MM:
            pieces.append(Piece(length_mm=length, roll_rad=direction - turned, curvature_per_mm=curvature))
            turned = direction
    return pieces


def tube_tip(plan: Plan, curve: Curve) -> Float:
    """Return the frame that a plan has to state where its tubes end, from the end of their curve."""
    directions = [float(arc[1]) for arc in plan.tube.shape.arcs if arc[0] > TINY_MM]
    return np.asarray(curve.end @ turn(-directions[-1])) if directions else curve.end


def radius_at(plan: Plan, arc_mm: Float) -> Float:
    """Return the radius of the outermost tube at places `(n,)` beyond the scope tip, its own end included."""
    radius = np.zeros(len(arc_mm))
    inserted = plan.tube.insertions_mm(plan.system.tubes)
    for (_name, tube), end_mm in reversed(list(zip(plan.system.tubes.named, inserted, strict=True))):
        radius = np.where((arc_mm <= end_mm) | (radius == 0.0), 0.5 * tube.outer_diameter_mm, radius)
    return radius


def distance_to_polyline(points: Float, line: Float) -> Float:
    """Return the `(n,)` distances from points `(n, d)` to a polyline `(m, d)`, m >= 2."""
    start, step = line[:-1], np.diff(line, axis=0)
    length = np.maximum((step**2).sum(axis=1), 1e-300)
    away = points[:, None, :] - start
    along = np.clip((away * step).sum(axis=2) / length, 0.0, 1.0)
    return np.asarray(np.sqrt(((away - along[:, :, None] * step) ** 2).sum(axis=2).min(axis=1)))
