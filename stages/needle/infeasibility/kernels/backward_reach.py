"""Where paths that lead to a target may come from: shells about the target, from the inside out.

Let a path bend to a radius of R or more, be no longer than half a circle of it, and begin D < 2R from the
target.  Each of its points lies between the two arcs of radius R through its ends.  So where it is r mm from
the target, its direction seen from there differs from that of its beginning by at most

    asin(D / 2R) - asin(r / 2R).

The directions in which paths may be on a shell are those of the shell before, grown by this angle, without
those that are blocked.

A direction is a point of the plane: its stereographic projection from the direction opposite to an axis.  Two
points |P| and |Q| from the middle and e from each other are 2 asin(e / sqrt((1 + |P|^2) (1 + |Q|^2))) apart.
"""

import math
from typing import NamedTuple

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from anatomy.kernels.field import distance_bound, exact_distance

SHELL_MM = 1.0
"""From shell to shell."""
UNITS_A_CELL = 2.0
"""Angles are stored in units of a cell's side in the plane by this number, rounded down."""
MOST_UNITS = 255
HALF_DIAGONAL = 0.7072
"""Half of a cell's diagonal, in its sides."""
SPARE = 1e-6
"""For rounding, rad and mm."""

# Typed numbers: a kernel is compiled once more for every literal that it is called with.
_NOBODY = np.int64(-1)


class BackwardReach(NamedTuple):
    """From which directions paths come to a target, on K shells.

    Args:
        frame ((4, 3) float64): Two axes and the middle direction, unit vectors across each other, and the
            target in LPS mm.
        cell: Side of a cell of the plane of directions.
        kappa: Greatest curvature, 1/mm.
        angles ((K, N, N) uint8): How far from the middle of a cell the nearest direction is from which a path
            may come, or less.
    """

    frame: np.ndarray
    cell: float
    kappa: float
    angles: np.ndarray


@inner_kernel
def _angle_of(distance, kappa):
    return math.asin(min(0.5 * kappa * distance, 1.0))


@inner_kernel
def _angle_between(e, near, far):
    """Return the angle (rad) between directions e apart in the plane, so far from the middle."""
    return 2.0 * math.asin(min(e / math.sqrt((1.0 + near * near) * (1.0 + far * far)), 1.0))


@inner_kernel
def _squares_along(row, count, squares, places, ends):
    """Replace `row` by the least of row[m] + (n - m)^2 over m; see Felzenszwalb and Huttenlocher."""
    last = -1
    for n in range(count):
        if row[n] == np.inf:
            continue
        begin = -np.inf
        while last >= 0:
            m = places[last]
            begin = ((row[n] + n * n) - (squares[last] + m * m)) / (2.0 * (n - m))
            if begin > ends[last]:
                break
            last -= 1
        if last < 0:
            begin = -np.inf
        last += 1
        places[last], squares[last], ends[last] = n, row[n], begin
    if last < 0:
        return
    at = 0
    for n in range(count):
        while at < last and ends[at + 1] < n:
            at += 1
        row[n] = squares[at] + (n - places[at]) ** 2


@merged_kernel
def _all_blocked(obstacles, required, around, x, y, z):
    """Tell whether every point within `around` of a point is nearer to an obstacle than required."""
    clearance, labels, geometry, bits = obstacles
    needed = required - around
    if needed <= 0.0 or distance_bound(clearance, geometry, x, y, z) >= needed:
        return False
    _distance, label = exact_distance(labels, geometry, x, y, z, bits, _NOBODY, needed)
    return label != 0


@kernel(nogil=True)
def fill_backward_reach(obstacles, required, reach):
    """Fill the angles of a `BackwardReach` of paths that keep `required` mm from `Obstacles`."""
    frame, cell, kappa, angles = reach
    shells, count, _ = angles.shape
    half = 0.5 * (count - 1)
    unit = cell / UNITS_A_CELL
    apart = np.zeros((count, count))
    squares = np.zeros((count, count))
    row, places, ends = np.zeros(count), np.zeros(count, dtype=np.int64), np.zeros(count)
    column = np.zeros(count)
    for k in range(shells):
        radius = (k + 1) * SHELL_MM
        drift = _angle_of(radius, kappa) - _angle_of(radius - SHELL_MM, kappa) + SPARE
        for i in range(count):
            u = (i - half) * cell
            for j in range(count):
                v = (j - half) * cell
                size2 = u * u + v * v
                inner = max(math.sqrt(size2) - cell, 0.0)
                corner = _angle_between(HALF_DIAGONAL * cell, inner, inner)
                squares[i, j] = 0.0
                if i == 0 or j == 0 or i == count - 1 or j == count - 1:
                    continue  # What is beyond the window may all be passed.
                apart[i, j] = max(apart[i, j] - drift, 0.0)
                if apart[i, j] > corner:
                    squares[i, j] = np.inf
                    continue
                a, b, c = 2.0 * u / (1.0 + size2), 2.0 * v / (1.0 + size2), (1.0 - size2) / (1.0 + size2)
                x = frame[3, 0] + radius * (a * frame[0, 0] + b * frame[1, 0] + c * frame[2, 0])
                y = frame[3, 1] + radius * (a * frame[0, 1] + b * frame[1, 1] + c * frame[2, 1])
                z = frame[3, 2] + radius * (a * frame[0, 2] + b * frame[1, 2] + c * frame[2, 2])
                if _all_blocked(obstacles, required, radius * corner + SPARE, x, y, z):
                    squares[i, j] = np.inf
        for i in range(count):
            _squares_along(squares[i], count, row, places, ends)
        for j in range(count):
            for i in range(count):
                column[i] = squares[i, j]
            _squares_along(column, count, row, places, ends)
            for i in range(count):
                squares[i, j] = column[i]
        for i in range(count):
            u = (i - half) * cell
            for j in range(count):
                v = (j - half) * cell
                size = math.sqrt(u * u + v * v)
                e = (math.sqrt(squares[i, j]) - HALF_DIAGONAL) * cell
                if e > 0.0:
                    apart[i, j] = max(apart[i, j], _angle_between(e, size, size + e) - SPARE)
                angles[k, i, j] = min(int(max(apart[i, j], 0.0) / unit), MOST_UNITS)


