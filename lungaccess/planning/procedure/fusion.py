"""Where tips most likely are: what was expected and what was measured, weighed by their errors [Kalman1960].

A measurement no better than what is known without it would otherwise be followed as if it were the truth.
All functions take many poses at once, `(..., 4, 4)`.
"""

import numpy as np

from anatomy.base.typed import Float
from lungaccess.planning.procedure.residuals import Residuals

LEAST = 1e-9
"""A measurement is taken to be no better than this, mm or rad, so that exact ones can be weighed as well."""


def fused_share(expected: Float, measured: float) -> Float:
    """Return the share of a measurement that is believed."""
    return np.asarray(expected**2 / np.maximum(expected**2 + measured**2, LEAST**2))


def scope_moves(expected: Float, position_mm: float, direction_rad: float) -> Float:
    """Return what one standard deviation of each error moves the pose of a scope's tip by, see `fused`."""
    moves = np.zeros((*expected.shape[:-2], 6, 5))
    moves[..., :3, :3] = position_mm * np.eye(3)
    moves[..., 3:, 3:] = direction_rad * expected[..., :3, :2]
    return moves


def tip_moves(lps_from_scope_tip: Float, expected: Float, left: Residuals, bend_per_mm: float) -> Float:
    """Return what one standard deviation of each error moves the pose of the tubes' tip by, see `fused`.

    Args:
        bend_per_mm: Curvature with which the tubes bend on as they go farther out.
    """
    axes, ahead = np.moveaxis(lps_from_scope_tip[..., :3, :3], -1, 0), expected[..., :3, 2]
    arm = expected[..., :3, 3] - lps_from_scope_tip[..., :3, 3]
    about = np.cross(axes[2], ahead)
    about = about / np.maximum(np.linalg.norm(about, axis=-1, keepdims=True), LEAST)
    moves = np.zeros((*expected.shape[:-2], 6, 7))
    moves[..., :3, :3] = left.scope_mm * np.eye(3)
    for column, size in enumerate((left.scope_rad, left.scope_rad, left.rotation_rad)):
        moves[..., :3, 3 + column] = size * np.cross(axes[column], arm)
        moves[..., 3:, 3 + column] = size * axes[column]
    moves[..., :3, 6] = left.insertion_mm * ahead
    moves[..., 3:, 6] = left.insertion_mm * bend_per_mm * about
    return moves


def fused(expected: Float, errors: Float, measured: Float, position_mm: float, direction_rad: float) -> Float:
    """Return the most likely poses of tips, with the roll of the measured ones.

    Args:
        expected, measured: (..., 4, 4) float64.
        errors ((..., 6, E) float64): What one standard deviation of each of E errors moves the expected pose
            by: mm, and rotation vector.
        position_mm, direction_rad: Standard deviations of the measurement, along each axis and about each of
            two axes.
    """
    if position_mm <= LEAST and direction_rad <= LEAST:
        return measured
    across = np.swapaxes(expected[..., :3, :2], -1, -2)
    seen = np.zeros((*expected.shape[:-2], 5, 6))
    seen[..., :3, :3], seen[..., 3:, 3:] = np.eye(3), across
    turned = (across @ _turn(expected[..., :3, 2], measured[..., :3, 2])[..., None])[..., 0]
    gap = np.concatenate([measured[..., :3, 3] - expected[..., :3, 3], turned], axis=-1)
    moves = seen @ errors
    noise = np.array([max(position_mm, LEAST)] * 3 + [max(direction_rad, LEAST)] * 2) ** 2
    weighed = np.linalg.solve(moves @ np.swapaxes(moves, -1, -2) + np.diag(noise), gap[..., None])
    step = (errors @ (np.swapaxes(moves, -1, -2) @ weighed))[..., 0]
    towards = _turned(expected[..., :3, 2], step[..., 3:])
    x, y, z = np.moveaxis((np.swapaxes(measured[..., :3, :3], -1, -2) @ towards[..., None])[..., 0], -1, 0)
    off = np.hypot(x, y)
    scale = np.arctan2(off, z) / np.maximum(off, LEAST)
    likely = tilted(measured, scale * x, scale * y)
    likely[..., :3, 3] = expected[..., :3, 3] + step[..., :3]
    return likely


def tilted(frames: Float, x: Float, y: Float) -> Float:
    """Return poses whose +z is tilted by angles in rad towards their own +x and +y."""
    turn = np.stack([-y, x, np.zeros_like(x)], axis=-1)
    out = np.array(frames)
    for column in range(3):
        local = np.zeros(3)
        local[column] = 1.0
        turned = _turned(np.broadcast_to(local, turn.shape), turn)
        out[..., :3, column] = (frames[..., :3, :3] @ turned[..., None])[..., 0]
    return out


def as_measured(frames: Float, position_mm: float, direction_deg: float, noise: Float) -> Float:
    """Return poses as they are measured with errors: `noise` has five standard normal numbers of each."""
    x, y = np.moveaxis(np.radians(direction_deg) * noise[..., :2], -1, 0)
    seen = tilted(frames, x, y)
    seen[..., :3, 3] += position_mm * noise[..., 2:5]
    return seen


def mean_pose(poses: Float) -> Float:
    """Return the mean place and direction of poses `(K, 4, 4)`, with the roll of the last."""
    last = poses[-1]
    x, y, z = last[:3, :3].T @ poses[:, :3, 2].mean(axis=0)
    off = np.hypot(x, y)
    scale = np.arctan2(off, z) / np.maximum(off, LEAST)
    mean = tilted(last, scale * x, scale * y)
    mean[:3, 3] = poses[:, :3, 3].mean(axis=0)
    return mean


def _turn(one: Float, other: Float) -> Float:
    """Return the rotation vectors of the shortest turns from unit vectors to others."""
    across = np.cross(one, other)
    size = np.linalg.norm(across, axis=-1)
    angle = np.arctan2(size, (one * other).sum(axis=-1))
    return np.asarray(across * np.divide(angle, size, out=np.ones_like(size), where=size > 0.0)[..., None])


def _turned(vector: Float, turn: Float) -> Float:
    """Return vectors turned by rotation vectors."""
    angle = np.linalg.norm(turn, axis=-1, keepdims=True)
    along = (turn * vector).sum(axis=-1, keepdims=True) * turn * 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
    return np.asarray(np.cos(angle) * vector + np.cross(turn, vector) * np.sinc(angle / np.pi) + along)
