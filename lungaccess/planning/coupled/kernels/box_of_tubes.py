"""A box of deployments is bounded by the one in its middle, and by how much the others differ from it.

A box is a row of float64 with a range of each value of a deployment: its middles, and HALF columns further on
its half widths.  Every box has a rotation of the tubes (rad) and two insertions (mm); where their scope tips
are is for each kind of box to say.  docs/theory/unreachable.md derives the bounds.
"""

import math
from typing import NamedTuple

import stages.tube.kernels as kernels
from anatomy.kernels.compiling import inner_kernel, merged_kernel

Vector = tuple[float, float, float]

ROTATION, OUTER, INNER = 2, 3, 4
HALF = 8
"""Columns of a box: two other sides come before these, and up to three after them."""
SPARE = 1e-6
"""For rounding, mm and rad."""

BENT_THROUGHOUT, STRAIGHT_FIRST, OUTER_STRAIGHT, MIXED = range(4)
"""All shapes of a box have one of these kinds in common, or it is MIXED; see `_shape_of`."""


class BoxTubes(NamedTuple):
    """The tubes of a box: the middle ones, and how the others differ.

    Args:
        base, forward, normal (tuple of 3 float): The scope tip, LPS mm, its direction, and that of the bend.
        place, tilt, roll: How far the place (mm), the direction and the rotation (rad) may be from these.
        sharing, first_outer: What the outer insertion changes of the heading, rad, beyond an arc length, mm.
        opening: What the inner insertion changes of it, rad a mm, where the tubes go straight first.
        outer, inner: Insertions of the middle tubes, mm; the inner one is the longest where all are bent.
    """

    base: Vector
    forward: Vector
    normal: Vector
    place: float
    tilt: float
    roll: float
    sharing: float
    first_outer: float
    opening: float
    outer: float
    inner: float


class Seen(NamedTuple):
    """The target as the tips of a box see it; see `seen_target`.

    Args:
        from_tip (tuple of 3 float): From the middle tip to the target, mm.
        aside, ahead: Of the target there, mm.
        line (tuple of 3 float): Unit vector to the target from the centre of the tightest circle in the plane
            of tip and target.
        size: How far the target is from that centre, mm.
        moved, second: The greatest displacement of the target, and its remainder of second order, mm.
        by_rotation, by_outer, by_inner (tuple of 3 float): The displacement of first order by each half
            width, mm; 0 where insertions count by their rates.
        rate_outer, rate_inner: What they count then, mm; else 0.
    """

    from_tip: Vector
    aside: float
    ahead: float
    line: Vector
    size: float
    moved: float
    second: float
    by_rotation: Vector
    by_outer: Vector
    by_inner: Vector
    rate_outer: float
    rate_inner: float


@inner_kernel
def cross(a, b):
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@inner_kernel
def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inner_kernel
def norm(a):
    return math.sqrt(dot(a, a))


@inner_kernel
def minus(a, b, scale):
    """Return a - scale b."""
    return (a[0] - scale * b[0], a[1] - scale * b[1], a[2] - scale * b[2])


@inner_kernel
def times(a, scale):
    return (a[0] * scale, a[1] * scale, a[2] * scale)


@inner_kernel
def costliest(costs, first, count):
    """Return which of `count` costs, from the column `first` on, is the greatest."""
    side = 0
    for m in range(1, count):
        if costs[first + m] > costs[first + side]:
            side = m
    return side


@inner_kernel
def split(box, other, side):
    """Halve a box on a side; `other` becomes the second half."""
    other[:] = box
    half = 0.5 * box[HALF + side]
    box[HALF + side] = other[HALF + side] = half
    box[side] -= half
    other[side] += half


@inner_kernel
def has_insertions(tubes, insertions, box):
    """Tell whether a box holds insertions that are possible and sweep little."""
    outer, inner = box[OUTER], box[INNER]
    return kernels.insertions_exist(tubes, insertions, outer, box[HALF + OUTER], inner, box[HALF + INNER])


