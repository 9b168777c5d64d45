"""Compiled kernels of the tube stage: shape, sweep, wall exit, and the enumeration of deployments.

A straight outer tube and an inner tube with a precurved distal part, rotated together, need no
torsion: the centreline consists of arcs in one plane [Kuntz2015, sec. IV-B].  `tubes` is a `(10,)`
float64 array indexed by the constants below.  `scene` is the tuple (obstacle field, labels, their
geometry, obstacle bits, lumen depth, its geometry, which branches `(B,)` lie in the mediastinum and
must not be left).  `trace` is a `(5,)` float64 array that follows one tube from the lumen through the
wall into the tissue.
"""

from __future__ import annotations

import math

import numba

from anatomy.kernels.arcs import normal_on_arc, point_on_arc, pose_on_arc, sine_length, versine_length
from anatomy.kernels.field import EXACT_REACH_MM, MIN_GAP_MM, distance_bound, exact_distance, label_at
from anatomy.kernels.labels import AIRWAY, BRANCH_SHIFT, FISSURE, LUMEN, OUTSIDE, VESSEL

# tubes
OVERLAP_CURVATURE = 0
INNER_CURVATURE = 1
CURVED_LENGTH = 2
OUTER_RADIUS = 3
INNER_RADIUS = 4
MARGIN = 5
MIN_WALL_ANGLE = 6
MAX_SWEEP = 7
MAX_EXTENSION = 8
MAX_PROTRUSION = 9
N_TUBES = 10

# trace
PHASE = 0
LEFT_AT = 1
BRANCH = 2
WALL_ANGLE = 3
HAZARD = 4
N_TRACE = 5

IN_LUMEN = 0.0
IN_WALL = 1.0
IN_TISSUE = 2.0

# reasons why a deployment is refused
ACCEPTED = 0
NO_EXIT = 1
NEAR_VESSEL = 2
NEAR_PLEURA = 3
NEAR_FISSURE = 4
NEAR_OTHER_BRANCH = 5
REENTERS_LUMEN = 6
FLAT_EXIT = 7
SWEEPS = 8
TOO_LONG = 9
PROTRUDES = 10
LEAVES_MEDIASTINAL = 11
N_REASONS = 12

FINE_STEP_MM = 0.05
WALL_ZONE_MM = 1.0
OUT_OF_LUMEN_MM = 0.02
NORMAL_RADIUS_MM = 2.5
BISECTIONS = 12
SWEEP_SAMPLES = 100


@numba.njit(cache=True)
def _reason(label):
    """Translate the label of a voxel that is too near into a reason."""
    if label & VESSEL:
        return NEAR_VESSEL
    if label & OUTSIDE:
        return NEAR_PLEURA
    if label & FISSURE:
        return NEAR_FISSURE
    return NEAR_OTHER_BRANCH


@numba.njit(cache=True)
def planar_point(tubes, outer, inner, s):
    """Return (aside, ahead) of the centreline at arc length `s` for given insertions, in mm.

    The inner tube is curved over its last CURVED_LENGTH mm.  Inside the outer tube the two share the
    curvature `kappa E_i I_i / (E_i I_i + E_o I_o)`; beyond it the inner has its own.
    """
    straight = min(max(inner - tubes[CURVED_LENGTH], 0.0), s)
    shared = min(max(outer - straight, 0.0), s - straight)
    free = s - straight - shared
    angle = tubes[OVERLAP_CURVATURE] * shared
    aside = versine_length(tubes[OVERLAP_CURVATURE], shared)
    ahead = straight + sine_length(tubes[OVERLAP_CURVATURE], shared)
    out = versine_length(tubes[INNER_CURVATURE], free)
    along = sine_length(tubes[INNER_CURVATURE], free)
    aside += math.sin(angle) * along + math.cos(angle) * out
    ahead += math.cos(angle) * along - math.sin(angle) * out
    return aside, ahead


@numba.njit(cache=True)
def planar_points(tubes, outer, inner, arc_lengths, out):
    """Fill `out` (N, 2) with `planar_point` at `arc_lengths` (N,)."""
    for n in range(arc_lengths.shape[0]):
        out[n, 0], out[n, 1] = planar_point(tubes, outer, inner, arc_lengths[n])


@numba.njit(cache=True)
def _off_track(tubes, outer, inner, tip):
    """Return how far the point at arc length `tip` ends up from where the tip first got there, in mm."""
    x0, z0 = planar_point(tubes, min(tip, outer), tip, tip)
    x1, z1 = planar_point(tubes, outer, inner, tip)
    return math.hypot(x1 - x0, z1 - z0)


