"""Tips that a bronchoscope reaches by turning in place, earlier and later ends of motions, errors of steps.

These errors are how far advance, twist and bend of a step may err before the body has no room left.
"""

import math
from typing import NamedTuple

import numpy as np

from anatomy.base.typed import Bool, Float, Int
from anatomy.kernels.compiling import borrowing_kernel, kernel, merged_kernel
from stages.scope.kernels.body import BLOCKED, move_along, nearest_setting, room_along, turn_room
from stages.scope.kernels.growth import BEND, CURVATURE, ROOM, TWIST, U, V

HALVINGS = 12
"""A tolerance is found to this power of a half of the most that is looked for."""
MOST_RAD = math.pi / 2.0
"""Larger errors of twist and bend are not looked for."""
MOST_MM = 10.0
"""Larger errors of an advance are not looked for."""
LONGEST_MM = 0.1
"""Longest step of the walk along a body; half of it is lost."""

POLAR_RAD = math.radians(15.0)
"""Tips are told apart by rings of so many degrees about the direction of the airway."""
AZIMUTHS = 8
SIDES = 3
"""And by whether they lie on the axis, or beside it before or behind the direction they are turned to."""
TRIES = 12
"""A kind is given up after so many tries: most are refused for the same wall."""
TWIST_TO, BEND_TO, BY_STRAIGHT, TIP_ROOM, TIP_CURVATURE, SOURCE = 9, 10, 11, 12, 13, 14
TIP_COLUMNS = 15
"""Columns of a tip: point, direction and +x, twist and bend to which the section turns, whether it is
straightened before, room on the whole way, largest curvature of the body, and the state before."""


class Places(NamedTuple):
    """Where tips may be, for kernels: N tree points, sorted into cells as wide as tips may be off the axis.

    points, tangents, first, second : (N, 3), the last three at right angles; wanted : (N,), whether tips may
    be there; slots : (2, N), where along the tree a point is, for tips that look along it and for others;
    low : (3,), corner of the cells; begins : (ci, cj, ck + 1), where those of a cell begin in `order` (N,).
    """

    points: Float
    tangents: Float
    first: Float
    second: Float
    wanted: Bool
    slots: Int
    low: Float
    begins: Int
    order: Int
    off_axis_mm: float
    least_cosine: float


@borrowing_kernel
def nearest_place(places, x, y, z):
    """Return the nearest tree point, -1 if a tip would be too far off the axis."""
    cell = places.off_axis_mm
    best = cell * cell
    nearest = -1
    i = int(math.floor((x - places.low[0]) / cell))
    j = int(math.floor((y - places.low[1]) / cell))
    k = int(math.floor((z - places.low[2]) / cell))
    ni, nj, nk = places.begins.shape
    for a in range(max(i - 1, 0), min(i + 2, ni)):
        for b in range(max(j - 1, 0), min(j + 2, nj)):
            row = places.begins[a, b]
            for at in range(row[min(max(k - 1, 0), nk - 1)], row[min(max(k + 2, 0), nk - 1)]):
                n = places.order[at]
                p = places.points[n]
                d2 = (p[0] - x) ** 2 + (p[1] - y) ** 2 + (p[2] - z) ** 2
                if d2 < best or (d2 == best and (nearest < 0 or n < nearest)):
                    best = d2
                    nearest = n
    return nearest


@borrowing_kernel
def kind_of(places, near, tip):
    """Return the group of a tip that is nearest to a tree point, and what the tip costs within it.

    Tips that lie on the axis and look along it are a kind of their own, with places of their own.  The
    others differ by angle from the axis, by the direction they are turned to, and by the side they lie on.
    The group is -1 if the tip looks too far aside.
    """
    axis, first, second = places.tangents[near], places.first[near], places.second[near]
    p = places.points[near]
    x, y, z = tip[0] - p[0], tip[1] - p[1], tip[2] - p[2]
    cosine = tip[3] * axis[0] + tip[4] * axis[1] + tip[5] * axis[2]
    if cosine < places.least_cosine:
        return -1, 0.0
    polar = math.acos(min(cosine, 1.0))
    ring = int(math.floor(polar / POLAR_RAD + 0.5))
    along = x * axis[0] + y * axis[1] + z * axis[2]
    off2 = max(x * x + y * y + z * z - along * along, 0.0)
    cost = off2 + (0.3 * abs(polar - ring * POLAR_RAD) / POLAR_RAD) ** 2
    side = 0
    # Nearer to the axis tips count as on it: about a voxel and a half.
    if off2 > 1.0**2:
        side = 1 if x * tip[3] + y * tip[4] + z * tip[5] - along * cosine >= 0.0 else 2
    if ring == 0 and side == 0:
        return places.slots[0, near], cost
    spoke = 0
    if ring > 0:
        azimuth = math.atan2(
            tip[3] * second[0] + tip[4] * second[1] + tip[5] * second[2],
            tip[3] * first[0] + tip[4] * first[1] + tip[5] * first[2],
        )
        spoke = int(math.floor((azimuth / (2.0 * math.pi) + 0.5) * AZIMUTHS)) % AZIMUTHS
    return places.slots[1, near] + (ring * AZIMUTHS + spoke) * SIDES + side, cost