@inner_kernel
def tubes_of(tubes, base, forward, normal, place, tilt, box):
    """Return the tubes of a box whose scope tips are within `place` (mm) and `tilt` (rad) of one."""
    most = max(abs(tubes[kernels.INNER_CURVATURE]), abs(tubes[kernels.OVERLAP_CURVATURE]))
    longest = box[INNER] + box[HALF + INNER]
    bent = longest > tubes[kernels.CURVED_LENGTH]
    return BoxTubes(
        base,
        forward,
        normal,
        place,
        tilt,
        box[HALF + ROTATION],
        abs(tubes[kernels.OVERLAP_CURVATURE] - tubes[kernels.INNER_CURVATURE]) * box[HALF + OUTER],
        max(box[OUTER] - box[HALF + OUTER], 0.0),
        most * box[HALF + INNER] if bent else 0.0,
        box[OUTER],
        box[INNER] if bent else longest,
    )


@inner_kernel
def sample_of(tubes, family, s):
    """Return the middle tubes' point at arc length `s`, LPS mm, and how far from it those of others are."""
    x, z = kernels.planar_point(tubes, family.outer, family.inner, s)
    wrong = family.sharing * max(s - family.first_outer, 0.0) + family.opening * s
    away = family.place + wrong + family.tilt * (math.hypot(x, z) + wrong) + family.roll * (abs(x) + wrong)
    return minus(minus(family.base, family.normal, -x), family.forward, -z), away


@inner_kernel
def tip_of(tubes, family, box):
    """Return the middle tip, its direction, and by how many mm and by what angle (rad) others may differ.

    The heading changes with the inner insertion by the curvature of the tubes, or by the difference of both
    where it draws the curve out of the outer tube.
    """
    tip, away = sample_of(tubes, family, box[INNER])
    inner, half_inner = box[INNER], box[HALF + INNER]
    straight = max(inner - tubes[kernels.CURVED_LENGTH], 0.0)
    shared = min(max(box[OUTER] - straight, 0.0), inner - straight)
    shared_curvature, own_curvature = tubes[kernels.OVERLAP_CURVATURE], tubes[kernels.INNER_CURVATURE]
    angle = shared_curvature * shared + own_curvature * (inner - straight - shared)
    sine, cosine = math.sin(angle), math.cos(angle)
    tangent = minus(times(family.normal, sine), family.forward, -cosine)
    most = max(abs(shared_curvature), abs(own_curvature), abs(shared_curvature - own_curvature))
    turned = family.sharing + most * half_inner
    swing = family.tilt + turned + family.roll * min(abs(sine) + turned, 1.0)
    return tip, tangent, away + half_inner, swing


@inner_kernel
def tip_moves(tubes, family, box):
    """Return by how much rotation, outer and inner insertion move the tip, by and large, mm."""
    x, _z = kernels.planar_point(tubes, box[OUTER], box[INNER], box[INNER])
    by_outer = family.sharing * max(box[INNER] - family.first_outer, 0.0)
    return family.roll * abs(x), by_outer, box[HALF + INNER] + family.opening * box[INNER]


@merged_kernel
def _shape_of(tubes, box):
    """Tell what the tubes of a box have in common, so that their shape depends smoothly on the insertions.

    BENT_THROUGHOUT: curved from the scope tip on.  STRAIGHT_FIRST: straight, then curved, with the end of the
    outer tube in the curve.  OUTER_STRAIGHT: the same with the end of the outer tube before the curve.
    MIXED: none of these, or the inner tube may be less far out than the outer.
    """
    outer, inner = box[OUTER], box[INNER]
    half_outer, half_inner = box[HALF + OUTER], box[HALF + INNER]
    if outer > inner:
        return MIXED
    if inner + half_inner <= tubes[kernels.CURVED_LENGTH]:
        return BENT_THROUGHOUT
    if inner - half_inner >= tubes[kernels.CURVED_LENGTH]:
        if outer - half_outer >= inner + half_inner - tubes[kernels.CURVED_LENGTH]:
            return STRAIGHT_FIRST
        if outer + half_outer <= inner - half_inner - tubes[kernels.CURVED_LENGTH]:
            return OUTER_STRAIGHT
    return MIXED


@inner_kernel
def _turned_by(second, moved, rate, lever, half, extra):
    """Add a rotation to how far a point may move and to the remainder of second order; see `seen_target`.

    It turns by up to `rate` `half` (rad) with the point at most `lever` mm from its centre; `extra` mm a mm
    is how fast the centre, or what is turned, goes on itself.
    """
    speed = rate * lever
    second += rate * half * (moved + 0.5 * (extra + speed) * half)
    return second, moved + speed * half


