"""Compiled kernel of the risk: what a plan with deviations touches, followed from look to look.

The tubes beyond the scope tip and the needle are one chain of arcs.  `pieces` is `(P, 4)`: the length in mm,
the roll in rad before it, the curvature in 1/mm and the radius in mm of each of P arcs; the first `n_tube` of
them are the tubes.  `start` is `(9,)`: scope tip, its unit tangent and the +x axis of its frame, LPS mm.
"""

import math

import numpy as np

from anatomy.kernels.arcs import normal_on_arc, point_on_arc, pose_on_arc
from anatomy.kernels.compiling import borrowing_kernel
from anatomy.kernels.field import EXACT_REACH_MM, MIN_GAP_MM, distance_bound, exact_distance, label_at
from anatomy.kernels.labels import AIRWAY, BRANCH_SHIFT, LUMEN, OUTSIDE, VESSEL

LENGTH = 0
ROLL = 1
CURVATURE = 2
RADIUS = 3
N_PIECE = 4

STAYS_INSIDE = 1 << 14
"""Flag beside the structures touched: the scope tip is not in a lumen, or the tubes end in one."""

IN_LUMEN = -2
NOT_IN_LUMEN = -3

STEP_MM = 0.05
"""Shortest step in a lumen or along what is touched."""
WALL_ZONE_MM = 1.0
"""From so far behind the exit on, the axis is out of every lumen."""
TOUCHES_MM = 1e-9

# Typed numbers: a kernel is compiled once more for every literal that it is called with.
_NOBODY = np.int64(-1)
_LUMEN = np.int64(LUMEN)
_VESSEL = np.int64(VESSEL)


@borrowing_kernel
def _touch(labels, geometry, bits, touched, x, y, z, radius, spared, lumen_mm, border_mm):
    """Add what a ball touches, and return how far no structure that is not yet touched can be met.

    The airway of the branch `spared` counts for nothing (-1: none is spared), but the lumen of any airway
    nearer than `lumen_mm` does (negative: it does not).  Vessels reach farther than their voxels by
    `border_mm`; where that is negative, their voxels still count where the middle of the ball lies in one.
    """
    reach = radius + EXACT_REACH_MM
    gap = EXACT_REACH_MM
    left = bits & ~touched
    if border_mm != 0.0 and left & VESSEL:
        least = max(radius + border_mm, 0.0)
        distance, _label = exact_distance(labels, geometry, x, y, z, _VESSEL, _NOBODY, least + EXACT_REACH_MM)
        if distance < least - TOUCHES_MM or distance == 0.0:
            touched |= VESSEL
        gap = min(gap, distance - least)
        left &= ~VESSEL
    while left != 0:
        distance, label = exact_distance(labels, geometry, x, y, z, left, spared, reach)
        if distance >= radius - TOUCHES_MM:
            gap = min(gap, distance - radius)
            break
        hit = label & left
        if hit != AIRWAY and (label >> BRANCH_SHIFT) - 1 == spared:
            hit &= ~AIRWAY
        touched |= hit
        left &= ~hit
    if lumen_mm >= 0.0 and not touched & AIRWAY:
        distance, _label = exact_distance(
            labels, geometry, x, y, z, _LUMEN, _NOBODY, lumen_mm + EXACT_REACH_MM
        )
        if distance < lumen_mm - TOUCHES_MM or distance == 0.0:
            touched |= AIRWAY
        gap = min(gap, distance - lumen_mm)
    return touched, max(gap, STEP_MM)


@borrowing_kernel
def _in_lumen(labels, geometry, corners, depth_geometry, x, y, z):
    """Return the step to the next point in a lumen, and the branch; NOT_IN_LUMEN outside of all."""
    label = label_at(labels, geometry, x, y, z)
    if not label & LUMEN:
        return 0.0, NOT_IN_LUMEN
    return max(distance_bound(corners, depth_geometry, x, y, z), STEP_MM), (label >> BRANCH_SHIFT) - 1


