"""Samples of scope, tube and needle for drawing; nothing here decides about safety."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from anatomy.typed import Float

if TYPE_CHECKING:
    from lungaccess.plans.plan import NeedlePath, Plan, TubeDeployment
    from stages.tube import ConcentricTubes


STEP_MM = 0.25


def arc_step(curvature_per_mm: float, length_mm: float, direction_rad: float = 0.0) -> Float:
    """Return the pose at the end of an arc that starts along +z, `(4, 4)`.

    Parameters
    ----------
    curvature_per_mm, length_mm : float
    direction_rad : float
        The arc bends towards local `x cos + y sin` of this angle; the frame is not rolled.
    """
    angle = curvature_per_mm * length_mm
    bend_x, bend_y = np.cos(direction_rad), np.sin(direction_rad)
    # With sinc, both stay exact where the curvature goes to zero.
    sideways = length_mm * (angle / 2) * np.sinc(angle / (2 * np.pi)) ** 2
    forward = length_mm * np.sinc(angle / np.pi)
    roll = np.array([[bend_x, -bend_y, 0.0], [bend_y, bend_x, 0.0], [0.0, 0.0, 1.0]])
    turn = np.array(
        [[np.cos(angle), 0.0, np.sin(angle)], [0.0, 1.0, 0.0], [-np.sin(angle), 0.0, np.cos(angle)]]
    )
    pose = np.eye(4)
    pose[:3, :3] = roll @ turn @ roll.T
    pose[:3, 3] = sideways * bend_x, sideways * bend_y, forward
    return pose


def tube_pieces(deployment: TubeDeployment, tubes: ConcentricTubes) -> list[tuple[float, float]]:
    """Return (length in mm, curvature per mm) of the tube from the scope tip on.

    Where both tubes overlap, their bending stiffnesses share the precurvature of the inner one.
    """
    outer_end, inner_end = deployment.outer_insertion_mm, deployment.inner_insertion_mm
    curved_from = max(0.0, inner_end - tubes.inner.curved_length_mm)
    outer_kb, inner_kb = tubes.outer.bending_stiffness_n_mm2, tubes.inner.bending_stiffness_n_mm2
    free = tubes.inner.precurvature_per_mm
    shared = free * inner_kb / (inner_kb + outer_kb)
    bounds = [
        (curved_from, 0.0),
        (max(outer_end, curved_from) - curved_from, shared),
        (inner_end - max(outer_end, curved_from), free),
    ]
    return [(length, curvature) for length, curvature in bounds if length > 1e-9]


def tube_centreline(plan: Plan) -> tuple[Float, Float]:
    """Return points `(N, 3)`, LPS mm, and arc length `(N,)`, mm, of the tube beyond the scope tip."""
    pose = np.asarray(plan.scope.lps_from_scope_tip, dtype=np.float64)
    direction = plan.tube.rotation_rad
    points, arcs, done = [pose[:3, 3][None]], [np.zeros(1)], 0.0
    for length, curvature in tube_pieces(plan.tube, plan.system.tubes):
        samples = np.linspace(0.0, length, max(2, int(np.ceil(length / STEP_MM)) + 1))[1:]
        points.append(_arc_points(pose, curvature, samples, direction))
        arcs.append(done + samples)
        pose = pose @ arc_step(curvature, length, direction)
        done += length
    return np.concatenate(points), np.concatenate(arcs)


def needle_polyline(needle: NeedlePath) -> tuple[Float, Float]:
    """Return points `(N, 3)`, LPS mm, and arc length `(N,)`, mm, of the needle from the tube tip on."""
    pose = np.asarray(needle.lps_from_start, dtype=np.float64)
    points, arcs, done = [pose[:3, 3][None]], [np.zeros(1)], 0.0
    for arc in needle.arcs:
        pose = pose @ _roll(arc.roll_rad)
        samples = np.linspace(0.0, arc.length_mm, max(2, int(np.ceil(arc.length_mm / STEP_MM)) + 1))[1:]
        points.append(_arc_points(pose, arc.curvature_per_mm, samples, 0.0))
        arcs.append(done + samples)
        pose = pose @ arc_step(arc.curvature_per_mm, arc.length_mm)
        done += arc.length_mm
    return np.concatenate(points), np.concatenate(arcs)


def _arc_points(pose: Float, curvature: float, lengths: Float, direction: float) -> Float:
    local = np.array([arc_step(curvature, float(s), direction)[:3, 3] for s in lengths]).reshape(-1, 3)
    return np.asarray(local @ pose[:3, :3].T + pose[:3, 3])


def _roll(angle_rad: float) -> Float:
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle_rad), -np.sin(angle_rad)], [np.sin(angle_rad), np.cos(angle_rad)]]
    return pose
