"""Poses `lps_from_tip`: 4x4 rigid frames whose +z axis points the way the device moves."""

import math

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import FrameError
from anatomy.base.typed import Float
from anatomy.grid import read_only

ANTERIOR = np.array([0.0, -1.0, 0.0])
SUPERIOR = np.array([0.0, 0.0, 1.0])


def pose(point_lps: ArrayLike, forward: ArrayLike, sideways: ArrayLike | None = None) -> Float:
    """Return the read-only frame `(4, 4)` at a point `(3,)` LPS mm, +z along `forward` of any length.

    +x is the part of `sideways` perpendicular to `forward`; by default anterior, or superior where the device
    points along the anterior axis.  Raises FrameError if a direction has no length or both are parallel.
    """
    z = _unit(np.asarray(forward, dtype=np.float64), "forward")
    if sideways is None:
        # Within 26 degrees of the anterior axis the superior one is taken, so that the cross product is never
        # small.
        sideways = ANTERIOR if abs(float(z @ ANTERIOR)) < 0.9 else SUPERIOR
    x = np.asarray(sideways, dtype=np.float64)
    x = _unit(x - (x @ z) * z, "sideways")
    frame = np.eye(4)
    frame[:3, 0] = x
    frame[:3, 1] = np.cross(z, x)
    frame[:3, 2] = z
    frame[:3, 3] = point_lps
    return read_only(frame)


def _unit(vector: Float, name: str) -> Float:
    length = float(np.linalg.norm(vector))
    # A shorter vector has no direction in double precision.
    if not length > 1e-9:
        raise FrameError(
            f"A pose has no {name} direction: {vector.tolist()}",
            expected="two directions with a length, not parallel to each other",
        )
    return vector / length


def unit(vector: Float) -> Float:
    """Scale vectors `(..., 3)` to length one (zero stays zero)."""
    return np.asarray(vector / np.maximum(np.linalg.norm(vector, axis=-1, keepdims=True), 1e-12))


def spread_directions(count: int) -> Float:
    """Return unit vectors `(count, 3)`, evenly spread over the sphere on a golden spiral about +z."""
    n = np.arange(count) + 0.5
    z, angle = 1.0 - 2.0 * n / count, np.pi * (1.0 + np.sqrt(5.0)) * n
    aside = np.sqrt(1.0 - z * z)
    return np.stack([aside * np.cos(angle), aside * np.sin(angle), z], axis=1)


def bending_directions(frame: Float, rotations_rad: ArrayLike) -> Float:
    """Return the unit vectors `(T, 3)` at angles about +z, counted from +x of a frame."""
    angles = np.atleast_1d(np.asarray(rotations_rad, dtype=np.float64))[:, None]
    return np.ascontiguousarray(np.cos(angles) * frame[:3, 0] + np.sin(angles) * frame[:3, 1])


def roll_towards(frame: Float, direction: ArrayLike) -> float:
    """Return the angle in [-pi, pi] about +z from +x of a frame to a direction."""
    d = np.asarray(direction, dtype=np.float64)
    return math.atan2(float(d @ frame[:3, 1]), float(d @ frame[:3, 0]))


def poses_on_arc(frame: Float, roll_rad: float, curvature_per_mm: ArrayLike, lengths_mm: ArrayLike) -> Float:
    """Return frames `(..., N, 4, 4)` at lengths `(N,)` along arcs, exact where the curvature goes to zero.

    An arc starts at a frame `(..., 4, 4)`, along its +z, and bends by its curvature `(...)` towards the +x of
    the frame rolled about its +z by `roll_rad`; the frames on it are rolled so.
    """
    s = np.asarray(lengths_mm, dtype=np.float64)
    half = 0.5 * np.asarray(curvature_per_mm)[..., None] * s
    x, y, forward, origin = (frame[..., None, :3, axis] for axis in range(4))
    ahead = s * np.sinc(2.0 * half / np.pi)
    aside = s * np.sin(half) * np.sinc(half / np.pi)
    cosine, sine = np.cos(2.0 * half)[..., None], np.sin(2.0 * half)[..., None]
    bend = math.cos(roll_rad) * x + math.sin(roll_rad) * y
    poses = np.zeros((*half.shape, 4, 4))
    poses[..., :3, 0] = cosine * bend - sine * forward
    poses[..., :3, 1] = math.cos(roll_rad) * y - math.sin(roll_rad) * x
    poses[..., :3, 2] = sine * bend + cosine * forward
    poses[..., :3, 3] = origin + ahead[..., None] * forward + aside[..., None] * bend
    poses[..., 3, 3] = 1.0
    return poses


def poses_on_pieces(frame: Float, pieces: Float, step_mm: float) -> tuple[Float, Float]:
    """Return poses `(N, 4, 4)` at the ends of arcs and between them, and their arc lengths `(N,)`.

    The first arc starts at `frame`.  `pieces` `(P, 3)` are length in mm, roll before it in rad, which is kept
    for the next, and curvature in 1/mm of each; two poses are at most `step_mm` apart.
    """
    poses, lengths = [np.asarray(frame)[None]], [np.zeros(1)]
    for length, roll, curvature in pieces:
        at = length * np.linspace(0.0, 1.0, max(1, math.ceil(length / step_mm)) + 1)[1:]
        poses.append(poses_on_arc(poses[-1][-1], roll, curvature, at))
        lengths.append(lengths[-1][-1] + at)
    return np.concatenate(poses), np.concatenate(lengths)
