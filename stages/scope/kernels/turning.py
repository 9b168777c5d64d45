"""The tips that a bronchoscope reaches from states by twisting and bending in place."""

from __future__ import annotations

import math

import numba
import numpy as np

from stages.scope.kernels.body import move_along, nearest_setting, turn_room
from stages.scope.kernels.growth import BEND, ROOM, TWIST, U, V
from stages.scope.kernels.shifting import put_tip


@numba.njit(cache=True)
def tips_beside(device, most_curvature, states, offsets, out):
    """Fill tips `(N, C, 11)` of curvatures beside those of states: point, direction, vector, settings.

    `offsets` (C, 2) are added to the curvature vector.  The columns are point, forward, u, v, twist, bend and
    whether the change goes by the straight section; the bend is infinite if there is no such tip.
    """
    scratch = np.zeros(12)
    for n in range(states.shape[0]):
        for c in range(offsets.shape[0]):
            u = states[n, U] + offsets[c, 0]
            v = states[n, V] + offsets[c, 1]
            row = out[n, c]
            twist, bend, straight = nearest_setting(
                states[n, TWIST], states[n, BEND], u, v, device.length, device.least_bend, device.most_bend
            )
            if c == 0:
                twist, bend, straight = states[n, TWIST], states[n, BEND], False
                if not device.least_bend <= bend <= device.most_bend:
                    bend = math.inf
            if math.hypot(u, v) > most_curvature:
                bend = math.inf
            move_along(states[n], u, v, device.length, scratch)
            for k in range(3):
                row[k] = scratch[9 + k]
                row[3 + k] = scratch[6 + k]
            row[6], row[7], row[8], row[9], row[10] = u, v, twist, bend, 1.0 if straight else 0.0


@numba.njit(cache=True)
def first_free(walls, device, states, tips, groups, tries, kept, rooms):
    """Mark in `kept` (T,) the first tip of each group that is proved reachable in place, with its room.

    states : (T, COLUMNS) the state of each tip; groups : (T,) rising numbers; at most `tries` are tried.
    """
    done = -1
    last = -1
    tried = 0
    for t in range(tips.shape[0]):
        if groups[t] != last:
            last = groups[t]
            tried = 0
        if groups[t] == done or tried == tries:
            continue
        tried += 1
        state = states[t]
        room = turn_room(
            walls, device.radius, device.length, state,
            state[TWIST], state[BEND], tips[t, 8], tips[t, 9], tips[t, 10] > 0.0,
        )  # fmt: skip
        if room >= 0.0:
            kept[t] = True
            rooms[t] = min(room, state[ROOM])
            done = groups[t]


@numba.njit(cache=True)
def tip_frames(length, states, tips):
    """Return point, direction and +x `(T, 9)` of tips: the frame that twist and bend turn."""
    out = np.zeros((tips.shape[0], 9))
    scratch = np.zeros(12)
    for t in range(tips.shape[0]):
        put_tip(states[t], tips[t, 8], tips[t, 9], length, out[t], scratch)
    return out
