"""The bending section of a bronchoscope in the lumen: its arc, the room around it, and changes in place.

A base frame is `(12,)`: the columns +x, +y and +z, and the point.  A section's curvature vector `(u, v)` in
1/mm lies in the plane of +x and +y: the section is an arc of that curvature which bends towards it.  An
advance carries the frame along the arc without roll (a Bishop frame), so that the vector keeps its parts.
"""

import math
from typing import NamedTuple

import numpy as np

from anatomy.base.typed import Float, UInt16
from anatomy.kernels.compiling import borrowing_kernel, kernel
from anatomy.kernels.field import EXACT_REACH_MM, MIN_GAP_MM, distance_bound, exact_distance
from anatomy.kernels.labels import OUTSIDE

EASY_MM = 0.15
"""Where the field's bound leaves so much room, voxels are not searched: a step could grow but little."""
STRAIGHT_RAD = 1e-4
"""Below this angle the series of an arc is exact in double precision."""
FINEST_MM = 0.02
"""A change in place is cut into pieces until the tip moves by less than this; then it is given up."""
MOST_TWIST_RAD = math.pi
"""A scope is twisted by at most half a turn each way: more than that a hand and its cables do not follow."""
BLOCKED = -1.0
"""The room of what is not proved to be free."""

# Typed numbers: a kernel is compiled once more for every literal that it is called with.
_NOBODY = np.int64(-1)
_OUTSIDE = np.int64(OUTSIDE)


class Walls(NamedTuple):
    """What is around the lumen, for kernels.

    solid : (ni, nj, nk) uint16, OUTSIDE where there is no lumen; geometry : (3, 6) of it, see
    `anatomy.kernels.field`; depth, depth_geometry : field of the depth in the lumen.
    """

    solid: UInt16
    geometry: Float
    depth: UInt16
    depth_geometry: Float


@borrowing_kernel
def arc_parts(kappa, length):
    """Return how far an arc goes ahead, and its way aside divided by its curvature."""
    angle = kappa * length
    if angle < STRAIGHT_RAD:
        return length * (1.0 - angle * angle / 6.0), 0.5 * length * length * (1.0 - angle * angle / 12.0)
    return math.sin(angle) / kappa, 2.0 * (math.sin(0.5 * angle) / kappa) ** 2


@borrowing_kernel
def move_along(base, u, v, length, out):
    """Fill `out` (12,), which may be `base`, with the frame at `length` mm along the arc from the base."""
    kappa2 = u * u + v * v
    ahead, aside = arc_parts(math.sqrt(kappa2), length)
    for k in range(3):
        x = base[k]
        y = base[3 + k]
        z = base[6 + k]
        across = u * x + v * y
        turn = aside * across + ahead * z
        out[k] = x - u * turn
        out[3 + k] = y - v * turn
        out[6 + k] = z - kappa2 * aside * z + ahead * across
        out[9 + k] = base[9 + k] + ahead * z + aside * across


@borrowing_kernel
def point_along(base, u, v, length):
    """Return the point at `length` mm along the arc that starts at a base frame."""
    ahead, aside = arc_parts(math.sqrt(u * u + v * v), length)
    fu = aside * u
    fv = aside * v
    return (
        base[9] + ahead * base[6] + fu * base[0] + fv * base[3],
        base[10] + ahead * base[7] + fu * base[1] + fv * base[4],
        base[11] + ahead * base[8] + fu * base[2] + fv * base[5],
    )


@borrowing_kernel
def room_at(walls, radius, x, y, z):
    """Return a lower bound on the room around a ball of `radius`, negative if the wall may cut it."""
    bound = distance_bound(walls.depth, walls.depth_geometry, x, y, z)
    if bound - radius >= EASY_MM:
        return bound - radius
    g = walls.depth_geometry
    if bound + math.sqrt(g[0, 4] + g[1, 4] + g[2, 4]) + 0.01 < radius:
        return BLOCKED
    cap = radius + EXACT_REACH_MM
    return exact_distance(walls.solid, walls.geometry, x, y, z, _OUTSIDE, _NOBODY, cap)[0] - radius


@borrowing_kernel
def room_along(walls, radius, base, u, v, begin, end, growth, longest_step):
    """Return a room that is there all along an arc from `begin` to `end` mm, BLOCKED if none is proved.

    At `s` mm from the base, `growth * s * s` mm more are asked for, and the room is what is beyond that.  It
    changes by no more than one walks, and what is asked for shrinks on the way back to the base: the walk
    begins at the far end, where most arcs touch, and goes as far as the room allows, at most `longest_step`.
    """
    at = end
    least = math.inf
    before = math.inf
    step = 0.0
    while True:
        x, y, z = point_along(base, u, v, at)
        room = room_at(walls, radius, x, y, z) - growth * at * at
        if room < MIN_GAP_MM:
            return BLOCKED
        # It falls by no more than x on x mm back, and by no more than x (1 + steeper) on x mm ahead.
        steeper = 2.0 * growth * (at + step)
        least = min(least, room, max(before - step, 0.5 * (before + room - step * (1.0 + steeper))))
        if at <= begin:
            return least
        before = room
        step = min(room, longest_step, at - begin)
        at -= step


@borrowing_kernel
def along_setting(walls, radius, length, base, twist, bend, growth, longest_step):
    """Return the room along a section of given twist and bend; see `room_along`."""
    u = bend / length * math.cos(twist)
    v = bend / length * math.sin(twist)
    return room_along(walls, radius, base, u, v, 0.0, length, growth, longest_step)


