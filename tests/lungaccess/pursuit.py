"""A motion of a bronchoscope made by pursuit: the section always bends so that its tip is on a line."""

from __future__ import annotations

import numpy as np

from anatomy.poses import pose
from stages.scope.motion import ScopeMotion
from tests.lungaccess.rigid import arc, turned

STEP_MM = 1.0


def place_on(line: np.ndarray, along_mm: float) -> np.ndarray:
    """The point of a polyline at a length."""
    at = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1)))
    return np.array([np.interp(along_mm, at, line[:, axis]) for axis in range(3)])


def pursued(
    line: np.ndarray, stop_mm: float, section_mm: float, sideways: np.ndarray | None = None
) -> ScopeMotion:
    """The motion whose tip follows a polyline `(N, 3)` up to a length, by steps of 1 mm and turns between."""
    entry = np.array(pose(line[0], line[1] - line[0], sideways))
    base, twist, states = entry, 0.0, [(0.0, 0.0, 0.0)]
    for n in range(int((stop_mm - section_mm) / STEP_MM) + 1):
        x, y, z = base[:3, :3].T @ (place_on(line, n * STEP_MM + section_mm) - base[:3, 3])
        aside = np.hypot(x, y)
        # The circle through the point, tangent to the shaft.
        curvature = 2.0 * aside / (aside**2 + z**2)
        if aside > 1e-6:
            # The way of the twist that is nearer, the bend down if need be.
            away = (np.arctan2(y, x) - twist + 0.5 * np.pi) % (2.0 * np.pi) - 0.5 * np.pi
            down = away > 0.5 * np.pi
            twist += away - np.pi * down
            curvature *= -1.0 if down else 1.0
        states += [(n * STEP_MM, twist, curvature * section_mm)]
        states += [((n + 1) * STEP_MM, twist, curvature * section_mm)]
        base = turned(turned(base, twist) @ arc(STEP_MM, curvature), -twist)
    return ScopeMotion(lps_from_entry=entry, states=np.array(states[:-1]), bending_length_mm=section_mm)
