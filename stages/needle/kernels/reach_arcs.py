"""Many points and many start poses: which points single arcs reach, and how well.

`starts` is `(E, 6)`: point and unit tangent of each start pose, LPS mm, neighbours in the list being alike;
`branches` (E,) the branch that each has pierced.  `order` (E,) is a permutation of them, and `mixed` `(6, E)`
holds the same poses in that order: reachable points then need few looks.  docs/theory/proofs.md derives how
far apart the arcs from one start to the points of a ball may be, which an obstacle rules out together.
"""

import math

import numpy as np

from anatomy.kernels.arcs import arc_to_point, point_on_arc
from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from anatomy.kernels.field import UNITS_PER_MM, distance_bound, exact_distance, interpolate_squared
from anatomy.kernels.labels import AIRWAY
from stages.needle.kernels.connections import single_arc_exceeds
from stages.needle.kernels.cost import inverse_clearance_on_arc
from stages.needle.kernels.proof import TINY, blocker_on_arc

DIRECT, SEARCHED, UNREACHED, NO_CLEARANCE = range(1, 5)

# Columns of `found`: estimated integral of 1 / clearance, least clearance beyond the exempt length (mm).
COST = 0
CLEARANCE = 1

LONGEST_JUMP = 256
JUMP_GROWTH = 4
"""Neighbours of the best start pose are tried 1, 4, 16, ... places away in the list, up to the longest."""
ROUNDS = 20
BLOCK = 512

# Typed numbers: a kernel is compiled once more for every literal that it is called with.
_NOBODY = np.int64(-1)


@inner_kernel
def least_clearance(obstacles, limits, pose, bend, length, s0, least):
    """Return a clearance that an arc is never below beyond the exempt length, at most `least`."""
    begin = min(max(limits.exempt_mm - s0, 0.0), length)
    # Step of the clearance that is stated; half of it is what the bound may be too low.
    count = max(int(math.ceil((length - begin) / 0.5)), 1)
    half = 0.5 * (length - begin) / count
    clearance, geometry = obstacles.clearance, obstacles.geometry
    for m in range(count + 1):
        x, y, z = point_on_arc(pose, bend, begin + (length - begin) * m / count)
        least = min(least, distance_bound(clearance, geometry, x, y, z) - half)
    return max(least, 0.0)


@inner_kernel
def _arc_cost(obstacles, limits, start, branch, q, below, hints, entry):
    """Return the estimated cost of the direct arc, inf if it breaks a limit, is not proved clear or costs
    `below`."""
    chord2, aside = inverted_aside(start, q)
    chord = math.sqrt(chord2)
    c = blocked_at(obstacles, limits, start, aside, 0.0, limits.exempt_mm, chord, hints[entry])
    if c >= 0.0:
        hints[entry] = c
        return math.inf
    pose = (start[0], start[1], start[2], start[3], start[4], start[5])
    length, bend, turn = arc_to_point(pose, q)
    if single_arc_exceeds(limits, bend, length, turn):
        return math.inf
    cost = -1.0
    if below < math.inf:
        cost = inverse_clearance_on_arc(obstacles, limits.cost_step_mm, pose, bend, length)
    if cost >= below or blocker_on_arc(obstacles, limits, pose, bend, length, 0.0, branch) != 0:
        return math.inf
    return (
        cost if cost >= 0.0 else inverse_clearance_on_arc(obstacles, limits.cost_step_mm, pose, bend, length)
    )