@inner_kernel
def never_from(reach, x, y, z, around, free):
    """Tell whether no path from within `around` mm of a point leads to the target.

    The first `free` mm of a path may be anywhere.  A path from r mm away is on the shells below r - free at
    places that may be passed, and there its direction from the target is known from that of its beginning.
    """
    frame, cell, kappa, angles = reach
    shells, count, _ = angles.shape
    dx, dy, dz = x - frame[3, 0], y - frame[3, 1], z - frame[3, 2]
    r = math.sqrt(dx * dx + dy * dy + dz * dz)
    first = int((r - around - free - SPARE) / SHELL_MM)
    if shells == 0 or r - around - free <= SHELL_MM or first > shells:
        return False
    ahead = (dx * frame[2, 0] + dy * frame[2, 1] + dz * frame[2, 2]) / r
    if 0.5 * kappa * (r + around) > 1.0 - SPARE or ahead < -0.9:
        return False
    u = (dx * frame[0, 0] + dy * frame[0, 1] + dz * frame[0, 2]) / (r * (1.0 + ahead))
    v = (dx * frame[1, 0] + dy * frame[1, 1] + dz * frame[1, 2]) / (r * (1.0 + ahead))
    half = 0.5 * (count - 1)
    i, j = int(u / cell + half + 0.5), int(v / cell + half + 0.5)
    if not (0 < i < count - 1 and 0 < j < count - 1):
        return False
    inner = max(math.sqrt(u * u + v * v) - cell, 0.0)
    off = _angle_between(math.hypot(u - (i - half) * cell, v - (j - half) * cell), inner, inner)
    wide = math.asin(min(around / r, 1.0)) + off + SPARE
    unit = cell / UNITS_A_CELL
    last = min(int((r - free) / SHELL_MM), shells)
    for m in range(first, last + 1):
        farthest = r + around if m == last else (m + 1) * SHELL_MM + free
        drift = _angle_of(farthest, kappa) - _angle_of(m * SHELL_MM, kappa)
        if angles[m - 1, i, j] * unit <= wide + drift:
            return False
    return True


@merged_kernel
def _in_both(h, one, other):
    """Return the ball that holds where two balls, h apart, meet: middle as share of the way, radius; below 0:
    none."""
    if h > one + other:
        return 0.0, -1.0
    if h < SPARE:
        return (0.0, one) if one <= other else (1.0, other)
    along = 0.5 * (h + (one * one - other * other) / h)
    if along <= 0.0:
        return 0.0, one
    if along >= h:
        return 1.0, other
    return along / h, math.sqrt(max(one * one - along * along, 0.0)) + SPARE


@inner_kernel
def never_along(reach, pose, away, angle, free):
    """Tell whether no path leads to the target that starts near a pose.

    Starts are within `away` mm and their directions within `angle` (rad) of it.  The first `free` mm of a
    path may be anywhere.  After L mm a path is within L^2 / 2R of the tangent at its start, and seen from
    there at most asin(D / 2R) - L / 2R beside the straight line to the target, D mm long.
    """
    frame, _cell, kappa, angles = reach
    if len(angles) == 0:
        return False
    x, y, z = frame[3, 0] - pose[0], frame[3, 1] - pose[1], frame[3, 2] - pose[2]
    far = math.sqrt(x * x + y * y + z * z)
    if 0.5 * kappa * (far + away) > 1.0 - SPARE or far - away <= free:
        return False
    if never_from(reach, pose[0], pose[1], pose[2], away, free):
        return True
    x, y, z = x / far, y / far, z / far
    apart = math.sqrt((x - pose[3]) ** 2 + (y - pose[4]) ** 2 + (z - pose[5]) ** 2)
    widest = _angle_of(far + away, kappa)
    length = free
    while True:
        length += SHELL_MM
        if length >= far - away - SHELL_MM:
            return False
        by_tangent = length * (angle + 0.5 * kappa * length)
        turn = max(widest - 0.5 * kappa * length, 0.0)
        by_line = 2.0 * length * math.sin(0.5 * turn) + length * (kappa * length) ** 2 / 24.0
        by_line += length * away / (far - away)
        share, radius = _in_both(length * apart, by_tangent, by_line)
        if radius < 0.0:
            return True
        around = radius + away
        u, v, w = (
            pose[3] + share * (x - pose[3]),
            pose[4] + share * (y - pose[4]),
            pose[5] + share * (z - pose[5]),
        )
        if never_from(reach, pose[0] + length * u, pose[1] + length * v, pose[2] + length * w, around, 0.0):
            return True
        length += 0.5 * around
