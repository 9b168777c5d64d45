"""Ways on a lattice: the cheapest smooth curves between a pose and a point, around a base.

The base is the control polygon of a quadratic spline: a start, a control point for each layer, and an end;
start and end are the middles of its first and last whole piece.  A way meets each layer in a vertex, aside
of the base by a vector of a hexagonal lattice.  From layer to layer that vector grows by a step, and at a
vertex the step changes by one of seven moves, none or a unit of the lattice.  So a way is such a polygon too:
an arc leads from the middle of each piece to that of the next, and how much it bends is known.

All ways are in one graph of states, vertex and step, without cycles, so that the cheapest way through each
state is known after a pass forward and one backward.  See docs/needle.md.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from anatomy.kernels.arcs import any_normal
from anatomy.kernels.compiling import inner_kernel
from stages.needle.kernels.cost import cost_of_arc
from stages.needle.kernels.limits import COST_STEP
from stages.needle.kernels.proof import blocker_on_arc

MOVES = 7
# The moves in the axial coordinates of a hexagonal lattice.
_MOVE_A = (0, 1, 0, -1, -1, 0, 1)
_MOVE_B = (0, 0, 1, 1, 0, -1, -1)
# Columns of `states`: step and vertex in cells.
STEP_A, STEP_B, AT_A, AT_B = range(4)
STATE_COLUMNS = 4
# Columns of `links`: the best state before, the best one after, and then those after by each move.
BEFORE, AFTER, FIRST_AFTER = 0, 1, 2
LINK_COLUMNS = 2 + MOVES
NONE = -1
# Columns of `costs`: of the piece after the vertex, from the start to its end, from its end to the goal.
PIECE, SO_FAR, TO_GO = range(3)
COST_COLUMNS = 3


@inner_kernel
def _hexagonal_norm(a, b):
    """Return the least number of units that add up to a lattice vector."""
    return max(abs(a), abs(b), abs(a + b))


@inner_kernel
def _place(table, states, begin, a, b, at_a, at_b):
    """Return the slot of a state in a hash table: its own, or the empty one where it belongs.

    States before `begin` are those of layers behind and count as empty.
    """
    mask = len(table) - 1
    slot = (((a * 73 + b) * 1031 + at_a) * 4099 + at_b) * 0x9E3779B1 >> 12 & mask
    while table[slot] >= begin:
        n = table[slot]
        if (
            states[n, STEP_A] == a
            and states[n, STEP_B] == b
            and states[n, AT_A] == at_a
            and states[n, AT_B] == at_b
        ):
            break
        slot = (slot + 1) & mask
    return slot


@inner_kernel
def _vertex(base, axes, layer, a, b):
    """Return the vertex of a layer at the axial coordinates (a, b) of the lattice."""
    return (
        base[layer, 0] + a * axes[0, 0] + b * axes[1, 0],
        base[layer, 1] + a * axes[0, 1] + b * axes[1, 1],
        base[layer, 2] + a * axes[0, 2] + b * axes[1, 2],
    )


@inner_kernel
def _goal(base, axes, goal_cells):
    """Return the goal, which lies aside of the end of the base."""
    a, b, end = 0.5 * goal_cells[0], 0.5 * goal_cells[1], len(base) - 1
    return (
        base[end, 0] + a * axes[0, 0] + b * axes[1, 0],
        base[end, 1] + a * axes[0, 1] + b * axes[1, 1],
        base[end, 2] + a * axes[0, 2] + b * axes[1, 2],
    )


@inner_kernel
def _piece(base, axes, layer, a, b):
    """Return the vector from a layer to the next with a step of (a, b), whole also at both ends."""
    scale = 2.0 if layer == 0 or layer == len(base) - 2 else 1.0
    return (
        scale * (base[layer + 1, 0] - base[layer, 0]) + a * axes[0, 0] + b * axes[1, 0],
        scale * (base[layer + 1, 1] - base[layer, 1]) + a * axes[0, 1] + b * axes[1, 1],
        scale * (base[layer + 1, 2] - base[layer, 2]) + a * axes[0, 2] + b * axes[1, 2],
    )


@inner_kernel
def _curvature(u, v):
    """Return the curvature of the arc that leaves the middle of a piece along it for that of the next."""
    x, y, z = u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
    chord = (u[0] + v[0]) ** 2 + (u[1] + v[1]) ** 2 + (u[2] + v[2]) ** 2
    return 4.0 * math.sqrt((x * x + y * y + z * z) / (u[0] * u[0] + u[1] * u[1] + u[2] * u[2])) / chord


@inner_kernel
def _price(space, limits, objective, branch, p, q, behind, first, most):
    """Return the cost of a straight piece, infinite if it is not clear or costs `most` or more.

    `behind` mm of needle lie before it.
    """
    dx, dy, dz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    tx, ty, tz = dx / length, dy / length, dz / length
    nx, ny, nz = any_normal(tx, ty, tz)
    pose, bend = (p[0], p[1], p[2], tx, ty, tz), (0.0, nx, ny, nz)
    cost = cost_of_arc(space, objective, limits[COST_STEP], pose, bend, length, first)
    if cost >= most or blocker_on_arc(space, limits, pose, bend, length, behind, branch) != 0:
        return math.inf
    return cost


@numba.njit(cache=True, nogil=True)
def explore(
    space, limits, objective, branch, base, axes, goal_cells, kappa, reach, inserted, bound,
    begins, states, links, costs, table,
):  # fmt: skip
    """Find the cheapest way through each state; return how many states there are, and whether all.

    Parameters
    ----------
    base : (L + 2, 3) float64
        Start, a control point for each layer, and an end.
    axes : (2, 3) float64
        Of the lattice, as long as a cell.
    goal_cells : (2,) int64
        The goal aside of the end of the base, in half cells along each axis.
    kappa : float
        Greatest curvature of the ways, 1/mm.
    reach : int
        How many cells from the base vertices lie at most.
    inserted : float
        Length of the needle behind the start, mm.
    bound : float
        States to which no way leads for less are dropped.
    begins : (L + 2,) int64
        Filled: the first state of each layer from 0, the start, to L, and the number of states.
    states : (N, STATE_COLUMNS) int64; links : (N, LINK_COLUMNS) int32; costs : (N, COST_COLUMNS) float64
        Filled.
    table : (M,) int32
        For the hash table, all NONE; M is a power of two and at least twice N.
    """
    layers = len(base) - 2
    goal = _goal(base, axes, goal_cells)
    behind = inserted
    begins[0], count = 0, 1
    states[0, :] = 0
    links[0, BEFORE] = NONE
    costs[0, SO_FAR] = 0.0
    for layer in range(layers + 1):
        for n in range(begins[layer], count):
            a, b = states[n, AT_A], states[n, AT_B]
            p = _vertex(base, axes, layer, a, b)
            if layer < layers:
                q = _vertex(base, axes, layer + 1, a + states[n, STEP_A], b + states[n, STEP_B])
            else:
                q = goal
            costs[n, PIECE] = _price(
                space, limits, objective, branch, p, q, behind, n == 0, bound - costs[n, SO_FAR]
            )
            costs[n, SO_FAR] += costs[n, PIECE]
        square = 0.0
        for axis in range(3):
            square += (base[layer + 1, axis] - base[layer, axis]) ** 2
        behind += math.sqrt(square)
        begins[layer + 1] = count
        if layer == layers:
            break
        for m in range(begins[layer], begins[layer + 1]):
            links[m, FIRST_AFTER:] = NONE
            if costs[m, SO_FAR] >= bound:
                costs[m, SO_FAR] = math.inf
                continue
            count = _follow(
                base, axes, goal_cells, kappa, reach, layer + 1, begins[layer + 1], count, m,
                states, links, costs, table,
            )  # fmt: skip
            if count < 0:
                return begins[layer + 1], False
    _look_back(begins[layers], count, links, costs)
    return count, True


@inner_kernel
def _follow(base, axes, goal_cells, kappa, reach, layer, begin, count, m, states, links, costs, table):
    """Enter the states of a layer after state `m` from which the goal may be met.

    Return `count`, -1 if there is no more room.
    """
    layers_left = len(base) - 2 - layer
    step_a, step_b = states[m, STEP_A], states[m, STEP_B]
    at_a, at_b = states[m, AT_A] + step_a, states[m, AT_B] + step_b
    if _hexagonal_norm(at_a, at_b) > reach:
        return count
    before = _piece(base, axes, layer - 1, step_a, step_b)
    for move in range(MOVES):
        a, b = step_a + _MOVE_A[move], step_b + _MOVE_B[move]
        # A later move counts twice for each whole piece that follows it, and once for the last, half one.
        off_a = goal_cells[0] - 2 * at_a - (2 * layers_left + 1) * a
        off_b = goal_cells[1] - 2 * at_b - (2 * layers_left + 1) * b
        if _hexagonal_norm(off_a, off_b) > layers_left * layers_left:
            continue
        if _curvature(before, _piece(base, axes, layer, a, b)) > kappa:
            continue
        slot = _place(table, states, begin, a, b, at_a, at_b)
        n = table[slot]
        if n < begin:
            n = count
            if n == len(states):
                return -1
            count += 1
            table[slot] = n
            states[n, STEP_A], states[n, STEP_B] = a, b
            states[n, AT_A], states[n, AT_B] = at_a, at_b
            costs[n, SO_FAR] = math.inf
        links[m, FIRST_AFTER + move] = n
        if costs[m, SO_FAR] < costs[n, SO_FAR]:
            costs[n, SO_FAR] = costs[m, SO_FAR]
            links[n, BEFORE] = m
    return count


@inner_kernel
def _look_back(last_layer, count, links, costs):
    """Fill in what it costs from each state to the goal, and the best state after it."""
    for m in range(count - 1, -1, -1):
        links[m, AFTER] = NONE
        costs[m, TO_GO] = 0.0 if m >= last_layer else math.inf
        if m >= last_layer or costs[m, SO_FAR] == math.inf:
            continue
        for move in range(MOVES):
            n = links[m, FIRST_AFTER + move]
            if n != NONE and costs[n, PIECE] + costs[n, TO_GO] < costs[m, TO_GO]:
                costs[m, TO_GO] = costs[n, PIECE] + costs[n, TO_GO]
                links[m, AFTER] = n


@numba.njit(cache=True, nogil=True)
def different_ways(base, axes, goal_cells, begins, states, links, costs, bound, apart_mm, ways, ways_costs):
    """Write the cheapest ways for less than `bound` that are apart half-way; return how many.

    `ways` (K, L + 2, 3) gets bases: start, vertices, goal.
    """
    middle = (len(base) - 1) // 2
    near = np.zeros(begins[middle + 1] - begins[middle], dtype=np.bool_)
    for found in range(len(ways)):
        best = NONE
        least = bound
        for m in range(begins[middle], begins[middle + 1]):
            cost = costs[m, SO_FAR] + costs[m, TO_GO]
            if cost < least and not near[m - begins[middle]]:
                best, least = m, cost
        if best == NONE:
            return found
        ways_costs[found] = least
        ways[found] = base
        ways[found, len(base) - 1] = _goal(base, axes, goal_cells)
        _write_way(base, axes, middle, states, links, best, ways[found])
        x, y, z = ways[found, middle]
        for m in range(begins[middle], begins[middle + 1]):
            p = _vertex(base, axes, middle, states[m, AT_A], states[m, AT_B])
            if (p[0] - x) ** 2 + (p[1] - y) ** 2 + (p[2] - z) ** 2 < apart_mm * apart_mm:
                near[m - begins[middle]] = True
    return len(ways)


@inner_kernel
def _write_way(base, axes, layer, states, links, state, way):
    """Write the vertices of the best way through a state of a layer."""
    n = state
    for back in range(layer, 0, -1):
        way[back] = _vertex(base, axes, back, states[n, AT_A], states[n, AT_B])
        n = links[n, BEFORE]
    n = state
    for ahead in range(layer, len(base) - 1):
        way[ahead] = _vertex(base, axes, ahead, states[n, AT_A], states[n, AT_B])
        n = links[n, AFTER]
