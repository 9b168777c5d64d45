"""Divides the phases into stretches in which a plan is proved clear and on target, or is not."""

import math

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from anatomy.kernels.field import distance_bound, exact_distance
from anatomy.kernels.labels import AIRWAY, LUMEN
from anatomy.kernels.motion import displacement_at
from lungaccess.uncertainty.breathing.kernels import rules
from lungaccess.uncertainty.breathing.kernels.rigid import carried, rate_bounds, turned

FIRST_STRETCHES = 8
"""Stretches to begin with; few plans are proved in a wider one at once."""
LEAST_WIDTH = 2.0**-11
"""A stretch of phases that is not divided any further: 0.05 % of the breath."""
MOST_LEAVES = 4096
"""More stretches than there are of the least width."""
HAZARD_WIDTH = 2.0**-7
"""In a part of a wider stretch a tube may come free of the wall, and what lies behind it does not count."""
FIRST_HOP = 8
"""Points along the devices by which the search for where a rule is broken begins: 0.4 mm."""
BEGIN, END, KIND, KEPT, RADIUS = range(5)
"""Columns of the table of sections: first and last point, rule, required clearance and radius, mm."""

_LUMEN = np.int64(LUMEN)
_NOBODY = np.int64(-1)


@merged_kernel
def stretch_between(rigid, amplitude, reference, begin, end):
    """Return the stretch of the phases from `begin` to `end`."""
    share = amplitude * (0.5 * (begin + end) - reference)
    half = 0.5 * amplitude * (end - begin)
    rotation, rate = np.zeros((3, 3)), np.zeros((3, 3))
    turned(rigid.gradient, share, rotation, rate)
    most_rate, most_change = rate_bounds(rigid.gradient, abs(share) + half)
    return rules.Stretch(share, half, rotation, rate, most_rate, most_change)


@inner_kernel
def miss_of_target(breath, rigid, stretch, end, target):
    """Return the distance of a point of the devices from a place of the masks, and how it changes, mm."""
    qx, qy, qz, vx, vy, vz = carried(
        rigid, stretch.share, stretch.rotation, stretch.rate, end[0], end[1], end[2]
    )
    dx, dy, dz = displacement_at(breath.nodes, breath.frame, target[0], target[1], target[2])
    ex, ey, ez = qx - target[0], qy - target[1], qz - target[2]
    miss = math.sqrt(
        (ex - stretch.share * dx) ** 2 + (ey - stretch.share * dy) ** 2 + (ez - stretch.share * dz) ** 2
    )
    speed = math.sqrt((vx - dx) ** 2 + (vy - dy) ** 2 + (vz - dz) ** 2)
    lx, ly, lz = end[0] - rigid.centre[0], end[1] - rigid.centre[1], end[2] - rigid.centre[2]
    lever = math.sqrt(lx * lx + ly * ly + lz * lz)
    return miss, stretch.half * (speed + stretch.half * stretch.most_change * lever)


@inner_kernel
def _point_at(points, arc, n, s, ahead, out, at):
    """Fill `out` (3,) with the point at arc length `s`, between `n` and `n + 1`, and `at[3:]` with its way.

    The way leads to the point `ahead`; how far that is along the devices is returned.
    """
    width = arc[n + 1] - arc[n]
    share = (s - arc[n]) / width if width > 0.0 else 0.0
    for axis in range(3):
        out[axis] = points[n, axis] + share * (points[n + 1, axis] - points[n, axis])
        at[3 + axis] = points[ahead, axis] - out[axis]
    return abs(arc[ahead] - s)


@inner_kernel
def _step_at(tissue, breath, rigid, stretch, point, row, guess):
    """Return the proved step at a point by the rule of its section, and the reason that limits it."""
    rest, speed, lever = rules.place(breath, rigid, stretch, point, guess)
    kind = int(row[KIND])
    if kind == rules.IN_LUMEN:
        return rules.step_in_lumen(tissue, breath, stretch, guess, rest, speed, lever), rules.LEAVES_LUMEN
    return rules.step_of(tissue, breath, stretch, guess, rest, speed, lever, kind, row[KEPT], row[RADIUS])


@merged_kernel
def _refusal_in_section(tissue, breath, rigid, stretch, points, arc, row, done, guess):
    """Return the first point of a section, from `done` on, that is not proved, -1 if all are, and why."""
    n, last = max(int(row[BEGIN]), done), int(row[END])
    point = np.zeros(3)
    s = arc[n]
    while True:
        while n < last - 1 and arc[n + 1] <= s:
            n += 1
        rest = _point_at(points, arc, n, s, n + 1, point, guess)
        step, reason = _step_at(tissue, breath, rigid, stretch, point, row, guess)
        if step < min(rules.LEAST_STEP_MM, rest):
            return n, reason
        if s >= arc[last]:
            return -1, 0
        s = min(s + step, arc[last])