@inner_kernel
def _mark_candidates(limits, poses, q, radius, begin, end, marks):
    """Mark the poses `begin` to `end` whose arc to a point within `radius` of `q` may be within the limits.

    It needs no angles.  With a turn of at most `a`, the chord leans at most a / 2 from the start, so that the
    point lies in a cone; and it lies outside the circle of the tightest arc, which touches the start.
    """
    # Slightly too wide: rounding may not exclude what the arc itself would pass.
    lean = 0.5 * min(limits.max_angle_rad, limits.max_turn_rad)
    sine, cosine2 = 1.000001 * math.sin(lean), 0.999999 * math.cos(lean) ** 2
    kappa2 = 1.000001 * 0.25 * limits.kappa * limits.kappa
    outside = max(2.0 / limits.kappa - radius, 0.0) * radius if radius * limits.kappa < 1.0 else math.inf
    longest2 = (limits.max_length_mm + radius) * (limits.max_length_mm + radius)
    for m in range(begin, end):
        dx = q[0] - poses[0, m]
        dy = q[1] - poses[1, m]
        dz = q[2] - poses[2, m]
        h = dx * poses[3, m] + dy * poses[4, m] + dz * poses[5, m]
        chord2 = dx * dx + dy * dy + dz * dz
        aside2 = chord2 - h * h
        into = radius + sine * h
        seen2 = chord2 + outside
        marks[m - begin] = (
            (into > 0.0)
            & (aside2 <= kappa2 * seen2 * seen2)
            & (chord2 <= longest2)
            & (cosine2 * aside2 <= into * into)
        )


@inner_kernel
def _extend(obstacles, limits, starts, order, mixed, q, radius, marks, hints, chosen, near, count, scanned):
    """Add start poses whose arcs to the points within `radius` of `q` come into question, a block at a time.

    `chosen` receives their numbers and `near` the poses, in the mixed order; `count` are there already, from
    the first `scanned` of all.  Both are returned, grown; `count` is not if no more poses come into question.
    """
    total, before = mixed.shape[1], count
    while scanned < total and count == before:
        end = min(scanned + BLOCK, total)
        _mark_candidates(limits, mixed, q, radius, scanned, end, marks)
        for m in range(scanned, end):
            if not marks[m - scanned]:
                continue
            entry = order[m]
            if radius > 0.0 and is_blocked_bundle(obstacles, limits, starts[entry], q, radius, hints, entry):
                continue
            chosen[count] = entry
            for c in range(6):
                near[c, count] = mixed[c, m]
            count += 1
        scanned = end
    return count, scanned


@inner_kernel
def _best_of(obstacles, limits, starts, branches, chosen, poses, begin, end, q, wanted, hints, marks, state):
    """Try the entries `chosen` from `begin` to `end`, at most BLOCK, until `wanted` arcs are clear.

    `poses` are those of the entries.  `state` holds the cheapest clear arc, its start pose and the number of
    clear ones so far; it is returned.
    """
    best, found, clear = state
    _mark_candidates(limits, poses, q, 0.0, begin, end, marks)
    for m in range(begin, end):
        if not marks[m - begin]:
            continue
        entry = chosen[m]
        cost = _arc_cost(obstacles, limits, starts[entry], branches[entry], q, math.inf, hints, entry)
        if cost < math.inf:
            clear += 1
            if cost < best:
                best = cost
                found = entry
            if clear >= wanted:
                break
    return best, found, clear


@inner_kernel
def _improved(obstacles, limits, starts, branches, q, best, chosen, hints):
    """Move from the best start pose to its neighbours in the list as long as that is cheaper."""
    for _ in range(ROUNDS):
        centre = chosen
        jump = 1
        while jump <= LONGEST_JUMP:
            for side in range(2):
                other = centre + jump if side == 0 else centre - jump
                if 0 <= other < starts.shape[0]:
                    cost = _arc_cost(obstacles, limits, starts[other], branches[other], q, best, hints, other)
                    if cost < best:
                        best = cost
                        chosen = other
            jump *= JUMP_GROWTH
        if chosen == centre:
            break
    return best, chosen


