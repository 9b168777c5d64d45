"""The proof that an arc is clear of obstacles.

`obstacles` is the tuple (clearance field, label volume, their geometry, obstacle bits), see
`anatomy.kernels.field`; `pose` and `bend` are the tuples of `anatomy.kernels.arcs`.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from anatomy.kernels.arcs import point_on_arc
from anatomy.kernels.compiling import inner_kernel
from anatomy.kernels.field import EXACT_REACH_MM, MIN_GAP_MM, distance_bound, exact_distance, label_at
from anatomy.kernels.labels import LUMEN
from stages.needle.kernels.limits import EXEMPT_LENGTH, LOOKUP_STEP, RADIUS, REQUIRED, TINY

PROBE_SPACING_MM = 1.5

# Typed numbers: a kernel is compiled once more for every literal that it is called with.
_NOBODY = np.int64(-1)
_LUMEN = np.int64(LUMEN)


@inner_kernel
def _early_blocker(obstacles, required, pose, bend, begin, length):
    """Look for an obstacle at a few points of an arc, the middle first; 0 if none is met."""
    field, labels, geometry, bits = obstacles
    count = 1
    while (length - begin) / count > PROBE_SPACING_MM:
        for m in range(count):
            x, y, z = point_on_arc(pose, bend, begin + (length - begin) * (m + 0.5) / count)
            if distance_bound(field, geometry, x, y, z) < required:
                distance, label = exact_distance(labels, geometry, x, y, z, bits, _NOBODY, required)
                if distance < required:
                    return label
        count *= 2
    return 0


@inner_kernel
def _blocker_by_lookup(obstacles, step, pose, bend, length):
    """Look up the voxels at the ends of steps of an arc [Fu2018, fig. 6, right]: no proof."""
    _field, labels, geometry, bits = obstacles
    count = max(int(math.ceil(length / step)), 1)
    for m in range(count + 1):
        x, y, z = point_on_arc(pose, bend, length * m / count)
        label = label_at(labels, geometry, x, y, z)
        if label & bits:
            return label
    return 0


@numba.njit(cache=True)
def blocker_on_arc(obstacles, limits, pose, bend, length, s0, branch):
    """Prove an arc clear of obstacles: 0 if it is, else the label of the voxel that is too near.

    Clearance is 1-Lipschitz: where it exceeds the required one by `gap`, the next `gap` mm are clear.
    The field's lower bound is tried first, then the exact distance to the voxels as solid boxes.
    The first `limits[EXEMPT_LENGTH]` mm of the needle (this arc starts at `s0`) may be near the
    wall of the pierced `branch` (-1: none), but never nearer than the needle's radius to any lumen.

    With `limits[LOOKUP_STEP]` nothing is proved: see `experiments.support.cost_map.inflation`.
    """
    if limits[LOOKUP_STEP] > 0.0:
        return _blocker_by_lookup(obstacles, limits[LOOKUP_STEP], pose, bend, length)
    field, labels, geometry, bits = obstacles
    required = limits[REQUIRED]
    reach = required + EXACT_REACH_MM
    exempt = limits[EXEMPT_LENGTH] - s0 if branch >= 0 else 0.0
    early = _early_blocker(obstacles, required, pose, bend, max(exempt, 0.0), length)
    if early != 0:
        return early
    s = 0.0
    while True:
        x, y, z = point_on_arc(pose, bend, s)
        gap = distance_bound(field, geometry, x, y, z) - required
        if gap < MIN_GAP_MM:
            in_exit = s < exempt - TINY
            spared = branch if in_exit else -1
            distance, label = exact_distance(labels, geometry, x, y, z, bits, spared, reach)
            gap = distance - required
            if in_exit:
                lumen, lumen_label = exact_distance(labels, geometry, x, y, z, _LUMEN, _NOBODY, reach)
                if lumen - limits[RADIUS] < gap:
                    gap = lumen - limits[RADIUS]
                    label = lumen_label
            if gap < MIN_GAP_MM:
                return label
            if in_exit:
                gap = min(gap, exempt - s)
        if s >= length:
            return 0
        s = min(s + gap, length)