@inner_kernel
def _hazard_at(tissue, breath, rigid, stretch, point, row, guess):
    """Return the proved step back from a point in the lumen, infinite where the tube is free of the wall."""
    rest, speed, lever = rules.place(breath, rigid, stretch, point, guess)
    depth = distance_bound(tissue.lumen, tissue.lumen_geometry, guess[0], guess[1], guess[2])
    reach = min(depth, rules.MOST_MM)
    if rules.step_left(stretch, breath, guess, rest, speed, lever, reach, row[RADIUS]) >= 0.0:
        return math.inf, 0
    bits = np.int64(tissue.bits & ~AIRWAY)
    return rules.step_clear_of(tissue, breath, stretch, guess, rest, speed, lever, bits, _NOBODY, row[KEPT])


@merged_kernel
def _comes_free(tissue, breath, rigid, stretch, points, sections, first, guess):
    """Tell whether a tube is free of the wall somewhere between a point and its exit."""
    for s in range(sections.shape[0]):
        row = sections[s]
        if int(row[KIND]) > rules.BEFORE_WALL:
            continue
        for n in range(max(first, int(row[BEGIN])), int(row[END]) + 1):
            if _hazard_at(tissue, breath, rigid, stretch, points[n], row, guess)[0] == math.inf:
                return True
    return False


@merged_kernel
def _hazard(tissue, breath, rigid, stretch, points, arc, sections, guess):
    """Return the first point, back from the exit, where what lies behind the wall is not proved clear.

    Where the tube is free of the wall, what it did before does not count.
    """
    point = np.zeros(3)
    for at in range(sections.shape[0] - 1, -1, -1):
        row = sections[at]
        if int(row[KIND]) != rules.IN_LUMEN and int(row[KIND]) != rules.BEFORE_WALL:
            continue
        first = int(row[BEGIN])
        n, s = int(row[END]) - 1, arc[int(row[END])]
        while True:
            while n > first and arc[n] > s:
                n -= 1
            rest = _point_at(points, arc, n, s, n if arc[n] < s else max(n - 1, first), point, guess)
            step, reason = _hazard_at(tissue, breath, rigid, stretch, point, row, guess)
            if step == math.inf:
                return -1, 0
            if step < min(rules.LEAST_STEP_MM, rest):
                if _comes_free(tissue, breath, rigid, stretch, points, sections, n, guess):
                    return -1, 0
                return n, reason
            if s <= arc[first]:
                break
            s = max(s - step, arc[first])
    return -1, 0


@inner_kernel
def _row_of(sections, n):
    """Return the section of a point; of two that share it, the first."""
    for s in range(sections.shape[0]):
        if sections[s, BEGIN] <= n <= sections[s, END]:
            return s
    return 0


@kernel()
def refusal(tissue, breath, rigid, stretch, points, arc, sections, suspect, done):
    """Return a point at which a stretch is not proved clear, -1 if it is, the reason, and the next `done`.

    `suspect`, a point that refused a wider stretch by the rule of its section, is looked at first; -1: none.
    Points before `done` obey the rules of their sections in a wider stretch, and so in this one.
    """
    guess = np.zeros(6)
    if suspect >= 0:
        guess[:3] = points[suspect]
        row = sections[_row_of(sections, suspect)]
        step, reason = _step_at(tissue, breath, rigid, stretch, points[suspect], row, guess)
        if step < 0.0:
            return suspect, reason, done
    guess[:3] = points[min(done, points.shape[0] - 1)]
    for s in range(sections.shape[0]):
        row = sections[s]
        if int(row[KIND]) != rules.BEFORE_WALL and done <= int(row[END]):
            n, reason = _refusal_in_section(tissue, breath, rigid, stretch, points, arc, row, done, guess)
            if n >= 0:
                return n, reason, n
    n, reason = _hazard(tissue, breath, rigid, stretch, points, arc, sections, guess)
    return n, reason, points.shape[0]


@inner_kernel
def _excess(tissue, breath, rigid, stretch, point, row, reason, guess):
    """Return a bound of the clearance less what is required that holds in all phases of the stretch."""
    rest, speed, lever = rules.place(breath, rigid, stretch, point, guess)
    kind = int(row[KIND])
    if reason == rules.LEAVES_LUMEN:
        out, _label = exact_distance(
            tissue.labels, tissue.geometry, guess[0], guess[1], guess[2], _LUMEN, _NOBODY, 1.0
        )
        allowed = rules.CORNER_MM - 2.0 * breath.hysteresis * lever
        return -rules.step_left(stretch, breath, guess, rest, speed, lever, out, allowed)
    bits, branch = tissue.bits, tissue.branch
    if kind == rules.NEEDLE:
        branch = _NOBODY
    elif kind == rules.IN_LUMEN or kind == rules.BEFORE_WALL:
        bits, branch = np.int64(bits & ~AIRWAY), _NOBODY
    _step, over, _label = rules.gap_to_voxels(
        tissue, breath, stretch, guess, rest, speed, lever, bits, branch, row[KEPT]
    )
    if kind == rules.TUBE or kind == rules.NEEDLE_AT_EXIT:
        kept = row[RADIUS] if kind == rules.NEEDLE_AT_EXIT else rules.OUT_OF_LUMEN_MM
        _step, lumen, _label = rules.gap_to_voxels(
            tissue, breath, stretch, guess, rest, speed, lever, _LUMEN, _NOBODY, kept
        )
        over = min(over, lumen)
    return over


