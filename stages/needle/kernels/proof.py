"""The proof that an arc is clear of obstacles.

`pose` and `bend` are the tuples of `anatomy.kernels.arcs`.
"""

import math
from typing import NamedTuple

import numpy as np

from anatomy.base.typed import Float, Labels, UInt16
from anatomy.kernels.arcs import point_on_arc
from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from anatomy.kernels.field import EXACT_REACH_MM, MIN_GAP_MM, distance_bound, exact_distance, label_at
from anatomy.kernels.labels import LUMEN

TINY = 1e-9
"""Rounding of limits, distances and shares that the kernels allow for."""
MIN_ARC_MM = 1e-6
"""Shorter arcs are no arcs."""

WALL_ZONE_MM = 1.0
"""Needle that is spent on piercing the wall, as of a tube: more than the wall of a small bronchus."""

# Typed numbers: a kernel is compiled once more for every literal that it is called with.
_NOBODY = np.int64(-1)
_LUMEN = np.int64(LUMEN)


class Obstacles(NamedTuple):
    """What a needle collides with, see `anatomy.kernels.field`.

    Args:
        clearance ((ni + 1, nj + 1, nk + 1) uint16): Clearance field at the corners of the voxels.
        labels ((ni, nj, nk) uint16): See `anatomy.structures`.
        geometry ((3, 6) float64): See `anatomy.fields.corner_geometry`.
        bits: Structures that are obstacles.
    """

    clearance: UInt16
    labels: Labels
    geometry: Float
    bits: int


@merged_kernel
def _early_blocker(obstacles, required, pose, bend, begin, length):
    """Look for an obstacle at a few points of an arc, the middle first; 0 if none is met."""
    clearance, labels, geometry, bits = obstacles
    count = 1
    # Before the proof, arcs are looked at in points at most so far apart: most obstacles are met there.
    while (length - begin) / count > 1.5:
        for m in range(count):
            x, y, z = point_on_arc(pose, bend, begin + (length - begin) * (m + 0.5) / count)
            if distance_bound(clearance, geometry, x, y, z) < required:
                distance, label = exact_distance(labels, geometry, x, y, z, bits, _NOBODY, required)
                if distance < required:
                    return label
        count *= 2
    return 0


@merged_kernel
def _blocker_by_lookup(obstacles, step, pose, bend, length):
    """Look up the voxels at the ends of steps of an arc [Fu2018, fig. 6, right]: no proof."""
    _clearance, labels, geometry, bits = obstacles
    count = max(int(math.ceil(length / step)), 1)
    for m in range(count + 1):
        x, y, z = point_on_arc(pose, bend, length * m / count)
        label = label_at(labels, geometry, x, y, z)
        if label & bits:
            return label
    return 0


@inner_kernel
def kept_from_lumen(limits, inserted):
    """Return how far (mm) the axis keeps from lumens in the exit, below 0 where none counts; growth a mm."""
    if limits.leaving_sine > 0.0:
        if inserted < WALL_ZONE_MM - TINY:
            return -1.0, 0.0
        risen = limits.leaving_sine * (inserted - WALL_ZONE_MM)
        if risen < limits.radius_mm:
            return max(risen, 0.0), limits.leaving_sine
    return limits.radius_mm, 0.0


