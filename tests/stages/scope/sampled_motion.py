"""A bronchoscope for tests, and the places of its body during a motion by code of its own."""

from __future__ import annotations

import math

import numpy as np

from stages.scope import Bronchoscope, ScopeMotion

SCOPE = Bronchoscope(
    name="thin", outer_diameter_mm=4.0, channel_diameter_mm=2.0, lumen_margin_mm=0.1,
    bend_up_deg=180.0, bend_down_deg=60.0, bending_length_mm=15.0, min_bending_radius_mm=8.0,
    min_shaft_radius_mm=10.0, bending_stiffness_n_mm2=1000.0,
)  # fmt: skip


def section(base: np.ndarray, twist: float, bend: float, lengths: np.ndarray) -> np.ndarray:
    """Points of a section by 200 short straight links, each turned by its share of the bend."""
    c, s = math.cos(twist), math.sin(twist)
    towards = c * base[:3, 0] + s * base[:3, 1]
    fine = np.linspace(0.0, lengths[-1], 201)
    angles = bend / SCOPE.bending_length_mm * 0.5 * (fine[1:] + fine[:-1])
    steps = np.cos(angles)[:, None] * base[:3, 2] + np.sin(angles)[:, None] * towards
    points = base[:3, 3] + np.vstack([np.zeros(3), np.cumsum(steps * np.diff(fine)[:, None], axis=0)])
    return np.stack([np.interp(lengths, fine, points[:, k]) for k in range(3)], axis=1)


def slid(base: np.ndarray, twist: float, bend: float, advance: float) -> np.ndarray:
    """The base moved along the section's arc, without roll: by the formula of Rodrigues."""
    out = base.copy()
    axis = -math.sin(twist) * base[:3, 0] + math.cos(twist) * base[:3, 1]
    k = np.cross(np.eye(3), axis)
    angle = bend / SCOPE.bending_length_mm * advance
    turn = np.eye(3) + math.sin(angle) * k + (1.0 - math.cos(angle)) * k @ k
    out[:3, :3] = turn @ base[:3, :3]
    out[:3, 3] = section(base, twist, bend, np.array([0.0, advance]))[-1]
    return out


def axis_places(motion: ScopeMotion, times: int = 7) -> np.ndarray:
    """Places `(N, 3)` of the body's axis at many times of a motion, the tip in the last state last."""
    base, out = np.array(motion.lps_from_entry), []
    length = SCOPE.bending_length_mm
    lengths = np.linspace(0.0, length, 31)
    for a, b in zip(motion.states[:-1], motion.states[1:], strict=True):
        assert not (b[0] > a[0] and (b[1:] != a[1:]).any()), "it slides or turns, never both"
        assert b[0] >= a[0]
        if b[0] > a[0]:
            ahead = np.linspace(0.0, length + b[0] - a[0], 2 + int(2 * (length + b[0] - a[0])))
            out.append(section(base, a[1], a[2], ahead))
            base = slid(base, a[1], a[2], b[0] - a[0])
        else:
            for t in np.linspace(0.0, 1.0, times):
                out.append(section(base, *(a[1:] + t * (b[1:] - a[1:])), lengths))
    last = section(base, motion.states[-1, 1], motion.states[-1, 2], lengths)
    return np.concatenate([*out, last])
