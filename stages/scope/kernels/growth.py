"""One layer of the tree of states of a bronchoscope: a beam search that follows a route of the airway."""

import math
from typing import NamedTuple

import numpy as np

from anatomy.base.typed import Float
from anatomy.kernels.compiling import borrowing_kernel, inner_kernel, kernel, merged_kernel
from stages.scope.kernels.body import move_along, nearest_setting, point_along, room_along, room_at, turn_room

BASE, U, V, TWIST, BEND, TIP, HEADING, NEAR, COST, ROOM, CURVATURE = 0, 12, 13, 14, 15, 16, 19, 22, 23, 24, 25
COLUMNS = 26
"""Columns of a state: base frame, curvature vector, twist, bend, tip and its direction, the route point
nearest to the tip, cost, room on the whole way, largest curvature of the body."""
TIP_MM, TIP_RAD = 0.15, 0.06
"""States whose tips and bases are nearer than this together count as the same."""
MEMORY = 0.5
"""Share of the cost of the state before that is added: a good state does not make up for a bad way."""
HOLD_COST = 6.0
"""Cost of any change: more than most places cost, so that hands turn and bend only where they must."""
PROBES = 4
"""Before an arc is walked along it is looked at in so many places: most blocked ones are blocked there."""


class Device(NamedTuple):
    """A scope, for kernels: lengths in mm, angles in rad, `laying` the largest curvature of an advance."""

    radius: float
    length: float
    laying: float
    least_bend: float
    most_bend: float


class Route(NamedTuple):
    """R points of the medial axis from the root on: points and tangents (R, 3), free room (R,) in mm."""

    points: Float
    tangents: Float
    room: Float


@borrowing_kernel
def nearest_on_route(points, near, x, y, z):
    """Return the route point nearest to a point, near another one, and the squared distance."""
    best = (points[near, 0] - x) ** 2 + (points[near, 1] - y) ** 2 + (points[near, 2] - z) ** 2
    for way in (1, -1):
        n = near + way
        misses = 0
        while 0 <= n < points.shape[0] and misses < 3:
            d = (points[n, 0] - x) ** 2 + (points[n, 1] - y) ** 2 + (points[n, 2] - z) ** 2
            misses += 1
            if d < best:
                best = d
                near = n
                misses = 0
            n += way
    return near, best


@merged_kernel
def pursuit(points, base, near, ahead_mm):
    """Return the curvature vector of the arc to a place on the route `ahead_mm` beyond a point of it."""
    gone = 0.0
    n = near
    while n + 1 < points.shape[0] and gone < ahead_mm:
        gone += math.sqrt(
            (points[n + 1, 0] - points[n, 0]) ** 2
            + (points[n + 1, 1] - points[n, 1]) ** 2
            + (points[n + 1, 2] - points[n, 2]) ** 2
        )
        n += 1
    dx = points[n, 0] - base[9]
    dy = points[n, 1] - base[10]
    dz = points[n, 2] - base[11]
    square = max(dx * dx + dy * dy + dz * dz, 1.0)
    return (
        2.0 * (dx * base[0] + dy * base[1] + dz * base[2]) / square,
        2.0 * (dx * base[3] + dy * base[4] + dz * base[5]) / square,
    )


@borrowing_kernel
def settle(route, length, state, scratch):
    """Fill in tip, direction and route point of a state; return its cost: off-axis share and angle."""
    u, v = state[U], state[V]
    move_along(state, u, v, length, scratch)
    near, d2 = nearest_on_route(route.points, int(state[NEAR]), scratch[9], scratch[10], scratch[11])
    cosine = 0.0
    for k in range(3):
        state[TIP + k] = scratch[9 + k]
        state[HEADING + k] = scratch[6 + k]
        cosine += scratch[6 + k] * route.tangents[near, k]
    state[NEAR] = near
    # 1 - cos of 20 degrees: a tip that looks so far aside costs as much as one that is at the wall.
    cost = 2.0 * d2 / route.room[near] ** 2 + (1.0 - cosine) / 0.06
    for n in range(1, 3):
        x, y, z = point_along(state, u, v, length * (1.0 - n / 3.0))
        near, d2 = nearest_on_route(route.points, near, x, y, z)
        cost += d2 / route.room[near] ** 2
    return cost


@borrowing_kernel
def same(a, b):
    """Tell whether two states are about the same: tips and bases near each other, and their directions."""
    far = 0.0
    turned = 0.0
    for k in range(3):
        far += (a[TIP + k] - b[TIP + k]) ** 2 + (a[9 + k] - b[9 + k]) ** 2
        turned += (a[HEADING + k] - b[HEADING + k]) ** 2 + (a[6 + k] - b[6 + k]) ** 2
    return far / TIP_MM**2 + turned / TIP_RAD**2 < 1.0