@borrowing_kernel
def _bend(pose, nx, ny, nz, roll, kappa):
    """Return curvature and normal of an arc that begins with a roll from the normal `(nx, ny, nz)`."""
    c, s = math.cos(roll), math.sin(roll)
    bx = pose[4] * nz - pose[5] * ny
    by = pose[5] * nx - pose[3] * nz
    bz = pose[3] * ny - pose[4] * nx
    return kappa, c * nx + s * bx, c * ny + s * by, c * nz + s * bz


@borrowing_kernel
def follow(obstacles, depth, mediastinal, start, pieces, n_tube, exempt_mm, enough, border_mm):
    """Return what one chain touches.

    A device touches a structure where its axis is nearer to a voxel of it, as a solid box, than its
    radius.  Judging begins where the tubes leave the lumen: the airway of the branch that they leave is
    spared for the tubes and the first `exempt_mm` of the needle, except that behind the wall the tubes' axis
    and the needle's surface may not enter a lumen again.  Clearance changes by no more than one moves, so
    from one look to the next nothing is missed, but for what is touched over less than STEP_MM.

    Args:
        obstacles (Obstacles): All structures that count.
        depth (tuple): Lumen depth and its geometry.
        mediastinal ((B,) bool): The branches that lie in the mediastinum: what leaves one of them pierces the
            pleura.
        start: (9,) float64.
        pieces: (P, 4) float64.
        n_tube: int.
        exempt_mm: float.
        enough (int): Flags of which one ends the search for more; 0 to find all that is touched.
        border_mm (float): How far all vessels reach out of their voxels, see `_touch`.

    Returns:
        int: The bits of the structures touched, with STAYS_INSIDE where the chain was not judged.
    """
    clearance, labels, geometry, bits = obstacles
    corners, depth_geometry = depth
    pose = (start[0], start[1], start[2], start[3], start[4], start[5])
    nx, ny, nz = start[6], start[7], start[8]
    touched = 0
    pierced = IN_LUMEN
    branch = IN_LUMEN
    done = 0.0
    left_at = 0.0
    tube_mm = pieces[:n_tube, LENGTH].sum()
    for p in range(pieces.shape[0]):
        length, roll = pieces[p, LENGTH], pieces[p, ROLL]
        kappa, radius = pieces[p, CURVATURE], pieces[p, RADIUS]
        bend = _bend(pose, nx, ny, nz, roll, kappa)
        if p == n_tube and pierced == IN_LUMEN:
            touched |= STAYS_INSIDE
        at = 0.0
        while not touched & (STAYS_INSIDE | enough) and touched & bits != bits:
            x, y, z = point_on_arc(pose, bend, at)
            if pierced == IN_LUMEN:
                step, here = _in_lumen(labels, geometry, corners, depth_geometry, x, y, z)
                if here == NOT_IN_LUMEN:
                    if branch == IN_LUMEN:
                        touched |= STAYS_INSIDE
                    elif branch < 0 or branch >= mediastinal.shape[0] or mediastinal[branch]:
                        touched |= bits & OUTSIDE
                    pierced = branch
                    left_at = done + at
                    continue
                branch = here
            else:
                step = distance_bound(clearance, geometry, x, y, z) - radius - max(border_mm, 0.0)
                if step < MIN_GAP_MM:
                    spared = pierced if p < n_tube or done + at < tube_mm + exempt_mm else -1
                    lumen_mm = -1.0
                    if p >= n_tube:
                        lumen_mm = radius
                    elif done + at > left_at + WALL_ZONE_MM:
                        lumen_mm = 0.0
                    touched, step = _touch(
                        labels, geometry, bits, touched, x, y, z, radius, spared, lumen_mm, border_mm
                    )
            if at >= length:
                break
            at = min(at + step, length)
        nx, ny, nz = normal_on_arc(pose, bend, length)
        pose = pose_on_arc(pose, bend, length)
        done += length
    if n_tube == pieces.shape[0] and pierced == IN_LUMEN:
        touched |= STAYS_INSIDE
    return touched