@kernel(nogil=True)
def reach_by_arcs(
    obstacles, limits, starts, branches, order, mixed, points, visits, blocks, near, wanted, hints, kinds,
    found, entries
):  # fmt: skip
    """Try the single arcs to each point.

    A point counts as reached if one arc is proved clear.  The cheapest is taken of the first `wanted` clear
    ones in the mixed order and of those from the start poses of neighbouring points; then its neighbours in
    the list are tried as long as they are cheaper: a good arc, not the proved best.  Where none is clear,
    all have been tried.  The start poses that come into question are found once for the points of a block,
    as far as they are asked for: those whose arcs to all of the points are blocked at one place are passed
    over.

    Args:
        obstacles, limits: Obstacles, Limits.
        starts, branches, order, mixed: See the module.
        points: (N, 3) float64, LPS mm.
        visits ((N,) int64): The points in the order in which they are tried.
        blocks ((B + 1,) int64): Where in that order the points of each block begin, and N; those of a block
            should be close.
        near ((N, K) int64): Points near each; -1 for none.  Those that are tried later do not count.
        wanted (int): At least 1.
        hints ((E,) float64): Scratch; starts at 0, and says how far from its start each arc was blocked the
            last time, mm.
        kinds ((N,) int64): Receives DIRECT, UNREACHED or NO_CLEARANCE.
        found ((N, 2) float64): Receives cost and least clearance of what is reached.
        entries ((N,) int64): Receives the start pose of what is reached, else -1.
    """
    bits = obstacles.bits
    marks = np.zeros(BLOCK, dtype=np.uint8)
    chosen = np.zeros(len(order), dtype=np.int64)
    poses = np.zeros(mixed.shape)
    entries[:] = -1
    for block in range(len(blocks) - 1):
        members = visits[blocks[block] : blocks[block + 1]]
        centre, radius = _ball_around(points, members)
        total, scanned = 0, 0
        for n in members:
            q = (points[n, 0], points[n, 1], points[n, 2])
            # At the exit the airway may be nearer, but nothing else.
            distance, _label = exact_distance(
                obstacles.labels, obstacles.geometry, q[0], q[1], q[2], bits & ~AIRWAY, _NOBODY,
                limits.required_mm + 0.1,
            )  # fmt: skip
            if distance < limits.required_mm:
                kinds[n] = NO_CLEARANCE
                continue
            kinds[n] = UNREACHED
            state = (math.inf, entries[n], 0)
            begin = 0
            while state[2] < wanted:
                if begin == total:
                    total, scanned = _extend(
                        obstacles, limits, starts, order, mixed, centre, radius, marks, hints, chosen, poses,
                        total, scanned,
                    )  # fmt: skip
                    if begin == total:
                        break
                end = min(begin + BLOCK, total)
                state = _best_of(
                    obstacles, limits, starts, branches, chosen, poses, begin, end, q, wanted, hints, marks,
                    state,
                )  # fmt: skip
                begin = end
            best, entry, _clear = state
            if entry < 0:
                continue
            for other in near[n]:
                known = entries[other] if other >= 0 else -1
                if known >= 0 and known != entry:
                    cost = _arc_cost(obstacles, limits, starts[known], branches[known], q, best, hints, known)
                    if cost < best:
                        best, entry = cost, known
            best, entry = _improved(obstacles, limits, starts, branches, q, best, entry, hints)
            entries[n] = entry
            start = starts[entry]
            pose = (start[0], start[1], start[2], start[3], start[4], start[5])
            length, bend, _turn = arc_to_point(pose, q)
            kinds[n] = DIRECT
            found[n, COST] = best
            found[n, CLEARANCE] = least_clearance(obstacles, limits, pose, bend, length, 0.0, math.inf)


@merged_kernel
def _ball_around(points, members):
    """Return the centre and the radius of a ball that holds points, slightly too large."""
    centre = np.zeros(3)
    for c in range(3):
        low = high = points[members[0], c]
        for n in members:
            low, high = min(low, points[n, c]), max(high, points[n, c])
        centre[c] = 0.5 * (low + high)
    radius2 = 0.0
    for n in members:
        gap2 = 0.0
        for c in range(3):
            gap2 += (points[n, c] - centre[c]) ** 2
        radius2 = max(radius2, gap2)
    return (centre[0], centre[1], centre[2]), math.sqrt(radius2) * (1.0 + 1e-9)


@merged_kernel
def _is_blocked(obstacles, required, x, y, z):
    """Tell whether a point is nearer than `required` to an obstacle; exact distances only where in doubt."""
    total, spread = interpolate_squared(obstacles.clearance, obstacles.geometry, x, y, z)
    if total - spread >= required * required:
        return False
    # See `anatomy.kernels.field`: the true distance is at most this.
    if math.sqrt(total) + math.sqrt(spread) + 1.0 / UNITS_PER_MM < required:
        return True
    distance, _label = exact_distance(
        obstacles.labels, obstacles.geometry, x, y, z, obstacles.bits, _NOBODY, required
    )
    return distance < required


