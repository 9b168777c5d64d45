"""Joint values with which the tip of the tubes comes to a point: a common rotation, then the other joints."""

import math

import numpy as np

from anatomy.kernels.compiling import inner_kernel, merged_kernel
from stages.tube.kernels.one_shape import MAX_EXTENSION, in_order, near_shape, take_over, whole_way
from stages.tube.kernels.placing import tip_of_arcs
from stages.tube.kernels.shapes import TIP

ITERATIONS = 30
"""Newton's method doubles the digits in each; from a start a few millimetres away it needs about five."""
STEP_MM = 1e-4
"""Step of the derivatives, for shapes that are right to some 1e-9 mm."""
CLOSE_MM = 1e-8
"""A tip that ends so near is at the point."""
TURN_MM = 20.0
"""A turn of one tube against the others counts as so many mm of insertion a radian: about how far it moves a
tip that is some tens of millimetres out."""


@inner_kernel
def _seen_from(base, target):
    """Return how far a point is beside and ahead of a scope tip, and in which direction beside it."""
    x, y, z = target[0] - base[0], target[1] - base[1], target[2] - base[2]
    ahead = x * base[3] + y * base[4] + z * base[5]
    along = x * base[6] + y * base[7] + z * base[8]
    across = (
        x * (base[4] * base[8] - base[5] * base[7])
        + y * (base[5] * base[6] - base[3] * base[8])
        + z * (base[3] * base[7] - base[4] * base[6])
    )
    return math.hypot(along, across), ahead, math.atan2(across, along)


@inner_kernel
def _tip(shape):
    """Return how far the tip of a shape is beside and ahead of the scope tip, and in which direction."""
    base = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    pose = tip_of_arcs(base, (1.0, 0.0, 0.0), shape.arcs[: shape.number[0]])
    return math.hypot(pose[0], pose[1]), pose[2], math.atan2(pose[1], pose[0])


@inner_kernel
def _change(design, near, shape, want_aside, want_ahead, change):
    """Write the least change of the joints that makes up for a tip's distance; tell whether there is one."""
    n = design.radii.shape[0]
    here = near.result[TIP + 9 :]
    aside = math.hypot(here[0], here[1])
    if aside == 0.0:
        return False
    rates = np.zeros((2, 2 * n))
    for m in range(2 * n):
        if m >= n and not design.turned[m - n]:
            continue
        scale = 1.0 if m < n else 1.0 / TURN_MM
        shape.joints[:] = near.joints
        shape.joints[m] += STEP_MM * scale
        step = STEP_MM
        if not in_order(design, shape.joints):
            step = -STEP_MM
            shape.joints[m] = near.joints[m] - STEP_MM * scale
        if not near_shape(design, near, shape):
            continue
        there = shape.result[TIP + 9 :]
        rates[0, m] = (math.hypot(there[0], there[1]) - aside) / step
        rates[1, m] = (there[2] - here[2]) / step
    a, b, d = 0.0, 0.0, 0.0
    for m in range(2 * n):
        a += rates[0, m] ** 2
        b += rates[0, m] * rates[1, m]
        d += rates[1, m] ** 2
    determinant = a * d - b * b
    if determinant <= 0.0:
        return False
    u, v = (d * want_aside - b * want_ahead) / determinant, (a * want_ahead - b * want_aside) / determinant
    longest = 0.0
    for m in range(2 * n):
        change[m] = rates[0, m] * u + rates[1, m] * v
        longest = max(longest, abs(change[m]))
    # Longer steps are shortened to this: about the distance between two bends of a usual tube.
    share = min(1.0, 8.0 / longest) if longest > 0.0 else 1.0
    for m in range(2 * n):
        change[m] *= share * (1.0 if m < n else 1.0 / TURN_MM)
    return True


@merged_kernel
def aim_shape(design, near, shape, base, target):
    """Turn and insert tubes so that their tip comes to a point `target`.

    Newton's method with the least change of the joints in each step, from the shape `near`, which is changed.
    Then the whole way is followed, and `shape` receives it.  `base` (9,) is the scope tip: point, tangent,
    and +x, from which the rotation counts.

    Returns:
        - rotation, miss (float) - Of all tubes together in rad; the distance of the tip from the point in mm.
        - allowed (bool) - Whether the way to the shape keeps all limits of the design.
    """
    n = design.radii.shape[0]
    want_aside, want_ahead, towards = _seen_from(base, target)
    change = np.zeros(2 * n)
    aside, ahead, direction = _tip(near)
    miss = math.hypot(want_aside - aside, want_ahead - ahead)
    shape.joints[:] = near.joints
    if not near_shape(design, near, shape):
        return 0.0, miss, False
    take_over(near, shape)
    for _ in range(ITERATIONS):
        if miss <= CLOSE_MM:
            break
        if not _change(design, near, shape, want_aside - aside, want_ahead - ahead, change):
            break
        for m in range(2 * n):
            shape.joints[m] = near.joints[m] + change[m]
        shape.joints[0] = min(max(shape.joints[0], 0.0), design.limits[MAX_EXTENSION])
        for i in range(1, n):
            shape.joints[i] = min(max(shape.joints[i], 0.0), shape.joints[i - 1])
        if not near_shape(design, near, shape):
            break
        take_over(near, shape)
        aside, ahead, direction = _tip(near)
        miss = math.hypot(want_aside - aside, want_ahead - ahead)
    if miss > CLOSE_MM:
        return 0.0, miss, False
    shape.joints[:] = near.joints
    allowed = whole_way(design, shape)
    if allowed:
        aside, ahead, direction = _tip(shape)
        miss = math.hypot(want_aside - aside, want_ahead - ahead)
    return (towards - direction) % (2.0 * math.pi), miss, allowed
