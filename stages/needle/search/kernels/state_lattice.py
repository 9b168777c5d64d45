"""State lattices: the cheapest smooth curve between a pose and a point, around a base.

The base is the control polygon of a quadratic spline: a start, a control point for each layer, and an end;
start and end are the middles of its first and last whole piece.  A guide path meets each layer in a vertex,
aside of the base by a vector of a hexagonal lattice.  From layer to layer that vector grows by a step, and at
a vertex the step changes by one of seven moves, none or a unit of the lattice.  So a guide path is such a
polygon too: an arc leads from the middle of each piece to that of the next, and how much it bends is known.

All guide paths are in one graph without cycles: its states are vertices with steps, its edges the arcs
between the middles of their pieces.  The cheapest path to each state is known after a pass forward.  See
docs/explanation/needle.md.
"""

import math

from anatomy.kernels.arcs import arc_to_point
from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from stages.needle.kernels.cost import cost_of_arc
from stages.needle.kernels.proof import blocker_on_arc

MOVES = 7
# The moves in the axial coordinates of a hexagonal lattice.
_MOVE_A = (0, 1, 0, -1, -1, 0, 1)
_MOVE_B = (0, 0, 1, 1, 0, -1, -1)
# Columns of `states`: step and vertex in cells.
STEP_A, STEP_B, AT_A, AT_B = range(4)
STATE_COLUMNS = 4
NONE = -1


@inner_kernel
def _hexagonal_norm(a, b):
    """Return the least number of units that add up to a lattice vector."""
    return max(abs(a), abs(b), abs(a + b))


@inner_kernel
def _place(table, states, begin, a, b, at_a, at_b):
    """Return the slot of a state in a hash table, its own or an empty one; states before `begin` count as
    empty."""
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
def _middle(base, axes, goal_cells, layer, a, b, at_a, at_b):
    """Return the middle of the whole piece after a vertex: the start or the goal at the ends."""
    if layer == len(base) - 2:
        return _goal(base, axes, goal_cells)
    p = _vertex(base, axes, layer, at_a, at_b)
    if layer == 0:
        return p
    q = _vertex(base, axes, layer + 1, at_a + a, at_b + b)
    return 0.5 * (p[0] + q[0]), 0.5 * (p[1] + q[1]), 0.5 * (p[2] + q[2])


@inner_kernel
def _arc_cost(obstacles, limits, objective, branch, p, along, q, kappa, behind, first, most):
    """Return the cost of the arc from a point to another that begins along a vector.

    It is infinite if the arc bends more than `kappa`, is not clear or costs `most` or more; `behind` mm of
    needle lie before it.
    """
    norm = math.sqrt(along[0] ** 2 + along[1] ** 2 + along[2] ** 2)
    pose = (p[0], p[1], p[2], along[0] / norm, along[1] / norm, along[2] / norm)
    length, bend, _turn = arc_to_point(pose, q)
    if bend[0] > kappa:
        return math.inf
    cost = cost_of_arc(obstacles, objective, limits.cost_step_mm, pose, bend, length, first)
    if cost >= most or blocker_on_arc(obstacles, limits, pose, bend, length, behind, branch) != 0:
        return math.inf
    return cost


