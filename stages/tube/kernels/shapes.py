"""All deployments of one design with given rotations of the rear ends, in the frame of the scope tip.

Every deployment is one step of insertion beyond another, its parent: all tubes go out with flush tips, and
each stops at its own insertion.  So the sequence to a deployment is the chain of its parents, and its
equilibrium is followed from that of its parent.
"""

import math

import numpy as np

from anatomy.kernels.arcs import normal_on_arc, point_on_arc, pose_on_arc
from anatomy.kernels.compiling import borrowing_kernel, inner_kernel, kernel, merged_kernel
from stages.tube.kernels.assembly import BENT, BENT_TUBE, FAR, NEAR, PIECE_COLUMNS, SOFTNESS, cut
from stages.tube.kernels.equilibrium import (
    TOLERANCE,
    cutting_scratch,
    least_determinant,
    newton,
    scratch_for,
    solving_scratch,
)
from stages.tube.kernels.pose import GAUSS, curvature, frames_at, lay
from stages.tube.kernels.sweep import sweep_of

LARGEST_STRAY_RAD = 0.1
"""Largest turn of a tip against its rear end in one step."""
UNSUSPICIOUS_RAD = 0.02
"""A smaller turn cannot be a jump that matters."""
SAME_BRANCH_RAD = 1e-6
LEAST_SHARE = 2.0**-12
"""The branch of equilibria is said to end where this share of a step fails."""
ARC_ERROR_MM = 0.005
"""Wanted error of each arc that replaces a piece of changing curvature: far below the margins of plans."""
MOST_ARCS = 12
"""In which a piece is cut at most; what error remains is stated."""

# Columns of an arc: length in mm; direction of its bend about the tangent, from +x of the frame that is
# carried along without turning; curvature; radius of the outermost tube.
LENGTH, DIRECTION, CURVATURE, RADIUS, ARC_COLUMNS = range(5)
# Columns of a result: the least determinant and the largest strain up to a deployment, sweep, error of
# following the leader, error of the arcs, length beyond the scope, and the tip frame as a pose.
LEAST, STRAIN, SWEEP, LEADER, ERROR, EXTENSION, TIP, SHAPE_COLUMNS = 0, 1, 2, 3, 4, 5, 6, 18


@inner_kernel
def _settled(design, base_angles, beta, step, tip_angles, scratch):
    """Solve from a guess; return the error of the base angles, the cutting, nodes and steps."""
    last = base_angles.shape[0] - 1
    pieces, moments, directions = cutting_scratch(design, last + 1)
    count, n_steps = cut(design, beta, step, pieces, moments, directions)
    cutting = (pieces, moments, directions, count)
    nodes, steps = scratch_for(n_steps, last + 1, last)
    worst = newton(design, cutting, base_angles, beta, nodes, steps, tip_angles, scratch, TOLERANCE)
    return worst, cutting, nodes, steps


@borrowing_kernel
def _largest(one, other):
    worst = 0.0
    for i in range(one.shape[0]):
        worst = max(worst, abs(one[i] - other[i]))
    return worst


@inner_kernel
def rear_ends(lengths, insertions):
    """Return where the rear ends of all bodies are; straight ones in the tubes end with the innermost."""
    found = insertions[0] - lengths
    for i in range(insertions.shape[0]):
        found[i] = insertions[i] - lengths[i]
    return found