@borrowing_kernel
def follow(walls, device, before, state, by_straight, step):
    """Prove the way from one state to the next, and fill in its least room; tell whether it is free."""
    far = device.length + step
    for n in range(1, PROBES):
        x, y, z = point_along(before, state[U], state[V], far * (1.0 - n / PROBES))
        if room_at(walls, device.radius, x, y, z) < 0.0:
            return False
    room = room_along(walls, device.radius, before, state[U], state[V], 0.0, far, 0.0, math.inf)
    if room < 0.0:
        return False
    if state[TWIST] != before[TWIST] or state[BEND] != before[BEND]:
        turn = turn_room(
            walls, device.radius, device.length, before,
            before[TWIST], before[BEND], state[TWIST], state[BEND], by_straight,
        )  # fmt: skip
        if turn < 0.0:
            return False
        room = min(room, turn)
    state[ROOM] = min(room, before[ROOM])
    return True


@inner_kernel
def candidates(device, route, states, offsets, step, found, by_straight):
    """Fill the candidates `(N * C, COLUMNS)` that follow states `(N, COLUMNS)`.

    Each advances by a step with the curvature it has, with another bend at the twist it has, or with a
    curvature beside that which leads to the route ahead; `offsets` (C, 2) are added to that, the first two
    are zero.
    """
    count = offsets.shape[0]
    scratch = np.zeros(12)
    for n in range(states.shape[0]):
        before = states[n]
        to_u, to_v = pursuit(route.points, before, int(before[NEAR]), 2.0 * step)
        for c in range(count):
            state = found[n * count + c]
            u = before[U] if c == 0 else to_u + offsets[c, 0]
            v = before[V] if c == 0 else to_v + offsets[c, 1]
            shrink = min(1.0, device.laying / max(math.hypot(u, v), 1e-12))
            u *= shrink
            v *= shrink
            twist, bend, straight = before[TWIST], before[BEND], False
            if c == 1:
                # The handle alone: what of the way to the route lies in the plane in which the tip bends.
                kappa = u * math.cos(twist) + v * math.sin(twist)
                bend = min(max(kappa * device.length, device.least_bend), device.most_bend)
                u, v = bend / device.length * math.cos(twist), bend / device.length * math.sin(twist)
            elif c > 1:
                twist, bend, straight = nearest_setting(
                    twist, bend, u, v, device.length, device.least_bend, device.most_bend
                )
            move_along(before, u, v, step, state)
            state[U], state[V], state[TWIST], state[BEND] = u, v, twist, bend
            state[NEAR] = before[NEAR]
            state[CURVATURE] = max(before[CURVATURE], math.hypot(u, v))
            change = 0.5 * math.hypot(u - before[U], v - before[V]) * device.length**2
            state[COST] = settle(route, device.length, state, scratch)
            # Cost of a change in place for each mm that the tip moves: as bad as half the room off the axis.
            state[COST] += MEMORY * before[COST] + 0.3 * change + (HOLD_COST if c > 0 else 0.0)
            # Cost of a twist by 1 rad: half a turn costs as much as a change of the handle alone.
            state[COST] += 2.0 * abs(twist - before[TWIST])
            if not math.isfinite(bend):
                state[COST] = math.inf
            by_straight[n * count + c] = straight


@kernel()
def grow_layer(walls, device, route, states, offsets, step, out, parents, by_straight):
    """Fill the states `(K, COLUMNS)` one step on, the cheapest that are free and differ; return how many."""
    count = states.shape[0] * offsets.shape[0]
    found = np.zeros((count, COLUMNS))
    flags = np.zeros(count, dtype=np.bool_)
    candidates(device, route, states, offsets, step, found, flags)
    order = np.argsort(found[:, COST], kind="mergesort")
    kept = 0
    for row in order:
        if kept == out.shape[0] or not math.isfinite(found[row, COST]):
            break
        new = True
        for k in range(kept):
            if same(found[row], out[k]):
                new = False
                break
        parent = row // offsets.shape[0]
        if new and follow(walls, device, states[parent], found[row], flags[row], step):
            out[kept] = found[row]
            parents[kept] = parent
            by_straight[kept] = flags[row]
            kept += 1
    return kept


@kernel()
def put_first(walls, device, route, state):
    """Fill in the first state of a tree, of given base frame and route point; tell whether it is free."""
    settle(route, device.length, state, np.zeros(12))
    room = room_along(walls, device.radius, state, state[U], state[V], 0.0, device.length, 0.0, math.inf)
    state[ROOM] = room
    return room >= 0.0
