"""Where a tip most likely is: what was expected and what was measured, weighed by their errors [Kalman1960].

A measurement no better than what is known without it would otherwise be followed as if it were the truth.
"""

from __future__ import annotations

import math

import numpy as np

from anatomy.base.typed import Float
from lungaccess.planning.procedure.residuals import Residuals
from stages.needle import tilt

LEAST = 1e-9
"""A measurement is taken to be no better than this, mm or rad, so that exact ones can be weighed as well."""


def fused_share(expected: float, measured: float) -> float:
    """Return the share of a measurement that is believed."""
    return expected**2 / max(expected**2 + measured**2, LEAST**2)


def scope_moves(expected: Float, position_mm: float, direction_rad: float) -> Float:
    """Return what one standard deviation of each error moves the pose of a scope's tip by, see `fused`."""
    moves = np.zeros((6, 5))
    moves[:3, :3] = position_mm * np.eye(3)
    moves[3:, 3:] = direction_rad * expected[:3, :2]
    return moves


def tip_moves(lps_from_scope_tip: Float, expected: Float, left: Residuals, bend_per_mm: float) -> Float:
    """Return what one standard deviation of each error moves the pose of the tubes' tip by, see `fused`.

    Parameters
    ----------
    bend_per_mm : float
        Curvature with which the tubes bend on as they go farther out.
    """
    axes, ahead = lps_from_scope_tip[:3, :3].T, expected[:3, 2]
    arm = expected[:3, 3] - lps_from_scope_tip[:3, 3]
    about = np.cross(axes[2], ahead)
    about = about / max(float(np.linalg.norm(about)), LEAST)
    sizes = left.scope_rad, left.scope_rad, left.rotation_rad
    turned = [
        size * np.concatenate([np.cross(axis, arm), axis]) for size, axis in zip(sizes, axes, strict=True)
    ]
    inserted = left.insertion_mm * np.concatenate([ahead, bend_per_mm * about])
    shifted = np.concatenate([left.scope_mm * np.eye(3), np.zeros((3, 3))])
    return np.column_stack([shifted, *turned, inserted])


def fused(expected: Float, errors: Float, measured: Float, position_mm: float, direction_rad: float) -> Float:
    """Return the most likely pose of a tip, with the roll of the measured one.

    Parameters
    ----------
    expected, measured : (4, 4) float64
    errors : (6, E) float64
        What one standard deviation of each of E errors moves the expected pose by: mm, and rotation vector.
    position_mm, direction_rad : float
        Standard deviations of the measurement, along each axis and about each of two axes.
    """
    if position_mm <= LEAST and direction_rad <= LEAST:
        return measured
    axes = expected[:3, :2].T
    seen = np.zeros((5, 6))
    seen[:3, :3], seen[3:, 3:] = np.eye(3), axes
    turned = axes @ _turn(expected[:3, 2], measured[:3, 2])
    gap = np.concatenate([measured[:3, 3] - expected[:3, 3], turned])
    moves = seen @ errors
    noise = np.array([max(position_mm, LEAST)] * 3 + [max(direction_rad, LEAST)] * 2) ** 2
    step = errors @ moves.T @ np.linalg.solve(moves @ moves.T + np.diag(noise), gap)
    towards = _turned(expected[:3, 2], step[3:])
    x, y, z = (measured[:3, :3].T @ towards).tolist()
    likely = measured @ tilt(math.atan2(math.hypot(x, y), z), math.atan2(y, x))
    likely[:3, 3] = expected[:3, 3] + step[:3]
    return np.asarray(likely)


def _turn(one: Float, other: Float) -> Float:
    """Return the rotation vector of the shortest turn from one unit vector to another."""
    across = np.cross(one, other)
    size = float(np.linalg.norm(across))
    return np.asarray(across * (math.atan2(size, float(one @ other)) / size if size > 0.0 else 1.0))


def _turned(vector: Float, turn: Float) -> Float:
    """Return a vector turned by a rotation vector across it."""
    angle = float(np.linalg.norm(turn))
    return np.asarray(math.cos(angle) * vector + np.cross(turn, vector) * np.sinc(angle / math.pi))