@borrowing_kernel
def setting_beside(device, most_curvature, state, offset, own):
    """Return a section's curvature vector, twist, bend (inf: none) and by_straight beside a state's."""
    u = state[U] + offset[0]
    v = state[V] + offset[1]
    twist, bend, straight = state[TWIST], state[BEND], False
    if not own:
        twist, bend, straight = nearest_setting(
            twist, bend, u, v, device.length, device.least_bend, device.most_bend
        )
    elif not device.least_bend <= bend <= device.most_bend:
        bend = math.inf
    if math.hypot(u, v) > most_curvature:
        bend = math.inf
    return u, v, twist, bend, straight


@kernel()
def sort_tips(device, most_curvature, states, offsets, places, best, costs):
    """Put the cheapest tips beside states into groups `best` (G, TRIES), by rising `costs` (G, TRIES).

    A tip is the number n * C + c of state n and offset c; `offsets` (C, 2) are added to the curvature vector,
    the first of them stands for the state's own section.  -1 is no tip; such costs are infinite.
    """
    scratch, tip = np.zeros(12), np.zeros(6)
    most = best.shape[1]
    for n in range(states.shape[0]):
        for c in range(offsets.shape[0]):
            u, v, _, bend, _ = setting_beside(device, most_curvature, states[n], offsets[c], c == 0)
            if not math.isfinite(bend):
                continue
            move_along(states[n], u, v, device.length, scratch)
            near = nearest_place(places, scratch[9], scratch[10], scratch[11])
            if near < 0 or not places.wanted[near]:
                continue
            for k in range(3):
                tip[k] = scratch[9 + k]
                tip[3 + k] = scratch[6 + k]
            group, cost = kind_of(places, near, tip)
            if group < 0 or cost >= costs[group, most - 1]:
                continue
            at = most - 1
            while at > 0 and cost < costs[group, at - 1]:
                costs[group, at] = costs[group, at - 1]
                best[group, at] = best[group, at - 1]
                at -= 1
            costs[group, at] = cost
            best[group, at] = n * offsets.shape[0] + c


@kernel()
def first_free(walls, device, most_curvature, states, offsets, best, tips, near, places):
    """Fill `tips` (G, TIP_COLUMNS) with each group's first proved tip; `near` gets tree points, -1: none."""
    scratch = np.zeros(12)
    for group in range(best.shape[0]):
        near[group] = -1
        for number in best[group]:
            if number < 0:
                break
            n, c = number // offsets.shape[0], number % offsets.shape[0]
            state, row = states[n], tips[group]
            u, v, twist, bend, straight = setting_beside(device, most_curvature, state, offsets[c], c == 0)
            room = turn_room(
                walls, device.radius, device.length, state, state[TWIST], state[BEND], twist, bend, straight
            )
            if room < 0.0:
                continue
            move_along(state, u, v, device.length, scratch)
            near[group] = nearest_place(places, scratch[9], scratch[10], scratch[11])
            put_tip(state, twist, bend, device.length, row, scratch)
            row[TWIST_TO], row[BEND_TO], row[BY_STRAIGHT] = twist, bend, 1.0 if straight else 0.0
            row[TIP_ROOM] = min(room, state[ROOM])
            row[TIP_CURVATURE] = max(state[CURVATURE], math.hypot(u, v))
            row[SOURCE] = n
            break


@merged_kernel
def goes_by_straight(twist, bend, to_twist, to_bend):
    """Tell whether a change in place moves the section less if it is straightened before it twists."""
    change = math.hypot(to_bend - bend, max(abs(bend), abs(to_bend)) * (to_twist - twist))
    return change > abs(bend) + abs(to_bend)


@borrowing_kernel
def put_tip(base, twist, bend, length, tip, scratch):
    """Fill in point, direction and +x (9,) of the tip of a section."""
    cosine = math.cos(twist)
    sine = math.sin(twist)
    kappa = bend / length
    move_along(base, kappa * cosine, kappa * sine, length, scratch)
    for k in range(3):
        tip[k] = scratch[9 + k]
        tip[3 + k] = scratch[6 + k]
        tip[6 + k] = cosine * scratch[k] + sine * scratch[3 + k]


@merged_kernel
def last_slide(states):
    """Return the state from which the last advance begins, -1 if there is none."""
    for n in range(states.shape[0] - 2, -1, -1):
        if states[n + 1, 0] > states[n, 0]:
            return n
    return -1