@borrowing_kernel
def change_room(walls, radius, length, base, twist, bend, to_twist, to_bend, finest, longest_step):
    """Return a room that is there all along a steady change of twist and bend, BLOCKED if none is proved.

    A point `s` mm from the base moves by at most D s^2 / 2 where the curvature vector moves by D.  So a part
    of the change is free if both its ends have D s^2 / 4 to spare at every s: each place is nearer than that
    to the same place of one of them.  Else the part is halved, until the tip moves by less than FINEST_MM.
    The tip never moves by more than `finest` in one part.
    """
    if along_setting(walls, radius, length, base, to_twist, to_bend, 0.0, longest_step) < 0.0:
        return BLOCKED
    most_bend = max(abs(bend), abs(to_bend))
    change = math.hypot(to_bend - bend, most_bend * (to_twist - twist)) / length
    moved = 0.5 * change * length * length
    longest = 1.0 if moved <= finest else finest / moved
    least = math.inf
    done, part, proved = 0.0, longest, -1.0
    while done < 1.0:
        part = min(part, 1.0 - done)
        growth = 0.25 * change * part
        room = math.inf
        if growth > proved:
            at_twist, at_bend = twist + done * (to_twist - twist), bend + done * (to_bend - bend)
            room = along_setting(walls, radius, length, base, at_twist, at_bend, growth, longest_step)
        if room >= 0.0:
            to = 1.0 if part == 1.0 - done else done + part
            at_twist, at_bend = twist + to * (to_twist - twist), bend + to * (to_bend - bend)
            after = along_setting(walls, radius, length, base, at_twist, at_bend, growth, longest_step)
            if after >= 0.0:
                least = min(least, room, after)
                done, part, proved = to, min(2.0 * part, longest), growth
                continue
            if along_setting(walls, radius, length, base, at_twist, at_bend, 0.0, longest_step) < 0.0:
                return BLOCKED
        if part * moved < FINEST_MM:
            return BLOCKED
        part *= 0.5
    return least


@borrowing_kernel
def turn_room(walls, radius, length, base, twist, bend, to_twist, to_bend, by_straight):
    """Return a room that is there all along a change in place, which may go by the straight section."""
    if not by_straight:
        return change_room(walls, radius, length, base, twist, bend, to_twist, to_bend, math.inf, math.inf)
    room = change_room(walls, radius, length, base, twist, bend, twist, 0.0, math.inf, math.inf)
    if room < 0.0:
        return room
    after = change_room(walls, radius, length, base, to_twist, 0.0, to_twist, to_bend, math.inf, math.inf)
    return min(room, after)


@borrowing_kernel
def nearest_setting(twist, bend, u, v, length, least_bend, most_bend):
    """Return twist and bend of a curvature vector, and whether to change to them by the straight section.

    The bend may be up or down, with the twist turned by half a turn; the change is the smallest that keeps
    the twist within MOST_TWIST_RAD.  The bend is infinite if the section can bend to it neither way.
    """
    size = math.hypot(u, v) * length
    turn = 2.0 * math.pi
    angle = math.atan2(v, u)
    best = math.inf
    found_twist, found_bend = twist, math.inf
    for down in range(2):
        to_bend = -size if down else size
        if not least_bend <= to_bend <= most_bend:
            continue
        to_twist = angle + down * math.pi
        to_twist -= turn * math.floor((to_twist - twist) / turn + 0.5)
        if abs(to_twist) > MOST_TWIST_RAD:
            to_twist -= math.copysign(turn, to_twist)
        change = math.hypot(to_bend - bend, max(abs(bend), size) * (to_twist - twist))
        if change < best:
            best = change
            found_twist = to_twist
            found_bend = to_bend
    return found_twist, found_bend, best > abs(bend) + size


@kernel()
def motion_room(walls, radius, length, entry, states, finest, stride, where):
    """Return a room that is there during a whole motion; `where` (1,) becomes the state where it is BLOCKED.

    states : (M, 3) advance, twist and bend; stride : the longest step of a walk.  Steps that both advance and
    turn are not looked for here.
    """
    base, least, far = entry.copy(), math.inf, math.inf
    where[0] = -1
    for n in range(states.shape[0]):
        kappa = states[n, 2] / length
        u = kappa * math.cos(states[n, 1])
        v = kappa * math.sin(states[n, 1])
        last = n + 1 == states.shape[0]
        advance = 0.0 if last else states[n + 1, 0] - states[n, 0]
        if advance > 0.0 or last or n == 0:
            room = room_along(walls, radius, base, u, v, 0.0, length + advance, 0.0, stride)
        else:
            room = math.inf
        if room >= 0.0 and advance <= 0.0 and not last:
            twist, bend, to_twist, to_bend = states[n, 1], states[n, 2], states[n + 1, 1], states[n + 1, 2]
            room = change_room(walls, radius, length, base, twist, bend, to_twist, to_bend, finest, stride)
            if room < 0.0:
                # Short parts ask for room in more places: some changes are free by long parts only.
                room = change_room(walls, radius, length, base, twist, bend, to_twist, to_bend, far, far)
        if room < 0.0:
            where[0] = n
            return BLOCKED
        least = min(least, room)
        move_along(base, u, v, advance, base)
    return least
