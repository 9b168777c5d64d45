"""The random directions and sizes that mutations draw."""

from __future__ import annotations

import numpy as np

from anatomy.base.typed import Float

Rng = np.random.Generator


def direction(rng: Rng) -> Float:
    """Return a random direction `(3,)`."""
    vector = rng.standard_normal(3)
    return np.asarray(vector / np.linalg.norm(vector))


def far(rng: Rng, low: float, high: float) -> float:
    """Return a random size; small ones are as likely as large ones."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def signed(rng: Rng, low: float, high: float) -> float:
    """Return a random size of either sign."""
    return far(rng, low, high) * float(rng.choice([-1.0, 1.0]))


def rotation(axis: Float, angle_rad: float) -> Float:
    """Return the `(3, 3)` rotation about an axis [Rodrigues]."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle_rad) * cross + (1.0 - np.cos(angle_rad)) * cross @ cross)
