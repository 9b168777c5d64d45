"""Needle paths as lengths and curvature vectors in a frame that does not roll, and back."""

import math

import numpy as np

from anatomy.base.typed import Float
from stages.needle import ArcPath, arc_transform, bend_direction

PROBE = 1e-6
"""Step of the central differences in scaled variables: their error is then some 1e-10."""
LENGTH_SCALE_MM = 5.0
"""What a mm of length counts against a share of the greatest curvature where an aim is corrected."""


def carried(frame: Float, length_mm: float, kx: float, ky: float) -> Float:
    """Return a frame (4, 4) carried along an arc without roll; `kx`, `ky` in 1/mm towards its x and y."""
    roll = math.atan2(ky, kx)
    back = arc_transform(0.0, -roll, 0.0)
    return np.asarray(frame @ arc_transform(length_mm, roll, math.hypot(kx, ky)) @ back)


def rows_of(path: ArcPath) -> Float:
    """Return length in mm and curvature towards x and y in 1/mm of each arc, `(A, 3)`."""
    carried_frame = path.lps_from_start
    rows = []
    for frame, (length, roll, curvature) in zip(path.frames(), path.arcs.tolist(), strict=False):
        towards = curvature * bend_direction(frame, roll)
        kx, ky = (float(towards @ carried_frame[:3, axis]) for axis in (0, 1))
        rows.append((length, kx, ky))
        carried_frame = carried(carried_frame, length, kx, ky)
    return np.array(rows)


def path_of(lps_from_start: Float, rows: Float) -> ArcPath:
    """Return the path of such rows."""
    angles = np.arctan2(rows[:, 2], rows[:, 1])
    rolls = np.diff(angles, prepend=0.0)
    rolls = np.remainder(rolls + math.pi, 2 * math.pi) - math.pi
    return ArcPath(
        lps_from_start=lps_from_start,
        arcs=np.stack([rows[:, 0], rolls, np.hypot(rows[:, 1], rows[:, 2])], axis=1),
    )


def split(rows: Float, arcs: int, first_mm: float) -> Float:
    """Halve the longest arcs until there are `arcs`; the first stays longer than `first_mm`."""
    out = [row.copy() for row in rows]
    while len(out) < arcs:
        spare = [row[0] - (first_mm if n == 0 else 0.0) for n, row in enumerate(out)]
        longest = int(np.argmax(spare))
        behind = out[longest].copy()
        behind[0] = 0.5 * spare[longest]
        out[longest][0] -= behind[0]
        out.insert(longest + 1, behind)
    return np.array(out)


def aimed(lps_from_start: Float, rows: Float, target: Float, max_curvature_per_mm: float) -> Float | None:
    """Return the rows changed as little as needed to end at the target; None if that fails.

    Gauss-Newton steps of least norm, lengths counted by LENGTH_SCALE_MM, curvatures as shares of the
    greatest.
    """
    scale = np.tile([LENGTH_SCALE_MM, max_curvature_per_mm, max_curvature_per_mm], len(rows))
    values = rows.ravel() / scale
    # Newton steps converge quadratically: what has not arrived after these does not.
    for _ in range(6):
        miss = target - _end(lps_from_start, values * scale)
        # Largest distance of an aimed path from the target: far below what a plan states, above rounding.
        if np.linalg.norm(miss) <= 1e-10:
            return np.asarray((values * scale).reshape(-1, 3), dtype=np.float64)
        jacobian = np.zeros((3, len(values)))
        for n in range(len(values)):
            step = np.zeros(len(values))
            step[n] = PROBE
            ends = [_end(lps_from_start, (values + sign * step) * scale) for sign in (1.0, -1.0)]
            jacobian[:, n] = (ends[0] - ends[1]) / (2.0 * PROBE)
        values = values + np.linalg.lstsq(jacobian, miss, rcond=None)[0]
    return None


def _end(lps_from_start: Float, numbers: Float) -> Float:
    frame = lps_from_start
    for length, kx, ky in numbers.reshape(-1, 3).tolist():
        frame = carried(frame, length, kx, ky)
    return np.asarray(frame[:3, 3])
