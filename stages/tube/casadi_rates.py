"""The differential equations of concentric tubes [Rucker2010] in the symbols of CasADi.

The state is the position and the quaternion of the innermost tube's frame, its angle, the angles of the
others relative to it, and the torsional moments in N mm.
"""

import math
from collections.abc import Sequence
from typing import Any

import casadi
import numpy as np

from anatomy.base.typed import Float
from stages.tube.device import Tube

POSITION, ROTATION, FIRST_ANGLE = slice(0, 3), slice(3, 7), 7
"""Places in the state."""

SAME_MM = 1e-9
"""Rounding of the lengths of a tube's pieces."""


def landmarks_mm(tube: Tube) -> list[float]:
    """Return the ascending arc lengths from the base at which precurvature or slots change, and the end."""
    ends = {end for bend in tube.bends for end in (bend.from_mm, bend.to_mm)}
    for segment in tube.slotted_segments:
        front = tube.length_mm - segment.from_tip_mm
        ends |= {front, front - segment.length_mm}
    return [*sorted(end for end in ends if SAME_MM < end < tube.length_mm - SAME_MM), tube.length_mm]


def _middle(marks: Sequence[float], index: int) -> float:
    """Return the middle of the part of a tube that ends at a landmark; none is beyond the last."""
    if index >= len(marks):
        return math.inf
    return 0.5 * ((marks[index - 1] if index > 0 else 0.0) + marks[index])


def rest_curvature_per_mm(tube: Tube, marks: Sequence[float], index: int) -> Any:
    """Return the precurvature vector (2,) of the part of a tube that ends at a landmark."""
    middle = _middle(marks, index)
    for start, end, curvature, direction in tube.bends:
        if start <= middle < end:
            return curvature * np.array([np.cos(direction), np.sin(direction)])
    return np.zeros(2)


def bending_n_mm2(tube: Tube, marks: Sequence[float], index: int) -> float:
    """Return the bending stiffness of the part of a tube that ends at a landmark, 0 beyond its end."""
    from_tip = tube.length_mm - _middle(marks, index)
    if from_tip < 0.0:
        return 0.0
    shares = (
        segment.stiffness_factor
        for segment in tube.slotted_segments
        if 0.0 <= from_tip - segment.from_tip_mm < segment.length_mm
    )
    area = math.pi / 64.0 * (tube.outer_diameter_mm**4 - tube.inner_diameter_mm**4)
    return 1e3 * tube.youngs_modulus_gpa * area * next(shares, 1.0)


def state_rates(state: Any, bending: Sequence[float], torsion: Sequence[float], rest: Sequence[Float]) -> Any:
    """Return the derivative of the state by the arc length [Rucker2010]."""
    n = len(bending)
    relative = [casadi.SX(0), *casadi.vertsplit(state[FIRST_ANGLE + 1 : FIRST_ANGLE + n])][:n]
    rates = [state[FIRST_ANGLE + n + i] / torsion[i] for i in range(n)]
    turns = [about_z(angle)[:2, :2] for angle in relative]
    shared = sum(bending[i] * turns[i] @ rest[i] for i in range(n)) / sum(bending)
    owns = [turn.T @ shared for turn in turns]
    moments = [bending[i] * (own[0] * rest[i][1] - own[1] * rest[i][0]) for i, own in enumerate(owns)]
    spin = spin_of(state[ROTATION], shared[0], shared[1], rates[0])
    others = [rates[i] - rates[0] for i in range(1, n)]
    return casadi.vertcat(forward_of(state[ROTATION]), spin, rates[0], *others, *moments)


def forward_of(quaternion: Any) -> Any:
    """Return the forward direction of a quaternion (w, x, y, z)."""
    w, x, y, z = casadi.vertsplit(quaternion)
    return casadi.vertcat(2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z)


def spin_of(quaternion: Any, a: Any, b: Any, c: Any = 0) -> Any:
    """Return the derivative of a quaternion by a curvature (a, b) and a torsion c in its own frame."""
    w, x, y, z = casadi.vertsplit(quaternion)
    turned = -x * a - y * b - z * c, w * a + y * c - z * b, w * b + z * a - x * c, w * c + x * b - y * a
    return 0.5 * casadi.vertcat(*turned)


def runge_kutta(rate: Any, state: Any, length: Any, *more: Any) -> Any:
    """Return the state after a step of the method of order 4."""
    first = rate(state, *more)
    second = rate(state + 0.5 * length * first, *more)
    third = rate(state + 0.5 * length * second, *more)
    fourth = rate(state + length * third, *more)
    return state + length / 6.0 * (first + 2.0 * second + 2.0 * third + fourth)


def about_z(angle: Any) -> Any:
    """Return the rotation about z by an angle."""
    c, s = casadi.cos(angle), casadi.sin(angle)
    return casadi.vertcat(casadi.horzcat(c, -s, 0), casadi.horzcat(s, c, 0), casadi.horzcat(0, 0, 1))


def rotation_of(quaternion: Any) -> Any:
    """Return the rotation of a quaternion (w, x, y, z) of any length."""
    unit = quaternion / casadi.norm_2(quaternion)
    cross = casadi.skew(unit[1:])
    return casadi.MX.eye(3) + 2 * unit[0] * cross + 2 * cross @ cross


def determinant_function(n: int) -> Any:
    """Return the function: matrix (n, n) -> determinant, in plain arithmetic."""
    matrix = casadi.SX.sym("matrix", n, n)
    return casadi.Function("determinant", [matrix], [casadi.det(matrix)])