@numba.njit(cache=True)
def lateral_sweep(tubes, outer, inner):
    """Return the largest distance of a point of the body, at any step, from its final place, in mm.

    Steps as in [Kuntz2015]: both tubes to `outer` with flush tips, then the inner to `inner`.  While the
    straight part of the inner tube moves out, the bend behind it opens steadily, so each point is
    farthest from its final place when the tip first gets there: the sweep is also the error with which
    the tubes follow their leader.  While the tip is within the curved length of the scope it is 0.
    """
    curved = tubes[CURVED_LENGTH]
    if inner <= curved:
        return 0.0
    # It peaks sharply where the straight part leaves the scope or the outer tube; elsewhere it is smooth.
    worst = max(
        _off_track(tubes, outer, inner, curved), _off_track(tubes, outer, inner, min(outer + curved, inner))
    )
    for m in range(1, SWEEP_SAMPLES + 1):
        worst = max(worst, _off_track(tubes, outer, inner, inner * m / SWEEP_SAMPLES))
    return worst


@numba.njit(cache=True)
def _wall_normal(labels, geometry, x, y, z):
    """Return the outward unit normal of the lumen at a border point, in corner axes scaled to mm.

    It points away from the centroid of the lumen within NORMAL_RADIUS_MM.
    """
    u = geometry[0, 0] * x + geometry[0, 1] * y + geometry[0, 2] * z + geometry[0, 3]
    v = geometry[1, 0] * x + geometry[1, 1] * y + geometry[1, 2] * z + geometry[1, 3]
    w = geometry[2, 0] * x + geometry[2, 1] * y + geometry[2, 2] * z + geometry[2, 3]
    su = math.sqrt(geometry[0, 4])
    sv = math.sqrt(geometry[1, 4])
    sw = math.sqrt(geometry[2, 4])
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


@numba.njit(cache=True)
def wall_angle(labels, geometry, pose):
    """Return the angle in rad between a tangent and the lumen's border at its point; pi/2 is square on."""
    nu, nv, nw = _wall_normal(labels, geometry, pose[0], pose[1], pose[2])
    tx, ty, tz = pose[3], pose[4], pose[5]
    sine = 0.0
    for axis in range(3):
        along = geometry[axis, 0] * tx + geometry[axis, 1] * ty + geometry[axis, 2] * tz
        normal = nu if axis == 0 else (nv if axis == 1 else nw)
        sine += along * math.sqrt(geometry[axis, 4]) * normal
    return math.asin(min(max(sine, -1.0), 1.0))


@numba.njit(cache=True)
def _leave_lumen(scene, tubes, trace, pose, bend, inside, outside, s0):
    """Find where the axis leaves the lumen between two arc lengths of a piece, and judge the exit."""
    _field, labels, geometry, _bits, _lumen, _lumen_geometry, mediastinal = scene
    branch = int(trace[BRANCH])
    if branch < 0 or branch >= mediastinal.shape[0] or mediastinal[branch]:
        return LEAVES_MEDIASTINAL
    for _ in range(BISECTIONS):
        middle = 0.5 * (inside + outside)
        x, y, z = point_on_arc(pose, bend, middle)
        if label_at(labels, geometry, x, y, z) & LUMEN:
            inside = middle
        else:
            outside = middle
    trace[PHASE] = IN_WALL
    trace[LEFT_AT] = s0 + inside
    trace[WALL_ANGLE] = wall_angle(labels, geometry, pose_on_arc(pose, bend, inside))
    if trace[WALL_ANGLE] < tubes[MIN_WALL_ANGLE]:
        return FLAT_EXIT
    return int(trace[HAZARD])


@numba.njit(cache=True)
def _tissue_gap(scene, trace, x, y, z, required):
    """Return the clearance beyond `required` outside the lumen and the label that limits it.

    Exempt is the wall of the pierced branch; its lumen must stay out of reach of the axis.
    """
    field, labels, geometry, bits, _lumen, _lumen_geometry, _mediastinal = scene
    gap = distance_bound(field, geometry, x, y, z) - required
    if gap >= MIN_GAP_MM:
        return gap, 0
    reach = required + EXACT_REACH_MM
    distance, label = exact_distance(labels, geometry, x, y, z, bits, int(trace[BRANCH]), reach)
    gap = distance - required
    if trace[PHASE] == IN_TISSUE:
        lumen, _label = exact_distance(labels, geometry, x, y, z, LUMEN, -1, reach)
        if lumen - OUT_OF_LUMEN_MM < gap:
            return lumen - OUT_OF_LUMEN_MM, LUMEN
    return gap, label


