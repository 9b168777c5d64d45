"""Validation of one deployment, and the enumeration of all planar deployments from one scope tip.

`environment` and `trace` are those of `wall_exit`, `tubes` is the array of `planar`.
"""

from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from stages.tube.kernels import planar, wall_exit
from stages.tube.kernels.shapes import CURVATURE, DIRECTION, LENGTH, RADIUS, bend_towards, carried

# Columns of an enumerated deployment: site, rotation (indices), outer and inner insertion (mm),
# pierced branch, arc length at the exit (mm), wall angle (rad), run in the wall (mm), tip pose (6).
ENTRY_TIP = 8
ENTRY_COLUMNS = 14


@kernel(nogil=True)
def validate_deployment(environment, tubes, base, normal, outer, inner, trace, tip):
    """Validate one planar deployment from the scope tip pose `base`, bending towards `normal`.

    Fills `trace` and `tip` (9,): tip pose and the normal there.  Returns a reason.
    """
    wall_exit.reset(trace)
    if inner > tubes[planar.MAX_EXTENSION]:
        return wall_exit.TOO_LONG
    if inner - outer > tubes[planar.MAX_PROTRUSION]:
        return wall_exit.PROTRUDES
    sweep = planar.lateral_sweep(tubes, outer, inner)
    if sweep > tubes[planar.MAX_SWEEP]:
        return wall_exit.SWEEPS
    clearance = tubes[planar.MARGIN] + sweep
    pose = (base[0], base[1], base[2], base[3], base[4], base[5])
    towards = (normal[0], normal[1], normal[2])
    for start, stop, kappa, radius in planar.tube_pieces(tubes, outer, inner):
        if stop - start <= 0.0:
            continue
        reason, pose, towards = wall_exit.advance(
            environment, tubes, trace, pose, towards, kappa, start, stop, radius, clearance
        )
        if reason != wall_exit.ACCEPTED:
            return reason
    for m in range(6):
        tip[m] = pose[m]
    for m in range(3):
        tip[6 + m] = towards[m]
    return wall_exit.ACCEPTED if trace[wall_exit.PHASE] == wall_exit.IN_TISSUE else wall_exit.NO_EXIT


@kernel(nogil=True)
def validate_arcs(environment, tubes, base, normal, arcs, beside, trace, tip):
    """Validate a shape of any tubes from the scope tip pose `base`.

    Directions of `arcs` (a, ARC_COLUMNS) count from `normal`; `beside` mm beside radius and margins have to
    be free.  Fills `trace` and `tip` as `validate_deployment` does, with the normal carried along without
    turning.  Returns a reason.
    """
    wall_exit.reset(trace)
    pose = (base[0], base[1], base[2], base[3], base[4], base[5])
    across = (normal[0], normal[1], normal[2])
    clearance, at = tubes[planar.MARGIN] + beside, 0.0
    for a in range(arcs.shape[0]):
        length, direction = arcs[a, LENGTH], arcs[a, DIRECTION]
        bend = bend_towards(pose, across, direction, arcs[a, CURVATURE])
        reason = wall_exit.march(
            environment, tubes, trace, pose, bend, at, length, arcs[a, RADIUS], clearance
        )
        if reason != wall_exit.ACCEPTED:
            return reason
        pose, across = carried(pose, across, bend, direction, length)
        at += length
    for m in range(6):
        tip[m] = pose[m]
    for m in range(3):
        tip[6 + m] = across[m]
    return wall_exit.ACCEPTED if trace[wall_exit.PHASE] == wall_exit.IN_TISSUE else wall_exit.NO_EXIT


@inner_kernel
def tip_of_arcs(base, normal, arcs):
    """Return the pose at the end of a shape's arcs; see `validate_arcs`."""
    pose = (base[0], base[1], base[2], base[3], base[4], base[5])
    across = (normal[0], normal[1], normal[2])
    for a in range(arcs.shape[0]):
        bend = bend_towards(pose, across, arcs[a, DIRECTION], arcs[a, CURVATURE])
        pose, across = carried(pose, across, bend, arcs[a, DIRECTION], arcs[a, LENGTH])
    return pose