@merged_kernel
def _point_at_chord(start, aside, c):
    """Return the point of an arc that is `c` away from its start, for `aside` see `inverted_aside`."""
    wx, wy, wz = c * aside[0], c * aside[1], c * aside[2]
    ahead = math.sqrt(max(1.0 - wx * wx - wy * wy - wz * wz, 0.0))
    return (
        start[0] + c * (ahead * start[3] + wx),
        start[1] + c * (ahead * start[4] + wy),
        start[2] + c * (ahead * start[5] + wz),
    )


@inner_kernel
def inverted_aside(start, q):
    """Return the squared distance of a point and what tells the arc to it: half its curvature, sideways.

    Inversion about the start, `d -> d / |d|^2`, takes the circles that touch the start to straight lines
    along its tangent.  A line keeps its part across the tangent, which is returned (1/mm).
    """
    dx, dy, dz = q[0] - start[0], q[1] - start[1], q[2] - start[2]
    chord2 = dx * dx + dy * dy + dz * dz
    h = dx * start[3] + dy * start[4] + dz * start[5]
    share = 1.0 / max(chord2, TINY)
    return (chord2, (share * (dx - h * start[3]), share * (dy - h * start[4]), share * (dz - h * start[5])))


@merged_kernel
def _greatest_spread(aside, spread, c):
    """Return how far arcs whose `aside` differs by `spread` at most may be apart at `c` from the start; inf:
    unbounded."""
    sine = c * (math.sqrt(aside[0] ** 2 + aside[1] ** 2 + aside[2] ** 2) + spread)
    # Lean of a chord beyond which arcs of a bundle are not looked at together.
    return c * c * spread / math.sqrt(1.0 - sine * sine) if sine < 0.9 else math.inf


@inner_kernel
def _is_blocked_at(obstacles, limits, start, aside, spread, c):
    """Tell whether all arcs of a bundle are blocked at the distance `c` from their start."""
    required = limits.required_mm
    if spread > 0.0:
        required -= _greatest_spread(aside, spread, c)
    if required <= 0.0:
        return False
    x, y, z = _point_at_chord(start, aside, c)
    return _is_blocked(obstacles, required, x, y, z)


@inner_kernel
def _spread(chord, radius):
    """Return how much `inverted_aside` may differ within `radius` of a point that is `chord` away from the
    start."""
    return radius / (chord * (chord - radius)) if chord > radius else math.inf


@inner_kernel
def blocked_at(obstacles, limits, start, aside, spread, begin, end, hint):
    """Look for an obstacle at places of a bundle of arcs; return the place, -1 if none was met.

    A place is its distance from the start, as is `hint`, where one was met the last time and is looked first.
    Looked at are places from `begin` to `end`; no arc is exempt there, since none is shorter than its chord.
    """
    if hint >= begin and hint < end and _is_blocked_at(obstacles, limits, start, aside, spread, hint):
        return hint
    count = 1
    # Before their proof, arcs are looked at in places at most so far apart.
    while (end - begin) / count > 3.0:
        for m in range(count):
            c = begin + (end - begin) * (m + 0.5) / count
            if _is_blocked_at(obstacles, limits, start, aside, spread, c):
                return c
        count *= 2
    return -1.0


@merged_kernel
def is_blocked_bundle(obstacles, limits, start, q, radius, hints, entry):
    """Tell whether all arcs to the points within `radius` of `q` are blocked, as far as they are close."""
    chord2, aside = inverted_aside(start, q)
    chord = math.sqrt(chord2)
    spread = _spread(chord, radius)
    if spread == math.inf:
        return False
    # Arcs of a bundle are looked at together up to where they are about this share of the clearance apart.
    end = min(math.sqrt(0.7 * limits.required_mm / max(spread, TINY)), chord - radius)
    c = blocked_at(obstacles, limits, start, aside, spread, limits.exempt_mm, end, hints[entry])
    if c >= 0.0:
        hints[entry] = c
    return c >= 0.0