@numba.njit(cache=True)
def _lumen_step(scene, trace, x, y, z, radius, required):
    """Note branch and hazards of a point in the lumen; return the step to the next one.

    Where the tube touches the wall, what lies behind it must be as clear as in the tissue, unless the
    tube comes free again before it leaves.
    """
    _field, labels, geometry, bits, lumen, lumen_geometry, _mediastinal = scene
    trace[BRANCH] = (label_at(labels, geometry, x, y, z) >> BRANCH_SHIFT) - 1
    depth = distance_bound(lumen, lumen_geometry, x, y, z)
    if depth >= radius:
        trace[HAZARD] = ACCEPTED
        return max(depth - radius, FINE_STEP_MM)
    reach = required + EXACT_REACH_MM
    distance, label = exact_distance(labels, geometry, x, y, z, bits & ~AIRWAY, -1, reach)
    if distance - required < FINE_STEP_MM:
        trace[HAZARD] = _reason(label)
        return max(0.5 * depth, FINE_STEP_MM)
    return max(min(0.5 * depth, distance - required), FINE_STEP_MM)


@numba.njit(cache=True)
def march(scene, tubes, trace, pose, bend, s0, length, radius, clearance):
    """Follow one arc of the tube, from `s0` mm beyond the scope tip, and judge every point of it.

    In the lumen the axis moves freely, and corners of voxels that it cuts for less than FINE_STEP_MM may
    go unnoticed.  Where it leaves, the wall is pierced within WALL_ZONE_MM; from
    there on the axis is out of every lumen, and the tube keeps `clearance` from its surface to
    vessels, pleura, fissures and other branches.  Returns a reason, ACCEPTED if there is none.
    """
    labels = scene[1]
    geometry = scene[2]
    required = radius + clearance
    s = 0.0
    last = 0.0
    while True:
        x, y, z = point_on_arc(pose, bend, s)
        if trace[PHASE] == IN_LUMEN:
            if label_at(labels, geometry, x, y, z) & LUMEN:
                step = _lumen_step(scene, trace, x, y, z, radius, required)
            elif s0 + s == 0.0:
                return NO_EXIT
            else:
                reason = _leave_lumen(scene, tubes, trace, pose, bend, last, s, s0)
                if reason != ACCEPTED:
                    return reason
                s = max(trace[LEFT_AT] - s0, 0.0)
                continue
        else:
            gap, label = _tissue_gap(scene, trace, x, y, z, required)
            if gap < MIN_GAP_MM:
                return REENTERS_LUMEN if label == LUMEN else _reason(label)
            step = gap
            if trace[PHASE] == IN_WALL:
                here = label_at(labels, geometry, x, y, z)
                if here & LUMEN and (here >> BRANCH_SHIFT) - 1 != int(trace[BRANCH]):
                    return REENTERS_LUMEN
                zone = trace[LEFT_AT] + WALL_ZONE_MM - s0
                if s >= zone:
                    trace[PHASE] = IN_TISSUE
                    continue
                step = min(step, max(zone - s, 1e-6))
        if s >= length:
            return ACCEPTED
        last = s
        s = min(s + step, length)


@numba.njit(cache=True)
def _advance(scene, tubes, trace, pose, normal, kappa, s0, s1, radius, clearance):
    """March along one arc; return the reason, and pose and bending direction at its end."""
    bend = (kappa, normal[0], normal[1], normal[2])
    reason = march(scene, tubes, trace, pose, bend, s0, s1 - s0, radius, clearance)
    return reason, pose_on_arc(pose, bend, s1 - s0), normal_on_arc(pose, bend, s1 - s0)


@numba.njit(cache=True)
def reset(trace):
    """Put a trace at the scope tip, in the lumen."""
    for m in range(trace.shape[0]):
        trace[m] = 0.0
    trace[BRANCH] = -1.0