@kernel()
def exact_gap(obstacles, limits, inserted, x, y, z, branch):
    """Tell how far a needle may go on from a point where it is `inserted` mm long: the rule at the exit.

    Everywhere the needle's axis keeps `limits.required_mm` from obstacles.  Up to `limits.exempt_mm` the
    pierced `branch` (-1: none) does not count, but the axis keeps a distance from every lumen.  That is the
    needle's radius.  A needle that begins at the wall (`limits.leaving_sine` > 0) begins nearer: for
    WALL_ZONE_MM the lumen of the pierced branch does not count either; from there on the axis is outside, and
    the distance kept grows by `leaving_sine` a mm, up to the radius.

    Returns:
        - gap (float) - The next `gap` mm are clear, as far as the rule stays the same; negative if the point
          is not.
        - label (int) - Of the voxel that limits it, 0 for none near.
        - distance, needed (float) - From that voxel, mm.
    """
    _clearance, labels, geometry, bits = obstacles
    reach = limits.required_mm + EXACT_REACH_MM
    in_exit = branch >= 0 and inserted < limits.exempt_mm - TINY
    distance, label = exact_distance(labels, geometry, x, y, z, bits, branch if in_exit else -1, reach)
    needed = limits.required_mm
    gap = distance - needed
    kept, rate = kept_from_lumen(limits, inserted)
    if in_exit and kept >= 0.0:
        lumen, lumen_label = exact_distance(labels, geometry, x, y, z, _LUMEN, _NOBODY, reach)
        # The distance falls by 1 a mm at most, while what is kept grows by `rate`.
        if (lumen - kept) / (1.0 + rate) < gap:
            return (lumen - kept) / (1.0 + rate), lumen_label, lumen, kept
    return gap, label, distance, needed


@kernel()
def blocker_on_arc(obstacles, limits, pose, bend, length, s0, branch):
    """Prove an arc clear of obstacles: 0 if it is, else the label of the voxel that is too near.

    Clearance is 1-Lipschitz: where it exceeds the required one by `gap`, the next `gap` mm are clear.
    The field's lower bound is tried first, then the exact distance to the voxels as solid boxes, with the
    exemption of the pierced `branch` (`exact_gap`; -1: none).  This arc starts at the length `s0` of the
    needle.

    With `limits.lookup_step_mm` voxels are looked up instead, and nothing is proved.
    """
    if limits.lookup_step_mm > 0.0:
        return _blocker_by_lookup(obstacles, limits.lookup_step_mm, pose, bend, length)
    clearance, _labels, geometry, _bits = obstacles
    required = limits.required_mm
    exempt = limits.exempt_mm - s0 if branch >= 0 else 0.0
    zone = WALL_ZONE_MM - s0 if limits.leaving_sine > 0.0 else 0.0
    early = _early_blocker(obstacles, required, pose, bend, max(exempt, 0.0), length)
    if early != 0:
        return early
    s = 0.0
    while True:
        x, y, z = point_on_arc(pose, bend, s)
        gap = distance_bound(clearance, geometry, x, y, z) - required
        if gap < MIN_GAP_MM:
            gap, label, _distance, _needed = exact_gap(obstacles, limits, s0 + s, x, y, z, branch)
            if gap < MIN_GAP_MM:
                return label
            if s < exempt - TINY:
                gap = min(gap, exempt - s)
            if s < zone - TINY:
                gap = min(gap, zone - s)
        if s >= length:
            return 0
        s = min(s + gap, length)


class Limits(NamedTuple):
    """What a needle keeps, and how finely its paths are looked at.

    Args:
        kappa: Greatest curvature, 1/mm.
        max_angle_rad: Greatest angle between the tip and its direction at the start.
        max_turn_rad: Greatest sum of all turning.
        required_mm: Clearance that the needle's axis keeps.
        radius_mm: Radius of the needle.
        exempt_mm: First length of the needle that may touch the wall of the pierced branch.
        max_step_mm: Longest arc of a tree.
        cost_step_mm: Longest step of integrals of 1 / clearance.
        goal_tolerance_mm: How far from the target a path may end.
        leaving_sine: 0: the needle begins in tissue.  More: it begins at the wall of the pierced branch, in
            or beside its lumen, and leaves it at this sine of an angle or more, see
            `stages.needle.kernels.proof.exact_gap`.
        lookup_step_mm: 0: arcs are proved clear.  More: voxels are looked up at steps of so many mm, which
            proves nothing.
    """

    kappa: float
    max_length_mm: float
    max_angle_rad: float
    max_turn_rad: float
    required_mm: float
    radius_mm: float
    exempt_mm: float
    max_step_mm: float
    cost_step_mm: float
    goal_tolerance_mm: float
    leaving_sine: float = 0.0
    lookup_step_mm: float = 0.0