@merged_kernel
def _surely(tissue, breath, rigid, stretch, points, sections, n, reason):
    """Tell whether a rule is broken in all phases of the stretch, near a point that is not proved, and where.

    Less than BROKEN_MM to spare counts as broken.  The search goes along the section to where less and less
    is left.
    """
    row = sections[_row_of(sections, n)]
    guess = np.zeros(6)
    guess[:3] = points[n]
    best = _excess(tissue, breath, rigid, stretch, points[n], row, reason, guess)
    hop = FIRST_HOP
    while hop >= 1 and best >= rules.BROKEN_MM:
        better = False
        for m in (n + hop, n - hop):
            if row[BEGIN] <= m <= row[END]:
                guess[:3] = points[m]
                over = _excess(tissue, breath, rigid, stretch, points[m], row, reason, guess)
                if over < best:
                    best, n, better = over, m, True
                    break
        if not better:
            hop //= 2
    return best < rules.BROKEN_MM, n


@kernel()
def divide(
    tissue,
    breath,
    rigid,
    points,
    arc,
    sections,
    target,
    tolerance,
    hole,
    hole_limit,
    amplitude,
    reference,
    asked,
    all_of_it,
    leaves,
):
    """Fill `leaves` (MOST_LEAVES, 5) with stretches in order; return how many there are.

    Columns: first and last phase; CLEAR, BLOCKED or UNDECIDED; reason, and point, of what is not clear.
    Stretches without a phase between the two `asked` are left out; `all_of_it` tells whether to go on behind
    the first that is not clear.
    """
    stack = np.zeros((64, 4))
    top = 0
    for n in range(FIRST_STRETCHES - 1, -1, -1):
        stack[top, 0], stack[top, 1], stack[top, 2] = n / FIRST_STRETCHES, (n + 1) / FIRST_STRETCHES, -1.0
        top += 1
    count, last, exit_at = 0, points.shape[0] - 1, 0
    for s in range(sections.shape[0]):
        if sections[s, KIND] <= rules.BEFORE_WALL:
            exit_at = int(sections[s, END])
    while top > 0:
        top -= 1
        begin, end, suspect, done = stack[top, 0], stack[top, 1], int(stack[top, 2]), int(stack[top, 3])
        if end <= asked[0] or begin >= asked[1]:
            continue
        stretch = stretch_between(rigid, amplitude, reference, begin, end)
        miss, change = miss_of_target(breath, rigid, stretch, points[last], target)
        shift, shifts = miss_of_target(breath, rigid, stretch, hole, hole)
        state, reason, at = rules.CLEAR, 0, -1
        if not miss + change <= tolerance:
            state, reason, at, suspect = rules.UNDECIDED, rules.TARGET_MISSED, last, -1
            if miss - change > tolerance:
                state = rules.BLOCKED
        elif not shift + shifts <= hole_limit:
            state, reason, at, suspect = rules.UNDECIDED, rules.HOLE_SHIFTS, exit_at, -1
            if shift - shifts > hole_limit:
                state = rules.BLOCKED
        else:
            at, reason, done = refusal(tissue, breath, rigid, stretch, points, arc, sections, suspect, done)
            if at >= 0:
                state = rules.UNDECIDED
                blocked, at = _surely(tissue, breath, rigid, stretch, points, sections, at, reason)
                before_wall = sections[_row_of(sections, at), KIND] <= rules.BEFORE_WALL
                in_airway = reason != rules.LEAVES_LUMEN and before_wall
                # A place where the tube is free may yet make it count no more.
                suspect = -1 if in_airway else at
                if blocked and not (in_airway and end - begin > HAZARD_WIDTH):
                    state = rules.BLOCKED
        if state == rules.UNDECIDED and end - begin > LEAST_WIDTH:
            middle = 0.5 * (begin + end)
            for half, (first, until) in enumerate(((middle, end), (begin, middle))):
                stack[top + half, 0], stack[top + half, 1] = first, until
                stack[top + half, 2], stack[top + half, 3] = suspect, done
            top += 2
            continue
        leaves[count, 0], leaves[count, 1], leaves[count, 2] = begin, end, state
        leaves[count, 3], leaves[count, 4] = reason, at
        count += 1
        if state != rules.CLEAR and not all_of_it:
            break
    return count