@numba.njit(cache=True, nogil=True)
def deploy(scene, tubes, base, normal, outer, inner, trace, tip):
    """Judge one deployment from the scope tip pose `base`, bending towards `normal`.

    Fills `trace` and `tip` (9,): tip pose and the normal there.  Returns a reason.
    """
    reset(trace)
    if inner > tubes[MAX_EXTENSION]:
        return TOO_LONG
    if inner - outer > tubes[MAX_PROTRUSION]:
        return PROTRUDES
    sweep = lateral_sweep(tubes, outer, inner)
    if sweep > tubes[MAX_SWEEP]:
        return SWEEPS
    clearance = tubes[MARGIN] + sweep
    straight = max(inner - tubes[CURVED_LENGTH], 0.0)
    bounds = (
        (0.0, min(straight, outer), 0.0, tubes[OUTER_RADIUS]),
        (min(straight, outer), outer, tubes[OVERLAP_CURVATURE], tubes[OUTER_RADIUS]),
        (outer, max(straight, outer), 0.0, tubes[INNER_RADIUS]),
        (max(straight, outer), inner, tubes[INNER_CURVATURE], tubes[INNER_RADIUS]),
    )
    pose = (base[0], base[1], base[2], base[3], base[4], base[5])
    towards = (normal[0], normal[1], normal[2])
    for start, stop, kappa, radius in bounds:
        if stop - start <= 0.0:
            continue
        reason, pose, towards = _advance(
            scene, tubes, trace, pose, towards, kappa, start, stop, radius, clearance
        )
        if reason != ACCEPTED:
            return reason
    for m in range(6):
        tip[m] = pose[m]
    for m in range(3):
        tip[6 + m] = towards[m]
    return ACCEPTED if trace[PHASE] == IN_TISSUE else NO_EXIT


# Columns of an enumerated deployment: site, rotation (indices), outer and inner insertion (mm),
# pierced branch, arc length at the exit (mm), wall angle (rad), tip pose (6).
ENTRY_TIP = 7
ENTRY_COLUMNS = 13


@numba.njit(cache=True)
def _record(entries, row, site, rotation, outer, inner, trace, pose, reasons):
    """Write an accepted deployment; return the number of rows written, 0 if it does not leave the airway."""
    if trace[PHASE] != IN_TISSUE:
        reasons[NO_EXIT] += 1
        return 0
    entry = entries[row]
    entry[0] = site
    entry[1] = rotation
    entry[2] = outer
    entry[3] = inner
    entry[4] = trace[BRANCH]
    entry[5] = trace[LEFT_AT]
    entry[6] = trace[WALL_ANGLE]
    for m in range(6):
        entry[ENTRY_TIP + m] = pose[m]
    return 1


@numba.njit(cache=True, nogil=True)
def enumerate_site(scene, tubes, base, normals, site, stops, entries, reasons, work):
    """Enumerate the deployments from one site that follow their own track exactly.

    The outer tube stops at `stops[m]`, the inner at `stops[m + 1]` and beyond, up to the curved
    length, so a longer deployment shares its beginning with the shorter ones: each piece is judged once.

    Parameters
    ----------
    scene, tubes
        See the module.
    base : (6,) float64
        Scope tip pose.
    normals : (T, 3) float64
        Bending direction of each rotation.
    site : int
    stops : (S,) float64
        Insertions in mm, increasing from 0.
    entries : (rows, 13) float64
        Receives the accepted deployments; at least `T S (S + 1) / 2` rows.
    reasons : (12,) int64
        Counts the refused ones by reason.
    work : (2, 5) float64
        Scratch.

    Returns
    -------
    int
        Number of rows filled.
    """
    count = 0
    outer_trace = work[0]
    inner_trace = work[1]
    n_stops = stops.shape[0]
    margin = tubes[MARGIN]
    for t in range(normals.shape[0]):
        reset(outer_trace)
        pose = (base[0], base[1], base[2], base[3], base[4], base[5])
        towards = (normals[t, 0], normals[t, 1], normals[t, 2])
        for m in range(n_stops):
            if m > 0:
                reason, pose, towards = _advance(
                    scene, tubes, outer_trace, pose, towards, tubes[OVERLAP_CURVATURE],
                    stops[m - 1], stops[m], tubes[OUTER_RADIUS], margin,
                )  # fmt: skip
                if reason != ACCEPTED:
                    reasons[reason] += (n_stops - m) * (n_stops - m + 1) // 2
                    break
                count += _record(entries, count, site, t, stops[m], stops[m], outer_trace, pose, reasons)
            for n in range(work.shape[1]):
                inner_trace[n] = outer_trace[n]
            inner_pose = pose
            inner_towards = towards
            for e in range(m + 1, n_stops):
                reason = PROTRUDES
                if stops[e] - stops[m] <= tubes[MAX_PROTRUSION]:
                    reason, inner_pose, inner_towards = _advance(
                        scene, tubes, inner_trace, inner_pose, inner_towards, tubes[INNER_CURVATURE],
                        stops[e - 1], stops[e], tubes[INNER_RADIUS], margin,
                    )  # fmt: skip
                if reason != ACCEPTED:
                    reasons[reason] += n_stops - e
                    break
                count += _record(
                    entries, count, site, t, stops[m], stops[e], inner_trace, inner_pose, reasons
                )
    return count
