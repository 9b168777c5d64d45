"""Motions that stop a little earlier or later than a proved one, with the same last twist and bend."""

import math

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from stages.scope.kernels.body import BLOCKED, move_along, room_along, turn_room


@merged_kernel
def goes_by_straight(twist, bend, to_twist, to_bend):
    """Tell whether a change in place moves the section less if it is straightened before it twists."""
    change = math.hypot(to_bend - bend, max(abs(bend), abs(to_bend)) * (to_twist - twist))
    return change > abs(bend) + abs(to_bend)


@inner_kernel
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
    base = entry.copy()
    moved = entry.copy()
    scratch = np.zeros(12)
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
        move_along(base, u, v, min(end, stop) - begin, moved)
        base[:] = moved
    for k in range(shifts.shape[0]):
        if not done[k]:
            put_tip(base, twist, bend, length, tips[k], scratch)
