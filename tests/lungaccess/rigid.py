"""Closed forms of arcs and turns, which share nothing with the library."""

from __future__ import annotations

import numpy as np


def turned(pose: np.ndarray, roll_rad: float) -> np.ndarray:
    """The pose after a turn about its own z."""
    c, s = np.cos(roll_rad), np.sin(roll_rad)
    return pose @ np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def arc(length_mm: float, k: float) -> np.ndarray:
    """Closed form of an arc that bends towards +x."""
    a = k * length_mm
    x, z = length_mm * np.sin(0.5 * a) * np.sinc(0.5 * a / np.pi), length_mm * np.sinc(a / np.pi)
    return np.array(
        [[np.cos(a), 0, np.sin(a), x], [0, 1, 0, 0], [-np.sin(a), 0, np.cos(a), z], [0, 0, 0, 1.0]]
    )