@kernel()
def _record(entries, row, site, rotation, outer, inner, trace, pose, reasons):
    """Write an accepted deployment; return the number of rows written, 0 if it does not leave the airway."""
    if trace[wall_exit.PHASE] != wall_exit.IN_TISSUE:
        reasons[wall_exit.NO_EXIT] += 1
        return 0
    entry = entries[row]
    entry[0] = site
    entry[1] = rotation
    entry[2] = outer
    entry[3] = inner
    entry[4] = trace[wall_exit.BRANCH]
    entry[5] = trace[wall_exit.LEFT_AT]
    entry[6] = trace[wall_exit.WALL_ANGLE]
    entry[7] = trace[wall_exit.WALL_RUN]
    for m in range(6):
        entry[ENTRY_TIP + m] = pose[m]
    return 1


@merged_kernel
def _last_row(wanted):
    """Return the last row (S, S) in which anything is wanted, -1 if there is none."""
    last = wanted.shape[0] - 1
    while last >= 0 and not wanted[last].any():
        last -= 1
    return last


@kernel(nogil=True)
def enumerate_site(environment, tubes, base, normals, site, stops, wanted, entries, reasons, work):
    """Enumerate the deployments from one site that follow their own track exactly.

    The outer tube stops at `stops[m]`, the inner at `stops[m + 1]` and beyond, up to the curved
    length, so a longer deployment shares its beginning with the shorter ones: each piece is validated once.

    Parameters
    ----------
    environment : TubeEnvironment
    tubes : (N_TUBES,) float64
    base : (6,) float64
        Scope tip pose.
    normals : (T, 3) float64
        Bending direction of each rotation.
    site : int
    stops : (S,) float64
        Insertions in mm, increasing from 0.
    wanted : (T, S, S) bool
        Which are looked at, by rotation and the stops of outer and inner tube; none with the inner behind
        the outer, or both at 0.
    entries : (rows, ENTRY_COLUMNS) float64
        Receives the accepted deployments; at least as many rows as are wanted.
    reasons : (N_REASONS,) int64
        Counts the refused ones by reason.
    work : (2, N_TRACE) float64
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
    margin = tubes[planar.MARGIN]
    for t in range(normals.shape[0]):
        outermost = _last_row(wanted[t])
        wall_exit.reset(outer_trace)
        pose = (base[0], base[1], base[2], base[3], base[4], base[5])
        towards = (normals[t, 0], normals[t, 1], normals[t, 2])
        for m in range(outermost + 1):
            if m > 0:
                reason, pose, towards = wall_exit.advance(
                    environment, tubes, outer_trace, pose, towards, tubes[planar.OVERLAP_CURVATURE],
                    stops[m - 1], stops[m], tubes[planar.OUTER_RADIUS], margin,
                )  # fmt: skip
                if reason != wall_exit.ACCEPTED:
                    reasons[reason] += wanted[t, m:].sum()
                    break
                if wanted[t, m, m]:
                    count += _record(entries, count, site, t, stops[m], stops[m], outer_trace, pose, reasons)
            innermost = n_stops - 1
            while innermost > m and not wanted[t, m, innermost]:
                innermost -= 1
            for n in range(work.shape[1]):
                inner_trace[n] = outer_trace[n]
            inner_pose = pose
            inner_towards = towards
            for e in range(m + 1, innermost + 1):
                reason = wall_exit.PROTRUDES
                if stops[e] - stops[m] <= tubes[planar.MAX_PROTRUSION]:
                    reason, inner_pose, inner_towards = wall_exit.advance(
                        environment, tubes, inner_trace, inner_pose, inner_towards,
                        tubes[planar.INNER_CURVATURE], stops[e - 1], stops[e],
                        tubes[planar.INNER_RADIUS], margin,
                    )  # fmt: skip
                if reason != wall_exit.ACCEPTED:
                    reasons[reason] += wanted[t, m, e:].sum()
                    break
                if wanted[t, m, e]:
                    count += _record(
                        entries, count, site, t, stops[m], stops[e], inner_trace, inner_pose, reasons
                    )
    return count