@inner_kernel
def seen_target(tubes, kappa, target, family, tip, tangent, box):
    """Bound how far the target moves as the tips of a box see it, and where their tightest circle is.

    Every deployment moves the tip by a chain of motions: to its place, by its direction, its rotation, and
    along and in the bend of the tubes.  Seen from the tip the target makes the reverse motions, the place
    first.  The displacement by each is at most its rate times how far the target is from its centre; the
    remainder of second order of a chain is the sum over pairs of what the outer motion turns of what the
    inner has moved, and half the square of each.

    Args:
        target (tuple of 3 float): LPS mm.
        tip, tangent (tuple of 3 float): Those of `tip_of`.

    Returns:
        Seen: The displacement of first order by places and directions is for the caller to find.
    """
    outer, inner = box[OUTER], box[INNER]
    half_outer, half_inner = box[HALF + OUTER], box[HALF + INNER]
    bent = tubes[kernels.INNER_CURVATURE]
    unlike = tubes[kernels.OVERLAP_CURVATURE] - bent
    forward, normal = family.forward, family.normal
    binormal = cross(forward, normal)
    joint = min(max(outer, inner - tubes[kernels.CURVED_LENGTH], 0.0), inner)
    joint_x, joint_z = kernels.planar_point(tubes, outer, inner, joint)
    from_base, from_tip = minus(target, family.base, 1.0), minus(target, tip, 1.0)
    from_joint = minus(minus(from_base, normal, joint_x), forward, joint_z)
    far = norm(from_base)
    ahead = dot(from_tip, tangent)
    across = minus(from_tip, tangent, ahead)
    aside = norm(across)

    # How far the target moves: the motions from the first that moves it, as the tip sees it, to the last.
    moved = family.place
    second, moved = _turned_by(0.0, moved, 1.0, far + moved, family.tilt, 0.0)
    along = dot(from_base, forward)
    lever = min(far + family.place, math.sqrt(max(far * far - along * along, 0.0)) + moved)
    second, moved = _turned_by(second, moved, 1.0, lever, family.roll, 0.0)
    shape = _shape_of(tubes, box)
    about_joint = cross(binormal, from_joint)
    by_outer = by_inner = (0.0, 0.0, 0.0)
    rate_outer = rate_inner = 0.0
    if shape == BENT_THROUGHOUT:
        lever = norm(from_joint) + moved + half_outer
        second, moved = _turned_by(second, moved, abs(unlike), lever, half_outer, 1.0)
        speed = 1.0 + abs(bent) * (norm(from_tip) + moved + half_inner) * math.exp(abs(bent) * half_inner)
        second += abs(bent) * half_inner * (moved + 0.5 * speed * half_inner)
        moved += speed * half_inner
        by_outer = times(about_joint, unlike * half_outer)
        by_inner = times(minus(tangent, cross(binormal, from_tip), -bent), half_inner)
    elif shape == STRAIGHT_FIRST:
        moved += half_inner
        half = half_outer + half_inner
        lever = norm(from_joint) + moved + half
        second, moved = _turned_by(second, moved, abs(unlike), lever, half, 1.0)
        by_outer = times(about_joint, unlike * half_outer)
        by_inner = times(minus(forward, about_joint, unlike), half_inner)
    elif shape == OUTER_STRAIGHT:
        moved += half_inner
        by_inner = times(forward, half_inner)
    else:
        lever = far + family.place + inner + half_inner
        rate_outer = abs(unlike) * lever * half_outer
        rate_inner = (1.0 + max(abs(unlike), abs(bent)) * lever) * half_inner
        moved += rate_outer + rate_inner
        second += rate_outer + rate_inner

    # To first order, along the line from the centre of the tightest circle to the target.
    towards = times(across, 1.0 / aside) if aside > SPARE else cross(binormal, tangent)
    from_centre = minus(from_tip, towards, 1.0 / kappa)
    size = norm(from_centre)
    line = times(from_centre, 1.0 / size) if size > SPARE else towards
    by_rotation = times(cross(forward, from_base), family.roll)
    return Seen(
        from_tip,
        aside,
        ahead,
        line,
        size,
        moved,
        second,
        by_rotation,
        by_outer,
        by_inner,
        rate_outer,
        rate_inner,
    )
