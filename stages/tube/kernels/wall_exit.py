"""A tube followed from the lumen through the wall into the tissue, and whether each point of it is allowed.

`tubes` is the array of `planar`.  `trace` is a `(N_TRACE,)` float64 array that keeps where the tube is, how
it left the lumen, and how much of its body is in the wall since.
"""

import math
from typing import NamedTuple

import numpy as np

from anatomy.base.typed import Bool, Float, Labels, UInt16
from anatomy.kernels.arcs import point_on_arc, pose_on_arc
from anatomy.kernels.compiling import borrowing_kernel, inner_kernel, kernel, merged_kernel
from anatomy.kernels.field import EXACT_REACH_MM, MIN_GAP_MM, distance_bound, exact_distance, label_at
from anatomy.kernels.labels import AIRWAY, BRANCH_SHIFT, FISSURE, LUMEN, OUTSIDE, VESSEL
from stages.tube.kernels.planar import INNER_RADIUS, MAX_WALL_RUN, MIN_WALL_ANGLE, OUTER_RADIUS

# trace
PHASE, LEFT_AT, BRANCH, WALL_ANGLE, HAZARD, WALL_RUN, REFUSAL, CLEAR_TO, N_TRACE = range(9)

IN_LUMEN, LEAVING, IN_WALL, IN_TISSUE = 0.0, 1.0, 2.0, 3.0

# reasons why a deployment is refused
ACCEPTED, NO_EXIT, NEAR_VESSEL, NEAR_PLEURA, NEAR_FISSURE, NEAR_OTHER_BRANCH, REENTERS_LUMEN = range(7)
FLAT_EXIT, LEAVES_MEDIASTINAL, LONG_WALL_RUN, N_REASONS = range(7, 11)

FREE = -1
"""Stands for the label of an obstacle where a bound says that there is none."""
FINE_STEP_MM = 0.05
"""Least step in the lumen, where the axis may cut corners of voxels: a tenth of a voxel."""
CORNER_MM = 0.05
"""An axis that is back in a lumen after no more than this has cut the corner of a voxel and not left."""
UNNOTICED_MM = 0.026
"""An axis that is farther than this from all lumen has left it: it is out for longer than CORNER_MM."""
LOOK_MM = 0.02
"""Spacing of the points that are looked up for lumen while the axis leaves: well below CORNER_MM."""
RUN_STEP_MM = 0.02
"""The run of the body in the wall is known to this at each place where it begins or ends."""
WALL_ZONE_MM = 1.0
"""Within this length the tube pierces the wall; airways that tubes leave have thinner walls."""
OUT_OF_LUMEN_MM = 0.02
"""Least distance from the axis to any lumen, once it is in the tissue."""
NORMAL_RADIUS_MM = 2.5
"""The wall's normal is that of the lumen within this radius: larger than voxels, smaller than branches."""

# Typed numbers: a kernel is compiled once more for every literal that it is called with.
_NOBODY = np.int64(-1)
_LUMEN = np.int64(LUMEN)


class TubeEnvironment(NamedTuple):
    """What the tubes collide with, for kernels.

    field, geometry : corner field of the distance to the obstacles, and its geometry; labels : the labels of
    the voxels; bits : those of the obstacles; lumen, lumen_geometry : corner field of the depth in the
    lumen; mediastinal : (B,) bool, which branches lie in the mediastinum and must not be left.
    """

    field: UInt16
    labels: Labels
    geometry: Float
    bits: int
    lumen: UInt16
    lumen_geometry: Float
    mediastinal: Bool


@kernel()
def _reason(label):
    """Translate the label of a voxel that is too near into a reason."""
    if label & VESSEL:
        return NEAR_VESSEL
    if label & OUTSIDE:
        return NEAR_PLEURA
    if label & FISSURE:
        return NEAR_FISSURE
    return NEAR_OTHER_BRANCH


@merged_kernel
def _wall_normal(labels, geometry, x, y, z):
    """Return the lumen's outward unit normal at a border point, off its centroid nearby, in corner axes."""
    u = geometry[0, 0] * x + geometry[0, 1] * y + geometry[0, 2] * z + geometry[0, 3]
    v = geometry[1, 0] * x + geometry[1, 1] * y + geometry[1, 2] * z + geometry[1, 3]
    w = geometry[2, 0] * x + geometry[2, 1] * y + geometry[2, 2] * z + geometry[2, 3]
    su, sv, sw = math.sqrt(geometry[0, 4]), math.sqrt(geometry[1, 4]), math.sqrt(geometry[2, 4])
    r = NORMAL_RADIUS_MM
    mu = mv = mw = 0.0
    for k in range(max(int(w - r / sw), 0), min(int(w + r / sw) + 1, labels.shape[2])):
        dw = (k + 0.5 - w) * sw
        for j in range(max(int(v - r / sv), 0), min(int(v + r / sv) + 1, labels.shape[1])):
            dv = (j + 0.5 - v) * sv
            for i in range(max(int(u - r / su), 0), min(int(u + r / su) + 1, labels.shape[0])):
                du = (i + 0.5 - u) * su
                if labels[i, j, k] & LUMEN and du * du + dv * dv + dw * dw <= r * r:
                    mu += du
                    mv += dv
                    mw += dw
    norm = math.sqrt(mu * mu + mv * mv + mw * mw)
    if norm < 1e-9:
        return 0.0, 0.0, 0.0
    return -mu / norm, -mv / norm, -mw / norm