@inner_kernel
def reach(design, base, turn, begin, end, step, tip_angles):
    """Follow a branch of stable equilibria to rear ends at `end`, turned on by `turn`, in steps as needed.

    `tip_angles` are those at `begin`, where the rear ends are turned by `base`, and become those at the end.
    Returns the least determinant on the way, 0 or less if the branch ends there; and cutting, nodes and steps
    at the end.
    """
    done, stride, least = 0.0, 1.0, 1.0
    tips, back = tip_angles.copy(), tip_angles.copy()
    scratch = solving_scratch(tips.shape[0])
    while True:
        share = min(done + stride, 1.0)
        moved = (share - done) * turn
        beta = begin + share * (end - begin)
        tips[:] = tip_angles + moved
        worst, cutting, nodes, steps = _settled(design, base + share * turn, beta, step, tips, scratch)
        here = worst < TOLERANCE
        determinant = least_determinant(nodes, beta, scratch) if here else -math.inf
        back[:] = tips - moved
        stray = _largest(back, tip_angles)
        here = here and determinant > 0.0 and stray <= LARGEST_STRAY_RAD
        if here and stray > UNSUSPICIOUS_RAD:
            there = begin + done * (end - begin)
            worst = _settled(design, base + done * turn, there, step, back, scratch)[0]
            here = worst < TOLERANCE and _largest(back, tip_angles) <= SAME_BRANCH_RAD
        if here:
            done = share
            tip_angles[:] = tips
            least = min(least, determinant)
            if done == 1.0:
                return least, cutting, nodes, steps
        else:
            stride *= 0.5
            if stride < LEAST_SHARE:
                return min(determinant, 0.0), cutting, nodes, steps


@borrowing_kernel
def largest_strain(design, strained, beta, cutting, nodes, steps, first=0):
    """Return the largest strain of bending ahead of the scope tip, of all bodies from the first named on."""
    pieces, moments, directions, _count = cutting
    psi, rate = nodes[1], nodes[2]
    worst = 0.0
    for at in range(steps[0].shape[0]):
        k = steps[1][at]
        middle = 0.5 * (pieces[k, NEAR] + pieces[k, FAR])
        for end in range(2):
            x, y = curvature(cutting, k, float(end), steps[0][at], psi, rate, at)
            for i in range(first, strained.shape[0]):
                if beta[i] + design[1][i] < middle:
                    continue
                off = math.hypot(x, y)
                if i < psi.shape[1]:
                    own = moments[k, i] / pieces[k, PIECE_COLUMNS + i]
                    angle = psi[at + end, i] + directions[k, i]
                    off = math.hypot(x - own * math.cos(angle), y - own * math.sin(angle))
                worst = max(worst, strained[i] * off)
    return worst


@merged_kernel
def _mean_curvature(cutting, nodes, steps, k, begin, end):
    """Return the mean curvature (x, y) of piece `k` between two arc lengths."""
    s, psi, rate, _dpsi, _drate = nodes
    x = y = 0.0
    for share in (GAUSS, 1.0 - GAUSS):
        at_mm = begin + share * (end - begin)
        at = min(max(np.searchsorted(s, at_mm, "right") - 1, 0), steps[0].shape[0] - 1)
        h = steps[0][at]
        u, v = curvature(cutting, k, (at_mm - s[at]) / h, h, psi, rate, at)
        x += 0.5 * u
        y += 0.5 * v
    return x, y


@borrowing_kernel
def _changes(cutting, nodes, steps, k):
    """Return by how much the curvature vector changes along piece `k`, at most, and its size there."""
    psi, rate = nodes[1], nodes[2]
    changed, size = 0.0, 0.0
    for at in range(steps[0].shape[0]):
        if steps[1][at] == k:
            x0, y0 = curvature(cutting, k, 0.0, steps[0][at], psi, rate, at)
            x1, y1 = curvature(cutting, k, 1.0, steps[0][at], psi, rate, at)
            changed += math.hypot(x1 - x0, y1 - y0)
            size = max(size, math.hypot(x0, y0), math.hypot(x1, y1))
    return changed, size