@merged_kernel
def _sort_by_cost(order, costs, begin, end):
    """Write the states of a layer to their places in `order`, the cheapest first, by the method of Shell."""
    for n in range(begin, end):
        order[n] = n
    gap = end - begin
    while gap > 1:
        gap = max(gap * 5 // 11, 1)
        for n in range(begin + gap, end):
            state = order[n]
            at = n
            while at - gap >= begin and costs[order[at - gap]] > costs[state]:
                order[at] = order[at - gap]
                at -= gap
            order[at] = state


@kernel(nogil=True)
def explore(
    obstacles, limits, objective, branch, base, axes, goal_cells, kappa, reach, inserted, bound,
    begins, states, before, costs, table, order,
):  # fmt: skip
    """Find the cheapest path to each state; return how many arcs were tried, and whether all states fitted.

    Args:
        base ((L + 2, 3) float64): Start, a control point for each layer, and an end.
        axes ((2, 3) float64): Of the lattice, as long as a cell.
        goal_cells ((2,) int64): The goal aside of the end of the base, in half cells along each axis.
        kappa (float): Greatest curvature of the arcs, 1/mm.
        reach (int): How many cells from the base vertices lie at most.
        inserted (float): Length of the needle behind the start, mm.
        bound (float): States to which no path leads for less are left out.
        begins ((L + 2,) int64): Filled: the first state of each layer from 0, the start, to L, and the number
            of states.
        states ((N, STATE_COLUMNS) int64): Filled.
        before ((N,) int32): Filled: the state before each on the cheapest path to it, NONE at the start.
        costs ((N,) float64): Filled: cost of the cheapest path from the start to the middle of the piece
            after the vertex.
        table ((M,) int32): For the hash table, all NONE; M is a power of two and at least twice N.
        order ((N,) int32): Scratch.
    """
    layers = len(base) - 2
    begins[0], count, tried = 0, 1, 0
    states[0, :] = 0
    before[0] = NONE
    costs[0] = 0.0
    behind = inserted
    for layer in range(layers):
        begins[layer + 1] = count
        # Fewer arcs are tried if the cheapest come first.
        _sort_by_cost(order, costs, begins[layer], begins[layer + 1])
        for rank in range(begins[layer], begins[layer + 1]):
            m = order[rank]
            count, arcs = _follow(
                obstacles, limits, objective, branch, base, axes, goal_cells, kappa, reach, behind, bound,
                layer, begins[layer + 1], count, m, states, before, costs, table,
            )  # fmt: skip
            tried += arcs
            if count < 0:
                return tried, False
        for piece in (_piece(base, axes, layer, 0, 0), _piece(base, axes, layer + 1, 0, 0)):
            behind += 0.5 * math.sqrt(piece[0] ** 2 + piece[1] ** 2 + piece[2] ** 2)
    begins[layers + 1] = count
    return tried, True


@inner_kernel
def _follow(
    obstacles, limits, objective, branch, base, axes, goal_cells, kappa, reach, behind, bound,
    layer, begin, count, m, states, before, costs, table,
):  # fmt: skip
    """Enter the states after state `m` of a layer to which it leads cheapest, if the goal may be met.

    Return `count`, -1 if `states` is full, and how many arcs were tried.
    """
    layers_left = len(base) - 3 - layer
    step_a, step_b = states[m, STEP_A], states[m, STEP_B]
    at_a, at_b = states[m, AT_A] + step_a, states[m, AT_B] + step_b
    tried = 0
    if _hexagonal_norm(at_a, at_b) > reach:
        return count, tried
    p = _middle(base, axes, goal_cells, layer, step_a, step_b, states[m, AT_A], states[m, AT_B])
    along = _piece(base, axes, layer, step_a, step_b)
    for move in range(MOVES):
        a, b = step_a + _MOVE_A[move], step_b + _MOVE_B[move]
        # A later move counts twice for each whole piece that follows it, and once for the last, half one.
        off_a = goal_cells[0] - 2 * at_a - (2 * layers_left + 1) * a
        off_b = goal_cells[1] - 2 * at_b - (2 * layers_left + 1) * b
        if _hexagonal_norm(off_a, off_b) > layers_left * layers_left:
            continue
        slot = _place(table, states, begin, a, b, at_a, at_b)
        n = table[slot]
        least = bound if n < begin else costs[n]
        if costs[m] >= least:
            continue
        q = _middle(base, axes, goal_cells, layer + 1, a, b, at_a, at_b)
        cost = costs[m] + _arc_cost(
            obstacles, limits, objective, branch, p, along, q, kappa, behind, m == 0, least - costs[m]
        )
        tried += 1
        if cost >= least:
            continue
        if n < begin:
            n = count
            if n == len(states):
                return -1, tried
            count += 1
            table[slot] = n
            states[n, STEP_A], states[n, STEP_B] = a, b
            states[n, AT_A], states[n, AT_B] = at_a, at_b
        costs[n] = cost
        before[n] = m
    return count, tried


@kernel(nogil=True)
def cheapest_guide_path(base, axes, goal_cells, begins, states, before, costs, controls):
    """Write the cheapest path, goal included, to `controls` (L + 2, 3); return its cost, inf if none."""
    layers = len(base) - 2
    best, least = NONE, math.inf
    for n in range(begins[layers], begins[layers + 1]):
        if costs[n] < least:
            best, least = n, costs[n]
    if best == NONE:
        return least
    controls[0] = base[0]
    controls[layers + 1] = _goal(base, axes, goal_cells)
    for layer in range(layers, 0, -1):
        controls[layer] = _vertex(base, axes, layer, states[best, AT_A], states[best, AT_B])
        best = before[best]
    return least