@kernel()
def shifted_tips(walls, device, entry, states, shifts, tips, rooms):
    """Fill tips `(K, 9)` of motions whose base stops `shifts` (K,) mm beyond that of a proved one.

    The base stays on its way, or goes on along its last arc; there the section takes the last twist and bend.
    `rooms` (K,) become the room on what is new in such a motion, BLOCKED if it is not proved.
    Where there is no such way, the tip is that of the motion itself.
    """
    length = device.length
    base, moved, scratch = entry.copy(), entry.copy(), np.zeros(12)
    slide = last_slide(states)
    stop, twist, bend = states[-1]
    done = np.zeros(shifts.shape[0], dtype=np.bool_)
    rooms[:] = BLOCKED
    for n in range(slide + 1):
        begin, held_twist, held_bend = states[n]
        u = held_bend / length * math.cos(held_twist)
        v = held_bend / length * math.sin(held_twist)
        end = states[n + 1, 0] if n < slide else math.inf
        straight = goes_by_straight(held_twist, held_bend, twist, bend)
        for k in range(shifts.shape[0]):
            at = stop + shifts[k]
            if not begin <= at < end:
                continue
            done[k] = True
            move_along(base, u, v, at - begin, moved)
            put_tip(moved, twist, bend, length, tips[k], scratch)
            far = at - begin + length
            if at <= stop or room_along(walls, device.radius, base, u, v, 0.0, far, 0.0, math.inf) >= 0.0:
                rooms[k] = turn_room(
                    walls, device.radius, length, moved, held_twist, held_bend, twist, bend, straight
                )
        move_along(base, u, v, min(end, stop) - begin, base)
    for k in range(shifts.shape[0]):
        if not done[k]:
            put_tip(base, twist, bend, length, tips[k], scratch)


@borrowing_kernel
def _most_error(walls, radius, base, u, v, begin, end, growth, longer, wider, most):
    """Return the largest error, 0 to `most`, at which an arc has room from `begin` to `end` mm; 0 if none.

    An error of `x` makes the arc `longer * x` mm longer, and asks for `wider * x + growth` times s^2 mm of
    room `s` mm from the base.
    """
    low, high, error = 0.0, most, most
    for _ in range(HALVINGS + 1):
        room = room_along(
            walls, radius, base, u, v, begin, end + longer * error, wider * error + growth, LONGEST_MM
        )
        if room < 0.0:
            high = error
        elif error == most:
            return most
        else:
            low = error
        error = 0.5 * (low + high)
    return low


@kernel()
def step_tolerances(walls, radius, length, entry, states, finest, out):
    """Fill in by how much advance (mm), twist and bend (rad) may err in each step, `out` (M - 1, 3).

    Each holds for the whole step if all else is as stated.  A curvature vector that errs by D moves a place
    `s` mm from the base by no more than D s^2 / 2, where the section is and where it has laid the shaft
    in this step; a bend that errs by b has D = b / length, a twist that errs by t at the curvature kappa no
    more than kappa t.  A base that stands x mm before or behind its place, on an arc of curvature kappa,
    moves the place by no more than x (1 + kappa s).

    states : (M, 3) advance, twist and bend; finest : a change in place is looked at in pieces that move the
    tip by no more than this.
    """
    base = entry.copy()
    laid = 0.0
    for n in range(states.shape[0] - 1):
        advance, to_twist, to_bend = states[n + 1] - states[n]
        twist, bend = states[n, 1], states[n, 2]
        kappa = max(abs(bend), abs(states[n + 1, 2])) / length
        if advance > 0.0:
            u, v = bend / length * math.cos(twist), bend / length * math.sin(twist)
            far = length + advance
            spare = _most_error(walls, radius, base, u, v, 0.0, far, 0.0, 0.0, 0.5, MOST_RAD / length)
            out[n, 0] = _most_error(walls, radius, base, u, v, far, far, 0.0, 1.0, 0.0, MOST_MM)
            move_along(base, u, v, advance, base)
            laid = abs(bend) / length
        else:
            change = math.hypot(to_bend, kappa * length * to_twist) / length
            pieces = max(1, int(math.ceil(0.5 * change * length * length / finest)))
            spare, room = MOST_RAD / length, math.inf
            # Between two pieces each place is within a quarter of their change of one of them.
            growth = 0.25 * change / pieces
            for m in range(pieces + 1):
                at_twist, kappa_there = twist + m / pieces * to_twist, (bend + m / pieces * to_bend) / length
                u, v = kappa_there * math.cos(at_twist), kappa_there * math.sin(at_twist)
                spare = _most_error(walls, radius, base, u, v, 0.0, length, growth, 0.0, 0.5, spare)
                room = min(room, room_along(walls, radius, base, u, v, 0.0, length, growth, LONGEST_MM))
            out[n, 0] = min(MOST_MM, max(room, 0.0) / (1.0 + max(kappa, laid) * length))
        out[n, 1] = min(MOST_RAD, spare / max(kappa, 1e-12))
        out[n, 2] = spare * length
