"""The arcs from one start to the points of a ball: where an obstacle rules out all of them together.

docs/theory/proofs.md derives how far apart such arcs may be.
"""

import math

import numpy as np

from anatomy.kernels.compiling import inner_kernel, merged_kernel
from anatomy.kernels.field import UNITS_PER_MM, exact_distance, interpolate_squared
from stages.needle.kernels.proof import TINY

# A typed number: a kernel is compiled once more for every literal that it is called with.
_NOBODY = np.int64(-1)


@merged_kernel
def _is_blocked(obstacles, required, x, y, z):
    """Tell whether a point is nearer than `required` to an obstacle; exact distances only where in doubt."""
    total, spread = interpolate_squared(obstacles.clearance, obstacles.geometry, x, y, z)
    if total - spread >= required * required:
        return False
    # See `anatomy.kernels.field`: the true distance is at most this.
    if math.sqrt(total) + math.sqrt(spread) + 1.0 / UNITS_PER_MM < required:
        return True
    distance, _label = exact_distance(
        obstacles.labels, obstacles.geometry, x, y, z, obstacles.bits, _NOBODY, required
    )
    return distance < required


@merged_kernel
def _point_at_chord(start, aside, c):
    """Return the point of an arc that is `c` away from its start, for `aside` see `inverted_aside`."""
    wx, wy, wz = c * aside[0], c * aside[1], c * aside[2]
    ahead = math.sqrt(max(1.0 - wx * wx - wy * wy - wz * wz, 0.0))
    return (
        start[0] + c * (ahead * start[3] + wx),
        start[1] + c * (ahead * start[4] + wy),
        start[2] + c * (ahead * start[5] + wz),
    )


@inner_kernel
def inverted_aside(start, q):
    """Return the squared distance of a point and what tells the arc to it: half its curvature, sideways.

    Inversion about the start, `d -> d / |d|^2`, takes the circles that touch the start to straight lines
    along its tangent.  A line keeps its part across the tangent, which is returned (1/mm).
    """
    dx, dy, dz = q[0] - start[0], q[1] - start[1], q[2] - start[2]
    chord2 = dx * dx + dy * dy + dz * dz
    h = dx * start[3] + dy * start[4] + dz * start[5]
    share = 1.0 / max(chord2, TINY)
    return (chord2, (share * (dx - h * start[3]), share * (dy - h * start[4]), share * (dz - h * start[5])))


@merged_kernel
def _greatest_spread(aside, spread, c):
    """Return how far arcs from one start may be apart where they are `c` away from it; inf if not bounded.

    `aside` is that of one of the arcs, and that of the others differs from it by at most `spread`.
    """
    sine = c * (math.sqrt(aside[0] ** 2 + aside[1] ** 2 + aside[2] ** 2) + spread)
    # Lean of a chord beyond which arcs of a bundle are not looked at together.
    return c * c * spread / math.sqrt(1.0 - sine * sine) if sine < 0.9 else math.inf


@inner_kernel
def _is_blocked_at(obstacles, limits, start, aside, spread, c):
    """Tell whether all arcs of a bundle are blocked at the distance `c` from their start."""
    required = limits.required_mm
    if spread > 0.0:
        required -= _greatest_spread(aside, spread, c)
    if required <= 0.0:
        return False
    x, y, z = _point_at_chord(start, aside, c)
    return _is_blocked(obstacles, required, x, y, z)


@inner_kernel
def _spread(chord, radius):
    """Return how much `inverted_aside` may differ for points within `radius` of one that is `chord` away.

    Inversion divides distances by the product of the distances from the start.
    """
    return radius / (chord * (chord - radius)) if chord > radius else math.inf


@inner_kernel
def blocked_at(obstacles, limits, start, aside, spread, begin, end, hint):
    """Look for an obstacle at a few places of a bundle of arcs, first where one was met the last time.

    A place is its distance from the start, as is `hint`.  Looked at are places from `begin` to `end`; no arc
    is exempt there, since none is shorter than its chord.

    Returns:
        float: The place, -1 if none was met.
    """
    if hint >= begin and hint < end and _is_blocked_at(obstacles, limits, start, aside, spread, hint):
        return hint
    count = 1
    # Before their proof, arcs are looked at in places at most so far apart.
    while (end - begin) / count > 3.0:
        for m in range(count):
            c = begin + (end - begin) * (m + 0.5) / count
            if _is_blocked_at(obstacles, limits, start, aside, spread, c):
                return c
        count *= 2
    return -1.0


@merged_kernel
def is_blocked_bundle(obstacles, limits, start, q, radius, hints, entry):
    """Tell whether all arcs to the points within `radius` of `q` are blocked, as far as they are close."""
    chord2, aside = inverted_aside(start, q)
    chord = math.sqrt(chord2)
    spread = _spread(chord, radius)
    if spread == math.inf:
        return False
    # Arcs of a bundle are looked at together up to where they are about this share of the clearance apart.
    end = min(math.sqrt(0.7 * limits.required_mm / max(spread, TINY)), chord - radius)
    c = blocked_at(obstacles, limits, start, aside, spread, limits.exempt_mm, end, hints[entry])
    if c >= 0.0:
        hints[entry] = c
    return c >= 0.0