@kernel(_nrt=False)
def wall_angle(labels, geometry, pose):
    """Return the angle in rad between a tangent and the lumen's border at its point; pi/2 is square on."""
    normal = _wall_normal(labels, geometry, pose[0], pose[1], pose[2])
    tx, ty, tz = pose[3], pose[4], pose[5]
    sine = 0.0
    for axis in range(3):
        along = geometry[axis, 0] * tx + geometry[axis, 1] * ty + geometry[axis, 2] * tz
        sine += along * math.sqrt(geometry[axis, 4]) * normal[axis]
    return math.asin(min(max(sine, -1.0), 1.0))


@merged_kernel
def _leave_lumen(environment, tubes, trace, pose, bend, inside, outside, s0):
    """Find where the axis leaves the lumen between two arc lengths of a piece, and judge it as an exit."""
    _field, labels, geometry, _bits, _lumen, _lumen_geometry, mediastinal = environment
    branch = int(trace[BRANCH])
    # Halvings of a step to find where the axis leaves the lumen: to less than 0.001 mm.
    for _ in range(12):
        middle = 0.5 * (inside + outside)
        x, y, z = point_on_arc(pose, bend, middle)
        if label_at(labels, geometry, x, y, z) & LUMEN:
            inside = middle
        else:
            outside = middle
    trace[PHASE], trace[LEFT_AT], trace[WALL_RUN] = LEAVING, s0 + inside, 0.0
    if branch < 0 or branch >= mediastinal.shape[0] or mediastinal[branch]:
        trace[REFUSAL] = LEAVES_MEDIASTINAL
        return
    trace[WALL_ANGLE] = wall_angle(labels, geometry, pose_on_arc(pose, bend, inside))
    trace[REFUSAL] = FLAT_EXIT if trace[WALL_ANGLE] < tubes[MIN_WALL_ANGLE] else trace[HAZARD]


@borrowing_kernel
def _first_in_lumen(environment, pose, bend, begin, end):
    """Return the first of points LOOK_MM apart that lies in a lumen, `end` among them; -1 if none does."""
    labels, geometry = environment.labels, environment.geometry
    s = begin
    while s < end:
        s = min(s + LOOK_MM, end)
        x, y, z = point_on_arc(pose, bend, s)
        if label_at(labels, geometry, x, y, z) & LUMEN:
            return s
    return -1.0


@merged_kernel
def _tissue_gap(environment, trace, x, y, z, required):
    """Return the clearance beyond `required` outside the lumen and the label that limits it.

    The label is FREE if not even the pierced branch is so near.  Exempt is the wall of that branch; its
    lumen must stay out of reach of the axis.
    """
    field, labels, geometry, bits, _lumen, _lumen_geometry, _mediastinal = environment
    gap = distance_bound(field, geometry, x, y, z) - required
    if gap >= MIN_GAP_MM:
        return gap, FREE
    reach = required + EXACT_REACH_MM
    distance, label = exact_distance(labels, geometry, x, y, z, bits, int(trace[BRANCH]), reach)
    gap = distance - required
    if trace[PHASE] == IN_TISSUE:
        lumen, _label = exact_distance(labels, geometry, x, y, z, _LUMEN, _NOBODY, reach)
        if lumen - OUT_OF_LUMEN_MM < gap:
            return lumen - OUT_OF_LUMEN_MM, LUMEN
    return gap, label


@merged_kernel
def _lumen_step(environment, trace, x, y, z, at, radius, required):
    """Note branch and hazards of a point in the lumen, at an arc length; return the step to the next one.

    Where the tube touches the wall, what lies behind it must be as clear as in the tissue, unless the
    tube comes free again before it leaves.  No distance falls faster than the tube advances, so it is
    searched anew only where the last one leaves the answer open: CLEAR_TO is where it would be 0.
    """
    _field, labels, geometry, bits, lumen, lumen_geometry, _mediastinal = environment
    trace[BRANCH] = (label_at(labels, geometry, x, y, z) >> BRANCH_SHIFT) - 1
    depth = distance_bound(lumen, lumen_geometry, x, y, z)
    if depth >= radius:
        trace[HAZARD] = ACCEPTED
        return max(depth - radius, FINE_STEP_MM)
    step = max(0.5 * depth, FINE_STEP_MM)
    if trace[CLEAR_TO] - at - required >= step + MIN_GAP_MM:
        return step
    distance, label = exact_distance(labels, geometry, x, y, z, bits & ~AIRWAY, -1, required + EXACT_REACH_MM)
    trace[CLEAR_TO] = at + distance
    if distance - required < FINE_STEP_MM:
        trace[HAZARD] = _reason(label)
        return step
    return max(min(0.5 * depth, distance - required), FINE_STEP_MM)