@merged_kernel
def _lay_arcs(design, radii, beta, cutting, nodes, steps, arcs, first, places):
    """Write the arcs of a deployment to `arcs`, from row `first` on.

    Fills `places` (rows, 4) with arc length and point of their ends and middles.  Returns the number of arcs,
    -1 if there is no room, and the largest error between two places.
    """
    pieces, _moments, _directions, count = cutting
    pose, across = (0.0, 0.0, 0.0, 0.0, 0.0, 1.0), (1.0, 0.0, 0.0)
    number, between = 0, 0.0
    for k in range(count):
        length = pieces[k, FAR] - pieces[k, NEAR]
        changed = _changes(cutting, nodes, steps, k)[0] if pieces[k, BENT] > 0.0 else 0.0
        # An arc in place of curvature that changes steadily by c over h mm strays by c h^2 / 12.
        share = math.ceil((changed * length * length / (12.0 * ARC_ERROR_MM)) ** (1.0 / 3.0))
        cuts = min(max(int(share), 1), MOST_ARCS)
        h = length / cuts
        between = max(between, changed / cuts * h * h / 64.0)
        outermost = 0
        for i in range(radii.shape[0]):
            if beta[i] + design[1][i] > 0.5 * (pieces[k, NEAR] + pieces[k, FAR]):
                outermost = i
        for m in range(cuts):
            begin = pieces[k, NEAR] + m * h
            if first + number >= arcs.shape[0] or 2 * number + 1 >= places.shape[0]:
                return -1, between
            x, y = 0.0, 0.0
            if pieces[k, BENT] > 0.0:
                x, y = _mean_curvature(cutting, nodes, steps, k, begin, begin + h)
            kappa, direction = math.hypot(x, y), math.atan2(-x, y) if x != 0.0 or y != 0.0 else 0.0
            arc = arcs[first + number]
            arc[LENGTH], arc[DIRECTION], arc[CURVATURE], arc[RADIUS] = h, direction, kappa, radii[outermost]
            bend = bend_towards(pose, across, direction, kappa)
            for part in range(1, 3):
                place = places[2 * number + part - 1]
                place[0] = begin + 0.5 * part * h
                place[1], place[2], place[3] = point_on_arc(pose, bend, 0.5 * part * h)
            pose, across = carried(pose, across, bend, direction, h)
            number += 1
    return number, between


@borrowing_kernel
def lay_out(design, radii, beta, cutting, nodes, steps, poses, arcs, first, places, scratch):
    """Write the arcs of a deployment; return their number, -1 if there is no room, and their error in mm."""
    number, error = _lay_arcs(design, radii, beta, cutting, nodes, steps, arcs, first, places)
    if number < 0:
        return -1, error
    found, angles, rates = scratch
    frames_at(cutting, nodes, steps, poses, places[: 2 * number, 0], found, angles, rates)
    worst = 0.0
    for m in range(2 * number):
        off = 0.0
        for axis in range(3):
            off += (found[m, 9 + axis] - places[m, 1 + axis]) ** 2
        worst = max(worst, off)
    return number, math.sqrt(worst) + error


@inner_kernel
def twists(bends):
    """Tell whether tubes can twist each other: at least two are bent."""
    bent = -1.0
    for b in range(bends.shape[0]):
        if bends[b, 3] != 0.0:
            if bent >= 0.0 and bends[b, 0] != bent:
                return True
            bent = bends[b, 0]
    return False


@inner_kernel
def strain_at_rest(bends, strained):
    """Return the largest strain of the tubes held straight in the scope."""
    worst = 0.0
    for b in range(bends.shape[0]):
        if bends[b, 3] > 0.0:
            worst = max(worst, strained[int(bends[b, 0])] * bends[b, 3])
    return worst


