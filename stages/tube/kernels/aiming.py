"""Rotation and insertions with which the tip of the tubes comes to a point.

The common rotation turns the plane of the tubes to the point; in that plane the two insertions bring the tip
to the point's distance beside and ahead of the scope tip.  `tubes` is the array of `planar`.
"""

import math

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from stages.tube.kernels.deployment import tip_of_arcs
from stages.tube.kernels.one_shape import MAX_EXTENSION as MOST_OUT
from stages.tube.kernels.one_shape import in_order, near_shape, take_over, whole_way
from stages.tube.kernels.planar import MAX_EXTENSION, planar_point
from stages.tube.kernels.shapes import TIP

ITERATIONS = 30
"""Newton's method doubles the digits in each; from a start a few millimetres away it needs about five."""
DIFFERENCE_MM = 1e-6
"""Step of the derivatives: their error of about 1e-8 costs no more than an iteration."""
CLOSE_MM = 1e-9
"""A tip that is so near is at the point: the positions of a plan are stated to rounding."""
STEP_MM = 1e-4
"""The same for shapes of the mechanics, which are right to some 1e-9 mm."""
SHAPE_CLOSE_MM = 1e-8
"""Such a shape that ends so near is at the point."""
TURN_MM = 20.0
"""A turn of one tube against the others counts as so many mm of insertion a radian: about how far it moves a
tip that is some tens of millimetres out."""
LONGEST_STEP_MM = 8.0
"""Longer steps are shortened to this: about the distance between two bends of a usual tube."""


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


@kernel()
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
    aside, ahead, towards = _seen_from(base, target)
    rotation = towards % (2.0 * math.pi)
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


@inner_kernel
def _tip(shape):
    """Return how far the tip of a shape is beside and ahead of the scope tip, and in which direction."""
    base = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    pose = tip_of_arcs(base, (1.0, 0.0, 0.0), shape.arcs[: shape.number[0]])
    return math.hypot(pose[0], pose[1]), pose[2], math.atan2(pose[1], pose[0])


@inner_kernel
def _change(design, near, shape, want_aside, want_ahead, change):
    """Write the least change of the joints that makes up for a tip's distance; tell whether there is one.

    Where the tip goes with each joint is seen from the frames of the mechanics, which change smoothly.
    """
    n = design.lengths.shape[0]
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
    share = min(1.0, LONGEST_STEP_MM / longest) if longest > 0.0 else 1.0
    for m in range(2 * n):
        change[m] *= share * (1.0 if m < n else 1.0 / TURN_MM)
    return True


@merged_kernel
def aim_shape(design, near, shape, base, target):
    """Turn and insert tubes that are not planar so that their tip comes to a point.

    Newton's method with the least change of the joints in each step, from the shape `near`, which is changed.
    Then the whole way is followed.

    Parameters
    ----------
    design : DesignArrays
    near, shape : ShapeArrays
        The second receives the shape.
    base : (9,) float64
    target : tuple of 3 floats
        See `aim`.

    Returns
    -------
    rotation, miss : float
        Of all tubes together in rad; the distance of the tip from the point in mm.
    allowed : bool
        Whether the way to the shape keeps all limits of the design.
    """
    n = design.lengths.shape[0]
    want_aside, want_ahead, towards = _seen_from(base, target)
    change = np.zeros(2 * n)
    aside, ahead, direction = _tip(near)
    miss = math.hypot(want_aside - aside, want_ahead - ahead)
    shape.joints[:] = near.joints
    if not near_shape(design, near, shape):
        return 0.0, miss, False
    take_over(near, shape)
    for _ in range(ITERATIONS):
        if miss <= SHAPE_CLOSE_MM:
            break
        if not _change(design, near, shape, want_aside - aside, want_ahead - ahead, change):
            break
        for m in range(2 * n):
            shape.joints[m] = near.joints[m] + change[m]
        shape.joints[0] = min(max(shape.joints[0], 0.0), design.limits[MOST_OUT])
        for i in range(1, n):
            shape.joints[i] = min(max(shape.joints[i], 0.0), shape.joints[i - 1])
        if not near_shape(design, near, shape):
            break
        take_over(near, shape)
        aside, ahead, direction = _tip(near)
        miss = math.hypot(want_aside - aside, want_ahead - ahead)
    if miss > SHAPE_CLOSE_MM:
        return 0.0, miss, False
    shape.joints[:] = near.joints
    allowed = whole_way(design, shape)
    if allowed:
        aside, ahead, direction = _tip(shape)
        miss = math.hypot(want_aside - aside, want_ahead - ahead)
    return (towards - direction) % (2.0 * math.pi), miss, allowed