@inner_kernel
def refused_exits(tubes, s, lack, first_outer):
    """Return up to which arc length a hazard refuses all exits that is `lack` mm too near to the tube at `s`.

    On its last stretch before an exit, as long as its radius, a tube touches the wall; see
    docs/theory/proofs.md.  The outer tube, which is wider, ends at `first_outer` or farther.
    """
    end = s + lack
    if s <= first_outer:
        end = max(min(end, first_outer), end - tubes[OUTER_RADIUS] + tubes[INNER_RADIUS])
    return end + max(tubes[INNER_RADIUS] - FINE_STEP_MM, 0.0)


@merged_kernel
def _run_in_wall(environment, pose, bend, begin, end, radius):
    """Return how much of a stretch is nearer to an airway than `radius`, at least; others are farther."""
    labels, geometry = environment.labels, environment.geometry
    run = 0.0
    s = begin
    while s < end:
        x, y, z = point_on_arc(pose, bend, s)
        # How far beyond the radius the wall is searched: half a voxel, since a longer search costs its cube.
        distance, _label = exact_distance(labels, geometry, x, y, z, AIRWAY, -1, radius + 0.3)
        step = min(max(abs(distance - radius), RUN_STEP_MM), end - s)
        if distance < radius + RUN_STEP_MM:
            run += step
        s += step
    return run


@borrowing_kernel
def _march_beyond(environment, tubes, trace, pose, bend, s0, s, end, radius, clearance):
    """Follow one arc from `s` to `end`, out of the lumen; see `march`."""
    required = radius + clearance
    while True:
        x, y, z = point_on_arc(pose, bend, s)
        gap, label = _tissue_gap(environment, trace, x, y, z, required)
        if gap < MIN_GAP_MM:
            return REENTERS_LUMEN if label == LUMEN else _reason(label)
        to = min(s + gap, end)
        if trace[PHASE] == IN_WALL:
            zone = trace[LEFT_AT] + WALL_ZONE_MM - s0
            if s >= zone:
                trace[PHASE] = IN_TISSUE
                continue
            to = min(to, max(zone, s + 1e-6))
            if _first_in_lumen(environment, pose, bend, s, to) >= 0.0:
                return REENTERS_LUMEN
        if label != FREE:
            trace[WALL_RUN] += _run_in_wall(environment, pose, bend, s, to, radius)
            if trace[WALL_RUN] > tubes[MAX_WALL_RUN]:
                return LONG_WALL_RUN
        if s >= end:
            return ACCEPTED
        s = to


@kernel(_nrt=False)
def march(environment, tubes, trace, pose, bend, s0, length, radius, clearance):
    """Follow one arc of the tube, from `s0` mm beyond the scope tip, and validate every point of it.

    In the lumen the axis moves freely, and cuts corners of voxels for up to CORNER_MM.  Where it
    leaves for longer, it has left for good: the wall is pierced within WALL_ZONE_MM, the axis meets no
    lumen again, and the tube keeps `clearance` from its surface to vessels, pleura, fissures and other
    branches.  Returns a reason, ACCEPTED if there is none.
    """
    labels, geometry = environment.labels, environment.geometry
    s = last = 0.0
    while True:
        if trace[PHASE] == IN_LUMEN:
            x, y, z = point_on_arc(pose, bend, s)
            if label_at(labels, geometry, x, y, z) & LUMEN:
                if s >= length:
                    return ACCEPTED
                last = s
                step = _lumen_step(environment, trace, x, y, z, s0 + s, radius, radius + clearance)
                s = min(s + step, length)
                continue
            if s0 + s == 0.0:
                return NO_EXIT
            _leave_lumen(environment, tubes, trace, pose, bend, last, s, s0)
        begin = max(trace[LEFT_AT] - s0, 0.0)
        if trace[PHASE] == LEAVING:
            left = trace[LEFT_AT] + CORNER_MM - s0
            s = _first_in_lumen(environment, pose, bend, begin, min(left, length))
            if s >= 0.0:
                trace[PHASE] = IN_LUMEN
                last = s
                continue
            if left <= length:
                if trace[REFUSAL] != ACCEPTED:
                    return int(trace[REFUSAL])
                trace[PHASE] = IN_WALL
        reason = _march_beyond(environment, tubes, trace, pose, bend, s0, begin, length, radius, clearance)
        if trace[PHASE] != LEAVING:
            return reason
        if trace[REFUSAL] == ACCEPTED:
            trace[REFUSAL] = reason
        return ACCEPTED


@kernel(_nrt=False)
def reset(trace):
    """Put a trace at the scope tip, in the lumen."""
    trace[:] = 0.0
    trace[BRANCH] = -1.0