@inner_kernel
def lay_untwisted(design, radii, strained, base, beta, step, result, arcs):
    """Write the arcs of tubes that do not twist each other, which are exact; return how many there are.

    Raises the strain of `result` to that of the shape where it is less, and fills its error, length and tip.
    """
    lengths, n = design[1], radii.shape[0]
    pieces, moments, directions = cutting_scratch(design, n)
    count, _steps = cut(design, beta, step, pieces, moments, directions)
    pose, across = (0.0, 0.0, 0.0, 0.0, 0.0, 1.0), (1.0, 0.0, 0.0)
    for k in range(count):
        middle, outermost = 0.5 * (pieces[k, NEAR] + pieces[k, FAR]), 0
        kappa, direction = 0.0, 0.0
        if pieces[k, BENT] > 0.0:
            i = int(pieces[k, BENT_TUBE])
            kappa, angle = pieces[k, SOFTNESS] * moments[k, i], base[i] + directions[k, i]
            direction = math.atan2(-math.cos(angle), math.sin(angle))
        for i in range(n):
            if beta[i] + lengths[i] > middle:
                outermost = i
                off = abs(kappa - moments[k, i] / pieces[k, PIECE_COLUMNS + i])
                result[STRAIN] = max(result[STRAIN], strained[i] * off)
        arcs[k, LENGTH], arcs[k, DIRECTION] = pieces[k, FAR] - pieces[k, NEAR], direction
        arcs[k, CURVATURE], arcs[k, RADIUS] = kappa, radii[outermost]
        bend = bend_towards(pose, across, direction, kappa)
        pose, across = carried(pose, across, bend, direction, arcs[k, LENGTH])
    result[ERROR], result[EXTENSION] = 0.0, beta[0] + lengths[0]
    _x, _y, _z, tx, ty, tz = pose
    ax, ay, az = across
    beside = (ty * az - tz * ay, tz * ax - tx * az, tx * ay - ty * ax)
    for axis in range(3):
        row = result[TIP + 3 * axis :]
        row[0], row[1], row[2] = across[axis], beside[axis], pose[3 + axis]
        result[TIP + 9 + axis] = pose[axis]
    return count


@inner_kernel
def bend_towards(pose, across, direction, kappa):
    """Return the bend of an arc towards a direction about the tangent, counted from the normal `across`."""
    _x, _y, _z, tx, ty, tz = pose
    c, s = math.cos(direction), math.sin(direction)
    ax, ay, az = across
    bx, by, bz = ty * az - tz * ay, tz * ax - tx * az, tx * ay - ty * ax
    return kappa, c * ax + s * bx, c * ay + s * by, c * az + s * bz


@inner_kernel
def carried(pose, across, bend, direction, length):
    """Return pose and normal `across` at the end of an arc; the normal is carried without turning."""
    after = pose_on_arc(pose, bend, length)
    nx, ny, nz = normal_on_arc(pose, bend, length)
    _x, _y, _z, tx, ty, tz = after
    c, s = math.cos(direction), math.sin(direction)
    # The normal of the arc is `across` turned by the direction about the tangent; so back.
    bx, by, bz = ty * nz - tz * ny, tz * nx - tx * nz, tx * ny - ty * nx
    return after, (c * nx - s * bx, c * ny - s * by, c * nz - s * bz)


