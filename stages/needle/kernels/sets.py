"""Sets of needle states on planes, as bitmaps: the moves of `stages.needle.certificate`.

A plane's states are cells of lateral position (rows y, bits x in words of 64) for each cell of slope (rows
and columns of directions): `bits[v, u, y, word]`.  Every function over-estimates.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from anatomy.kernels.field import exact_distance, interpolate_squared

ONE = np.uint64(1)
HALF_DIAGONAL = 0.7072
"""Half the diagonal of a square of side 1, rounded up."""
DIAGONAL = 1.4143
FIELD_STEP_MM = 0.005
"""What a clearance field rounds off is less."""


@numba.njit(cache=True)
def or_shifted(target, source, dy, dx):
    """OR a bitmap into another one, moved by whole cells; what falls off is dropped."""
    rows, words = source.shape
    to_rows, to_words = target.shape
    step = dx // 64
    rest = dx - 64 * step
    low = np.uint64(rest)
    high = np.uint64(64 - rest)
    for y in range(max(0, -dy), min(rows, to_rows - dy)):
        for w in range(words):
            value = source[y, w]
            if value == 0:
                continue
            to = w + step
            if rest == 0:
                if 0 <= to < to_words:
                    target[y + dy, to] |= value
                continue
            if 0 <= to < to_words:
                target[y + dy, to] |= value << low
            if 0 <= to + 1 < to_words:
                target[y + dy, to + 1] |= value >> high


@numba.njit(cache=True)
def and_shifted(target, source, dy, dx):
    """Keep of a bitmap what another one, moved by whole cells, holds; beyond its edge is nothing."""
    rows, words = source.shape
    to_rows, to_words = target.shape
    step = dx // 64
    rest = dx - 64 * step
    low = np.uint64(rest)
    high = np.uint64(64 - rest)
    for y in range(to_rows):
        from_y = y - dy
        for to in range(to_words):
            if target[y, to] == 0:
                continue
            value = np.uint64(0)
            if 0 <= from_y < rows:
                w = to - step
                if 0 <= w < words:
                    value = source[from_y, w] << low if rest else source[from_y, w]
                if rest and 0 <= w - 1 < words:
                    value |= source[from_y, w - 1] >> high
            target[y, to] &= value


@numba.njit(cache=True)
def spread(target, source, row, width, scratch):
    """Set a row to a row of a bitmap, each bit spread by `width` cells to both sides.

    `scratch` is so much longer than a row that nothing is lost at its end.
    """
    words = source.shape[1]
    scratch[:] = 0
    for w in range(words):
        scratch[w] = source[row, w]
    # To the right by doubling, so that each bit covers 2 width + 1 cells, then back to the left by width.
    covered = 1
    want = 2 * width + 1
    while covered < want:
        by = min(covered, want - covered)
        _or_right(scratch, by)
        covered += by
    _left(scratch, width)
    for w in range(words):
        target[w] = scratch[w]


@numba.njit(cache=True)
def _or_right(row, by):
    step = by // 64
    rest = np.uint64(by - 64 * step)
    for w in range(row.shape[0] - 1, -1, -1):
        value = np.uint64(0)
        if w - step >= 0:
            value = row[w - step] << rest
        if rest and w - step - 1 >= 0:
            value |= row[w - step - 1] >> (np.uint64(64) - rest)
        row[w] |= value


@numba.njit(cache=True)
def _left(row, by):
    step = by // 64
    rest = np.uint64(by - 64 * step)
    words = row.shape[0]
    for w in range(words):
        value = np.uint64(0)
        if w + step < words:
            value = row[w + step] >> rest
        if rest and w + step + 1 < words:
            value |= row[w + step + 1] << (np.uint64(64) - rest)
        row[w] = value


@numba.njit(cache=True)
def dilate(target, source, box, disc):
    """OR a bitmap into another of the same shape, dilated by a square of half side `box` and then a disc.

    Both in cells, any fraction.  A cell is reached if its centre is: the caller adds what a cell is wide.
    """
    rows, words = source.shape
    reach = int(math.floor(box + disc))
    scratch = np.zeros(words + (2 * reach + 127) // 64, np.uint64)
    spreaded = np.zeros(words, np.uint64)
    for y in range(rows):
        empty = True
        for w in range(words):
            if source[y, w] != 0:
                empty = False
                break
        if empty:
            continue
        last = -1
        for dy in range(reach, -1, -1):
            beyond = max(dy - box, 0.0)
            width = int(math.floor(box + math.sqrt(max(disc * disc - beyond * beyond, 0.0))))
            if width != last:
                spread(spreaded, source, y, width, scratch)
                last = width
            for side in range(2 if dy > 0 else 1):
                to = y + dy if side == 0 else y - dy
                if 0 <= to < rows:
                    for w in range(words):
                        target[to, w] |= spreaded[w]


@numba.njit(cache=True)
def is_empty(bitmap):
    """Tell whether a bitmap has no bit."""
    for y in range(bitmap.shape[0]):
        for w in range(bitmap.shape[1]):
            if bitmap[y, w] != 0:
                return False
    return True


@numba.njit(cache=True)
def free_within(deficit, slack, out):
    """Set the bits of the cells whose lack of clearance is at most `slack`."""
    rows, columns = deficit.shape
    out[:] = 0
    for y in range(rows):
        for x in range(columns):
            if deficit[y, x] <= slack:
                out[y, x // 64] |= ONE << np.uint64(x % 64)


@numba.njit(cache=True)
def largest_slope_change(slope, kappa, depth):
    """Return by how much the slope of a path may change over a slab of `depth`, inf if it may turn back.

    With theta the angle to the planes' normal and h the depth, |d sin(theta) / dh| <= kappa.
    """
    sine = slope / math.sqrt(1.0 + slope * slope) + kappa * depth
    if sine >= 1.0:
        return math.inf
    return sine / math.sqrt(1.0 - sine * sine) - slope


@numba.njit(cache=True)
def largest_second_derivative(sine, kappa):
    """Return kappa / cos^3(theta), which bounds the second derivative of a path over depth."""
    return kappa / (1.0 - sine * sine) ** 1.5


@numba.njit(cache=True)
def spread_of_change(slope, slope_cell, kappa, depth, change, low, high):
    """Return how far aside a path may get over a slab, from a bound of the second derivative, in mm.

    `slope` is the steepest in the cell at one end; slopes change by between the shares `low` and `high` of
    `change`, give or take what the cells are wide.
    """
    sine = slope / math.sqrt(1.0 + slope * slope)
    other = slope + high * change + DIAGONAL * slope_cell
    # The sine changes by kappa a mm, so half-way it is at most the mean of both ends and half of that.
    largest = min(
        sine + kappa * depth, 0.5 * (sine + other / math.sqrt(1.0 + other * other) + kappa * depth)
    )
    bound = largest_second_derivative(largest, kappa)
    share = max(low * change - DIAGONAL * slope_cell, 0.0) / (bound * depth)
    return bound * depth * depth * min(0.25, 0.2887 * math.sqrt(max(1.0 - share * share, 0.0)))


@numba.njit(cache=True)
def step_sets(
    now, now_window, first_slope, cell, slope_cell, kappa, depth, way, edges, out, out_window
):
    """Propagate the states of one plane to the next, or the one before, whatever obstacles there are.

    On a path x(h) over depth, x(h + d) - x(h) = d (x'(h) + x'(h + d)) / 2 + the integral of (d / 2 - t) x''
    over the slab.  With |x''| <= w the last term is at most w d^2 / 4, and by the inequality of
    Cauchy and Schwarz at most w d^2 sqrt((1 - r^2) / 12) where the slope changes by r w d.

    Parameters
    ----------
    now, out : (V, U, Y, W) uint64
        States of this plane; those of the other are added to `out`.
    now_window, out_window : (4,) int64
        Cell numbers (v, u, y, x) of the first cell of either; the start has numbers 0.
    first_slope : (2,) float64
        Slope (v, u) of the start.
    cell, slope_cell : float
        Sides of cells, mm and 1.
    kappa, depth : float
        1/mm, and distance of the planes in mm.
    way : int
        1 to the next plane, -1 to the one before.
    edges : (C,) float64
        Upper edges of the classes of slope change, as shares of the largest, rising to 1.
    """
    nv, nu, now_rows, now_words = now.shape
    to_v, to_u, rows, words = out.shape
    half = way * 0.5 * depth / cell
    # Half-way, states have moved by their own slope alone.
    shifts_v = np.zeros(nv, np.int64)
    shifts_u = np.zeros(nu, np.int64)
    for v in range(nv):
        shifts_v[v] = int(round((first_slope[0] + (v + now_window[0]) * slope_cell) * half))
    for u in range(nu):
        shifts_u[u] = int(round((first_slope[1] + (u + now_window[1]) * slope_cell) * half))
    mid_y = now_window[2] + shifts_v.min()
    mid_x = now_window[3] + shifts_u.min()
    mid_rows = now_rows + shifts_v.max() - shifts_v.min()
    mid_words = now_words + (shifts_u.max() - shifts_u.min() + 63) // 64
    levels = 1
    while (1 << levels) <= nu:
        levels += 1
    table = np.zeros((levels, nv, nu, mid_rows, mid_words), np.uint64)
    some = np.zeros((levels, nv, nu), np.bool_)
    for v in range(nv):
        for u in range(nu):
            if is_empty(now[v, u]):
                continue
            shift_y = now_window[2] + shifts_v[v] - mid_y
            or_shifted(table[0, v, u], now[v, u], shift_y, now_window[3] + shifts_u[u] - mid_x)
            some[0, v, u] = True
        for level in range(1, levels):
            span = 1 << (level - 1)
            for u in range(nu):
                other = u + span
                if some[level - 1, v, u]:
                    table[level, v, u] = table[level - 1, v, u]
                    some[level, v, u] = True
                if other < nu and some[level - 1, v, other]:
                    table[level, v, u] |= table[level - 1, v, other]
                    some[level, v, u] = True
    box = 2.0 + 0.5 * depth * slope_cell / cell
    widest = 0.0
    for tv in range(to_v):
        for tu in range(to_u):
            slope = _steepest(tv, tu, out_window, first_slope, slope_cell)
            change = largest_slope_change(slope, kappa, depth)
            for c in range(edges.shape[0]):
                low = edges[c - 1] if c > 0 else 0.0
                widest = max(
                    widest, spread_of_change(slope, slope_cell, kappa, depth, change, low, edges[c])
                )
    pad = int((box + widest / cell) // 64) + 1
    gathered = np.zeros((mid_rows, mid_words), np.uint64)
    moved = np.zeros((rows + 128 * pad, words + 2 * pad), np.uint64)
    wide = np.zeros((rows + 128 * pad, words + 2 * pad), np.uint64)
    for tv in range(to_v):
        move_v = int(round((first_slope[0] + (tv + out_window[0]) * slope_cell) * half))
        for tu in range(to_u):
            move_u = int(round((first_slope[1] + (tu + out_window[1]) * slope_cell) * half))
            slope = _steepest(tv, tu, out_window, first_slope, slope_cell)
            change = largest_slope_change(slope, kappa, depth)
            any_found = False
            for c in range(edges.shape[0]):
                reach = (edges[c] * change + DIAGONAL * slope_cell) / slope_cell
                gathered[:] = 0
                found = _gather(
                    gathered, table, some, tv + out_window[0] - now_window[0],
                    tu + out_window[1] - now_window[1], reach,
                )  # fmt: skip
                if not found:
                    continue
                if not any_found:
                    wide[:] = 0
                    any_found = True
                low = edges[c - 1] if c > 0 else 0.0
                disc = spread_of_change(slope, slope_cell, kappa, depth, change, low, edges[c])
                moved[:] = 0
                or_shifted(
                    moved, gathered,
                    move_v + mid_y - out_window[2] + 64 * pad, move_u + mid_x - out_window[3] + 64 * pad,
                )  # fmt: skip
                dilate(wide, moved, box, disc / cell)
            if any_found:
                for y in range(rows):
                    for w in range(words):
                        out[tv, tu, y, w] |= wide[y + 64 * pad, w + pad]


@numba.njit(cache=True)
def _steepest(v, u, window, first_slope, slope_cell):
    """Return the steepest slope in a cell of directions."""
    slope_v = first_slope[0] + (v + window[0]) * slope_cell
    slope_u = first_slope[1] + (u + window[1]) * slope_cell
    return math.hypot(slope_v, slope_u) + HALF_DIAGONAL * slope_cell


@numba.njit(cache=True)
def _gather(target, table, some, v, u, reach):
    """OR the bitmaps of all directions within `reach` cells; True if there are any."""
    _levels, nv, nu, rows, words = table.shape
    found = False
    limit = int(math.floor(reach))
    for dv in range(-limit, limit + 1):
        from_v = v + dv
        if not 0 <= from_v < nv:
            continue
        width = int(math.floor(math.sqrt(reach * reach - dv * dv)))
        low = max(u - width, 0)
        high = min(u + width, nu - 1)
        if low > high:
            continue
        level = 0
        while (1 << (level + 1)) <= high - low + 1:
            level += 1
        for side in range(2):
            at = low if side == 0 else high - (1 << level) + 1
            if some[level, from_v, at]:
                found = True
                for y in range(rows):
                    for w in range(words):
                        target[y, w] |= table[level, from_v, at, y, w]
    return found


@numba.njit(cache=True)
def lack_of_clearance(space, required, exempt_branch, origin, across, deepest, out):
    """Fill `out` (Y, X) with how much less than required the clearance is at cell centres of a plane, mm.

    Never more than it is; more than `deepest` need not be told apart.  `origin` is the first cell's centre,
    `across` (2, 3) are the steps from row to row and from column to column.  Airway voxels of
    `exempt_branch` (-1: none) do not count.
    """
    field, labels, geometry, bits = space
    rows, columns = out.shape
    for y in range(rows):
        for x in range(columns):
            px = origin[0] + y * across[0, 0] + x * across[1, 0]
            py = origin[1] + y * across[0, 1] + x * across[1, 1]
            pz = origin[2] + y * across[0, 2] + x * across[1, 2]
            squared, spread2 = interpolate_squared(field, geometry, px, py, pz)
            if squared - spread2 >= required * required:
                out[y, x] = 0.0
                continue
            above = math.sqrt(squared) + math.sqrt(spread2) + FIELD_STEP_MM
            if exempt_branch < 0 and squared > 0.0 and above < required - deepest:
                out[y, x] = required - above
                continue
            distance, _label = exact_distance(labels, geometry, px, py, pz, bits, exempt_branch, required)
            out[y, x] = required - distance


@numba.njit(cache=True)
def keep_clear(states, window, first_slope, cell, slope_cell, kappa, free, free_windows, depths, unit):
    """Remove the states from which half a slab behind or ahead is blocked for every path.

    Parameters
    ----------
    states : (V, U, Y, W) uint64, window : (4,) int64
    free : (D, Q, Y, W) uint64
        For each depth, the cells that lack at most `q * unit` mm of clearance.
    free_windows : (D, 2) int64
        Cell numbers (y, x) of the first cell of each.
    depths : (D,) float64
        Depths of these planes as seen from that of the states.
    """
    nv, nu, _rows, _words = states.shape
    for v in range(nv):
        slope_v = first_slope[0] + (v + window[0]) * slope_cell
        for u in range(nu):
            if is_empty(states[v, u]):
                continue
            slope_u = first_slope[1] + (u + window[1]) * slope_cell
            slope = math.hypot(slope_v, slope_u) + HALF_DIAGONAL * slope_cell
            sine = slope / math.sqrt(1.0 + slope * slope)
            for d in range(depths.shape[0]):
                depth = depths[d]
                bound = largest_second_derivative(sine + kappa * abs(depth), kappa)
                slack = (
                    DIAGONAL * cell + HALF_DIAGONAL * slope_cell * abs(depth) + 0.5 * bound * depth * depth
                )
                q = int(math.ceil(slack / unit))
                if q >= free.shape[1]:
                    continue
                shift_y = int(round(slope_v * depth / cell))
                shift_x = int(round(slope_u * depth / cell))
                and_shifted(
                    states[v, u], free[d, q],
                    free_windows[d, 0] - window[2] - shift_y, free_windows[d, 1] - window[3] - shift_x,
                )  # fmt: skip


@numba.njit(cache=True)
def keep_hopeful(states, window, first_slope, cell, slope_cell, kappa, goal, tolerance, largest_sine):
    """Remove the states that turn from the start by more than 90 degrees or cannot reach the goal.

    `goal` (3,) is its row and column position and its depth as seen from the plane, mm.  Returns the number
    of states kept, and how many of them are steeper than `largest_sine`.
    """
    nv, nu, rows, words = states.shape
    kept = 0
    steep = 0
    radius = 1.0 / kappa
    start_norm = math.sqrt(1.0 + first_slope[0] ** 2 + first_slope[1] ** 2)
    for v in range(nv):
        slope_v = first_slope[0] + (v + window[0]) * slope_cell
        for u in range(nu):
            if is_empty(states[v, u]):
                continue
            slope_u = first_slope[1] + (u + window[1]) * slope_cell
            norm = math.sqrt(1.0 + slope_v * slope_v + slope_u * slope_u)
            cosine = (1.0 + slope_v * first_slope[0] + slope_u * first_slope[1]) / (norm * start_norm)
            sine = math.sqrt(1.0 - 1.0 / (norm * norm))
            if math.acos(min(cosine, 1.0)) - HALF_DIAGONAL * slope_cell > 0.5 * math.pi:
                states[v, u] = 0
                continue
            here = 0
            for y in range(rows):
                dy = goal[0] - (y + window[2]) * cell
                for w in range(words):
                    value = states[v, u, y, w]
                    if value == 0:
                        continue
                    for b in range(64):
                        if not (value >> np.uint64(b)) & ONE:
                            continue
                        dx = goal[1] - (64 * w + b + window[3]) * cell
                        ahead = (dy * slope_v + dx * slope_u + goal[2]) / norm
                        away2 = dy * dy + dx * dx + goal[2] * goal[2]
                        aside = math.sqrt(max(away2 - ahead * ahead, 0.0))
                        slack = HALF_DIAGONAL * (cell + math.sqrt(away2) * slope_cell) + tolerance
                        if math.hypot(radius - aside, ahead) < radius - slack or (
                            ahead < -slack and aside < radius
                        ):
                            value &= ~(ONE << np.uint64(b))
                        else:
                            here += 1
                    states[v, u, y, w] = value
            kept += here
            if sine + HALF_DIAGONAL * slope_cell > largest_sine:
                steep += here
    return kept, steep


@numba.njit(cache=True)
def extent(states, out):
    """Fill `out` (8,) with the first and last direction row, column, position row, column in use."""
    nv, nu, rows, words = states.shape
    out[0::2] = 1 << 40
    out[1::2] = -1
    for v in range(nv):
        for u in range(nu):
            for y in range(rows):
                for w in range(words):
                    if states[v, u, y, w] != 0:
                        out[0] = min(out[0], v)
                        out[1] = max(out[1], v)
                        out[2] = min(out[2], u)
                        out[3] = max(out[3], u)
                        out[4] = min(out[4], y)
                        out[5] = max(out[5], y)
                        out[6] = min(out[6], 64 * w)
                        out[7] = max(out[7], 64 * w + 63)


@numba.njit(cache=True)
def keep_refined(states, window, coarse, coarse_window):
    """Remove the states that no state of a plane with cells twice as wide overlaps.  Both start at cell 0."""
    nv, nu, rows, words = states.shape
    to_v, to_u, to_rows, to_words = coarse.shape
    union = np.zeros((to_rows, to_words), np.uint64)
    for v in range(nv):
        for u in range(nu):
            if is_empty(states[v, u]):
                continue
            union[:] = 0
            for cv in range((2 * (v + window[0]) + 1) // 4, (2 * (v + window[0]) + 3) // 4 + 1):
                for cu in range((2 * (u + window[1]) + 1) // 4, (2 * (u + window[1]) + 3) // 4 + 1):
                    if 0 <= cv - coarse_window[0] < to_v and 0 <= cu - coarse_window[1] < to_u:
                        union |= coarse[cv - coarse_window[0], cu - coarse_window[1]]
            for y in range(rows):
                low = (2 * (y + window[2]) + 1) // 4 - coarse_window[2]
                high = (2 * (y + window[2]) + 3) // 4 - coarse_window[2]
                for w in range(words):
                    value = states[v, u, y, w]
                    if value == 0:
                        continue
                    for b in range(64):
                        if not (value >> np.uint64(b)) & ONE:
                            continue
                        x = 64 * w + b + window[3]
                        first = (2 * x + 1) // 4 - coarse_window[3]
                        last = (2 * x + 3) // 4 - coarse_window[3]
                        found = False
                        for cy in range(max(low, 0), min(high, to_rows - 1) + 1):
                            for cx in range(max(first, 0), min(last, 64 * to_words - 1) + 1):
                                if (union[cy, cx // 64] >> np.uint64(cx % 64)) & ONE:
                                    found = True
                        if not found:
                            value &= ~(ONE << np.uint64(b))
                    states[v, u, y, w] = value


@numba.njit(cache=True)
def keep_both(states, others):
    """Remove the states that are not in a second set of the same window; return how many are kept."""
    nv, nu, rows, words = states.shape
    kept = 0
    for v in range(nv):
        for u in range(nu):
            for y in range(rows):
                for w in range(words):
                    states[v, u, y, w] &= others[v, u, y, w]
                    value = states[v, u, y, w]
                    while value != 0:
                        value &= value - ONE
                        kept += 1
    return kept
