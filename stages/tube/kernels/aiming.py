"""Rotation and insertions with which the tip of the tubes comes to a point.

The common rotation turns the plane of the tubes to the point; in that plane the two insertions bring the tip
to the point's distance beside and ahead of the scope tip.  `tubes` is the array of `planar`.
"""

from __future__ import annotations

import math

import numba

from stages.tube.kernels.planar import MAX_EXTENSION, planar_point

ITERATIONS = 30
"""Newton's method doubles the digits in each; from a start a few millimetres away it needs about five."""
DIFFERENCE_MM = 1e-6
"""Step of the derivatives: their error of about 1e-8 costs no more than an iteration."""
CLOSE_MM = 1e-9
"""A tip that is so near is at the point: the positions of a plan are stated to rounding."""
LONGEST_STEP_MM = 8.0
"""Longer steps are shortened to this: about the distance between two bends of a usual tube."""


@numba.njit(cache=True)
def aim(tubes, base, target, outer, inner):
    """Return rotation, both insertions and the distance in mm by which the tip then misses a point.

    Newton's method from given insertions, which stay in order and within the tubes' reach.

    Parameters
    ----------
    tubes : (N_TUBES,) float64
    base : (9,) float64
        Scope tip: point, tangent, and +x, from which the rotation counts.
    target : tuple of 3 floats
    outer, inner : float
        Insertions to begin with, mm.
    """
    x, y, z = target[0] - base[0], target[1] - base[1], target[2] - base[2]
    ahead = x * base[3] + y * base[4] + z * base[5]
    along = x * base[6] + y * base[7] + z * base[8]
    across = (
        x * (base[4] * base[8] - base[5] * base[7])
        + y * (base[5] * base[6] - base[3] * base[8])
        + z * (base[3] * base[7] - base[4] * base[6])
    )
    aside = math.hypot(along, across)
    rotation = math.atan2(across, along) % (2.0 * math.pi)
    most = tubes[MAX_EXTENSION]
    here = planar_point(tubes, outer, inner, inner)
    miss = math.hypot(aside - here[0], ahead - here[1])
    for _ in range(ITERATIONS):
        if miss <= CLOSE_MM:
            break
        step = DIFFERENCE_MM if outer + DIFFERENCE_MM <= inner else -DIFFERENCE_MM
        by_outer = planar_point(tubes, outer + step, inner, inner)
        by_inner = planar_point(tubes, outer, inner + DIFFERENCE_MM, inner + DIFFERENCE_MM)
        a, c = (by_outer[0] - here[0]) / step, (by_outer[1] - here[1]) / step
        b, d = (by_inner[0] - here[0]) / DIFFERENCE_MM, (by_inner[1] - here[1]) / DIFFERENCE_MM
        determinant = a * d - b * c
        if determinant == 0.0:
            break
        u, v = aside - here[0], ahead - here[1]
        change_outer = (d * u - b * v) / determinant
        change_inner = (a * v - c * u) / determinant
        longest = max(abs(change_outer), abs(change_inner))
        share = min(1.0, LONGEST_STEP_MM / longest) if longest > 0.0 else 1.0
        inner = min(max(inner + share * change_inner, 0.0), most)
        outer = min(max(outer + share * change_outer, 0.0), inner)
        here = planar_point(tubes, outer, inner, inner)
        miss = math.hypot(aside - here[0], ahead - here[1])
    return rotation, outer, inner, miss