@kernel(nogil=True)
def follow_all(design, radii, strained, base, stops, states, parents, step, tips, results, first, arcs):
    """Follow all deployments with given rotations of the rear ends.

    Args:
        design (tuple): See `assembly`.
        radii, strained ((n,) float64): Outer radius of each tube, and its strain per change of curvature, mm.
        base ((n,) float64): Rotation of the rear ends, rad.
        stops ((K,) float64): Insertions, rising from 0, mm.
        states ((S, n) int64): Deployments as indices of stops, not rising from the innermost tube on; the
            first is all 0.
        parents ((S,) int64): Of each the deployment one stop before, -1 for the first; it is listed before.
        step (float): See `assembly.cut`.
        tips ((S, n) float64): Is filled with the angles at the tubes' own ends, rad.
        results ((S, SHAPE_COLUMNS) float64): Is filled; with a least determinant of 0 or less the tubes snap.
        first ((S + 1,) int64): Is filled: where the arcs of each deployment begin in `arcs`.
        arcs ((rows, ARC_COLUMNS) float64): Is filled.

    Returns:
        int: Number of arcs, -1 if there is no room for them.
    """
    n_states, n = states.shape
    n_stops = stops.shape[0]
    bodies = np.zeros((n_states, n_stops, 3))
    still = np.zeros(n)
    found, angles, rates = np.zeros((n_stops, 12)), np.zeros((n_stops, n)), np.zeros((n_stops, n))
    places = np.zeros((2 * MOST_ARCS * (1 + design[1].shape[0] + 2 * design[2].shape[0]), 4))
    scratch = np.zeros((places.shape[0], 12)), np.zeros((places.shape[0], n)), np.zeros((places.shape[0], n))
    tips[0] = base
    results[0] = 0.0
    results[0, LEAST] = 1.0
    results[0, STRAIN] = strain_at_rest(design[2], strained)
    for m in (0, 4, 8):
        results[0, TIP + m] = 1.0
    sagitta = 0.0
    first[0] = first[1] = 0
    for state in range(1, n_states):
        parent = parents[state]
        first[state + 1] = first[state]
        results[state] = results[parent]
        results[state, EXTENSION] = stops[states[state, 0]]
        if results[parent, LEAST] <= 0.0:
            continue
        begin = rear_ends(design[1], stops[states[parent]])
        end = rear_ends(design[1], stops[states[state]])
        tips[state] = tips[parent]
        least, cutting, nodes, steps = reach(design, base, still, begin, end, step, tips[state])
        results[state, LEAST] = min(results[parent, LEAST], least)
        if least <= 0.0:
            continue
        poses = np.zeros((steps[0].shape[0] + 1, 12))
        lay(cutting, nodes, steps, poses)
        results[state, TIP:] = poses[-1]
        out = states[state, 0] + 1
        frames_at(cutting, nodes, steps, poses, stops[:out], found, angles, rates)
        bodies[state, :out] = found[:out, 9:]
        strain = largest_strain(design, strained, end, cutting, nodes, steps)
        results[state, STRAIN] = max(results[parent, STRAIN], strain)
        number, error = lay_out(
            design, radii, end, cutting, nodes, steps, poses, arcs, first[state], places, scratch
        )
        if number < 0:
            return -1
        first[state + 1] += number
        results[state, ERROR] = error
        bent = arcs[first[state] : first[state + 1], CURVATURE].max()
        sagitta = max(sagitta, bent * (stops[1] - stops[0]) ** 2 / 8.0)
        results[state, SWEEP], results[state, LEADER] = sweep_of(bodies, states, parents, state, sagitta)
    return first[n_states]


@kernel(nogil=True)
def arcs_near(design, radii, base, beta, turn, end, step, tip_angles, result, arcs):
    """Lay the arcs of any joint values, reached straight from a deployment nearby; see `follow_all`.

    The rear ends of that deployment turn on by `turn` (n,) and go from `beta` to `end` (b,); `tip_angles`
    (n,) at the own ends are changed to those of the new one.  `result` is filled with the least determinant
    from there on, the error of the arcs, the length and the tip.

    Returns:
        int: Number of arcs, 0 if the tubes snap on the way, -1 if there is no room.
    """
    n = base.shape[0]
    least, cutting, nodes, steps = reach(design, base, turn, beta, end, step, tip_angles)
    result[LEAST], result[EXTENSION] = least, end[0] + design[1][0]
    if least <= 0.0:
        return 0
    poses = np.zeros((steps[0].shape[0] + 1, 12))
    lay(cutting, nodes, steps, poses)
    result[TIP:] = poses[-1]
    places = np.zeros((2 * MOST_ARCS * (1 + design[1].shape[0] + 2 * design[2].shape[0]), 4))
    scratch = np.zeros((places.shape[0], 12)), np.zeros((places.shape[0], n)), np.zeros((places.shape[0], n))
    number, error = lay_out(design, radii, end, cutting, nodes, steps, poses, arcs, 0, places, scratch)
    result[ERROR] = error
    return number
