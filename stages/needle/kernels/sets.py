"""Sets of needle states on planes, as bitmaps: the moves of `stages.needle.certificate`.

A plane's states are cells of direction and lateral position: `bits[v, u, y, word]`, with directions in rows v
and columns u, positions in rows y and columns x, of which 64 share a word.  `window` (4,) holds the cell
numbers (v, u, y, x) of the first cell.  Direction (v, u) is the slope `first slope + (v, u) * slope cell`;
position (y, x) lies `(y, x) * cell` beside the tangent of the start.  Cells are `2 cell / slope cell` apart
in depth, so that half a slab with a slope (v, u) moves a position by (v, u) cells and nothing is rounded.

Every function over-estimates; docs/certificate.md has the inequalities.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from anatomy.kernels.compiling import inner_kernel
from anatomy.kernels.field import exact_distance, interpolate_squared

# What `scale` holds: sides of cells in mm and as a slope, slope of the start (v, u), curvature in 1/mm, and
# the largest sine of the angle between a path and the planes' normal.
CELL = 0
SLOPE_CELL = 1
FIRST_V = 2
FIRST_U = 3
KAPPA = 4
TOP_SINE = 5
SCALE_SIZE = 6

# What `ends` holds: distance from start to target, goal tolerance, longest way from start to target by way
# of any point of a path; of the spindle the depth of its middle, how far aside of it the centres of its arcs
# lie, and their radius (infinite: no spindle), all in mm.
TOTAL = 0
TOLERANCE = 1
LONGEST = 2
SPINDLE_MIDDLE = 3
SPINDLE_OFFSET = 4
SPINDLE_RADIUS = 5
ENDS_SIZE = 6

# With a type of its own a constant is no literal, for each of which what is called would be compiled anew.
_FIRST_BIT = np.int64(0)

ONE = np.uint64(1)
ALL = np.uint64(0xFFFFFFFFFFFFFFFF)
HALF_DIAGONAL = 0.7072
"""Half the diagonal of a square of side 1, rounded up."""
SPARE = 1e-6
"""Added to bounds in mm and in cells, for rounding and for limits that planners exceed by as little."""
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
            if 0 <= to < to_words:
                target[y + dy, to] |= value << low
            if rest and 0 <= to + 1 < to_words:
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
                    value = source[from_y, w] << low
                if rest and 0 <= w - 1 < words:
                    value |= source[from_y, w - 1] >> high
            target[y, to] &= value


@numba.njit(cache=True)
def spread(target, source, first, last, width, shift, scratch):
    """Set a row of words to another one, each bit spread by `width` cells to both sides and moved by `shift`.

    Only the words `first` to `last` of the source are used.  `scratch` is longer than the source by
    `2 width` bits and a word.
    """
    end = last + (2 * width + 63) // 64 + 1
    for w in range(first, end):
        scratch[w] = source[w] if w <= last else np.uint64(0)
    # To the right by doubling, so that each bit covers 2 width + 1 cells.
    covered = 1
    while covered < 2 * width + 1:
        by = min(covered, 2 * width + 1 - covered)
        step = by // 64
        rest = np.uint64(by - 64 * step)
        for w in range(end - 1, first + step - 1, -1):
            value = scratch[w - step] << rest
            if rest and w - step - 1 >= first:
                value |= scratch[w - step - 1] >> (np.uint64(64) - rest)
            scratch[w] |= value
        covered += by
    step = (shift - width) // 64
    rest = np.uint64(shift - width - 64 * step)
    for to in range(target.shape[0]):
        w = to - step
        value = np.uint64(0)
        if first <= w < end:
            value = scratch[w] << rest
        if rest and first <= w - 1 < end:
            value |= scratch[w - 1] >> (np.uint64(64) - rest)
        target[to] = value


@inner_kernel
def dilate(target, source, box, square, disc, dy, dx, scratch, row):
    """OR a bitmap into another, moved by whole cells, dilated by a square of half side `square` and a disc.

    Both in cells, any fraction.  A cell is reached if its centre is: the caller adds what a cell is wide.

    Parameters
    ----------
    target : (Y, W) uint64, source : (Y', W') uint64
    box : (4,) int64
        First and last row, first and last word of the source that count.
    square, disc : float
    dy, dx : int
    scratch : (S,) uint64, row : (W,) uint64
        Room to work in; see `spread`.
    """
    to_rows = target.shape[0]
    reach = int(math.floor(square + disc))
    for y in range(box[0], box[1] + 1):
        last = -1
        first_word, last_word = box[2], box[3]
        while first_word <= last_word and source[y, first_word] == 0:
            first_word += 1
        while last_word >= first_word and source[y, last_word] == 0:
            last_word -= 1
        if last_word < first_word:
            continue
        for side in range(reach, -1, -1):
            beyond = max(side - square, 0.0)
            width = int(math.floor(square + math.sqrt(max(disc * disc - beyond * beyond, 0.0))))
            above = y + dy + side
            below = y + dy - side
            if not 0 <= above < to_rows and not 0 <= below < to_rows:
                continue
            if width != last:
                spread(row, source[y], first_word, last_word, width, dx, scratch)
                last = width
            if 0 <= above < to_rows:
                for w in range(row.shape[0]):
                    target[above, w] |= row[w]
            if side > 0 and 0 <= below < to_rows:
                for w in range(row.shape[0]):
                    target[below, w] |= row[w]


@inner_kernel
def find_box(bitmap, box):
    """Fill `box` (4,) with the first and last row and word in use; return whether there is any bit."""
    rows, words = bitmap.shape
    box[0], box[1], box[2], box[3] = rows, -1, words, -1
    for y in range(rows):
        for w in range(words):
            if bitmap[y, w] != 0:
                box[0] = min(box[0], y)
                box[1] = y
                box[2] = min(box[2], w)
                box[3] = max(box[3], w)
    return box[1] >= 0


@inner_kernel
def slope_of(v, u, window, scale):
    """Return the slope (v, u) at the centre of a cell of directions."""
    return (
        scale[FIRST_V] + (v + window[0]) * scale[SLOPE_CELL],
        scale[FIRST_U] + (u + window[1]) * scale[SLOPE_CELL],
    )


@inner_kernel
def steepest_sine(slope_v, slope_u, scale):
    """Return the largest sine in a cell of directions that a path can have."""
    slope = math.hypot(slope_v, slope_u) + HALF_DIAGONAL * scale[SLOPE_CELL]
    return min(slope / math.sqrt(1.0 + slope * slope), scale[TOP_SINE])


@inner_kernel
def largest_second_derivative(sine, scale):
    """Return kappa / cos^3(theta), which bounds the second derivative of a path over depth."""
    sine = min(sine, scale[TOP_SINE])
    return scale[KAPPA] / (1.0 - sine * sine) ** 1.5


@inner_kernel
def largest_slope_change(sine, scale, depth):
    """Return by how much the slope of a path may change over a slab, from the largest sine at one end."""
    top = min(sine + scale[KAPPA] * depth, scale[TOP_SINE])
    change = top / math.sqrt(1.0 - top * top) - sine / math.sqrt(1.0 - sine * sine)
    return change + (depth - (top - sine) / scale[KAPPA]) * largest_second_derivative(top, scale)


@numba.njit(cache=True)
def largest_aside(sine, scale, depth, low, high):
    """Return how far a path may miss the place to which the mean of both slopes leads, in mm.

    `sine` is the largest at one end; over the slab the slope changes by between `low` and `high`.
    """
    kappa = scale[KAPPA]
    other = sine / math.sqrt(1.0 - sine * sine) + high
    # The sine changes by kappa a mm, so between the ends it is at most their mean and half of that.
    half_way = 0.5 * (sine + other / math.sqrt(1.0 + other * other) + kappa * depth)
    bound = largest_second_derivative(min(sine + kappa * depth, half_way), scale)
    share = min(low / (bound * depth), 1.0)
    return bound * depth * depth * min(0.25, 0.28868 * math.sqrt(1.0 - share * share))


@numba.njit(cache=True)
def table_shape(now, reach):
    """Return the shape of the table of `step_sets`: levels, directions, rows and words half-way."""
    nv, nu, rows, words = now.shape
    levels = 1
    while (1 << levels) <= min(2 * reach + 3, nu):
        levels += 1
    return levels, nv, nu, rows + nv - 1, words + (nu - 1 + 63) // 64


@numba.njit(cache=True)
def largest_reach(scale, depth, blur, window, nv, nu):
    """Return by how many cells of directions a state may change over a slab, in the directions given."""
    steepest = 0.0
    for v in range(nv):
        for u in range(nu):
            slope_v, slope_u = slope_of(v, u, window, scale)
            steepest = max(steepest, steepest_sine(slope_v, slope_u, scale))
    change = largest_slope_change(steepest, scale, depth)
    return int(math.floor(change / scale[SLOPE_CELL] + blur * HALF_DIAGONAL + SPARE))


@numba.njit(cache=True)
def step_sets(now, now_window, scale, depth, way, blur, edges, out, out_window):
    """Keep of the states of the next plane, or the one before, those that a plane's states may reach.

    Obstacles are not looked at.  On a path x(h) over depth, x(h + d) - x(h) = d (x'(h) + x'(h + d)) / 2 + the
    integral of (d / 2 - t) x'' over the slab.  With |x''| <= w the last term is at most w d^2 / 4, and by the
    inequality of Cauchy and Schwarz at most w d^2 sqrt((1 - r^2) / 12) where the slope changes by r w d.

    Parameters
    ----------
    now, out : (V, U, Y, W) uint64
        States of this plane, and of the other.
    now_window, out_window : (4,) int64
    scale : (SCALE_SIZE,) float64
    depth : float
        Distance of the planes in mm.
    way : int
        1 to the next plane, -1 to the one before.
    blur : float
        2, or 1 if the one state in `now` is known exactly.
    edges : (C,) float64
        Upper edges of the classes of slope change, as shares of the largest, rising to 1.
    """
    nv, nu = now.shape[0], now.shape[1]
    to_v, to_u, rows, words = out.shape
    most = largest_reach(scale, depth, blur, out_window, to_v, to_u)
    levels, _nv, _nu, mid_rows, mid_words = table_shape(now, most)
    table = np.zeros((levels, nv, nu, mid_rows, mid_words), np.uint64)
    boxes = np.zeros((levels, nv, nu, 4), np.int64)
    boxes[..., 1] = -1
    # Half-way, states have moved by their own slope alone: by as many cells as the number of the slope says.
    first_v = now_window[0] if way > 0 else -(now_window[0] + nv - 1)
    first_u = now_window[1] if way > 0 else -(now_window[1] + nu - 1)
    for v in range(nv):
        for u in range(nu):
            shift_y = v if way > 0 else nv - 1 - v
            or_shifted(table[0, v, u], now[v, u], shift_y, u if way > 0 else nu - 1 - u)
            find_box(table[0, v, u], boxes[0, v, u])
        for level in range(1, levels):
            span = 1 << (level - 1)
            for u in range(nu - 2 * span + 1):
                for other in range(u, u + span + 1, span):
                    _or_box(table[level, v, u], boxes[level, v, u], table[level - 1, v, other],
                            boxes[level - 1, v, other])  # fmt: skip
    widest = largest_aside(scale[TOP_SINE], scale, depth, 0.0, 1e9) / scale[CELL]
    square = blur + SPARE
    gathered = np.zeros((mid_rows, mid_words), np.uint64)
    wide = np.zeros((rows, words), np.uint64)
    row = np.zeros(words, np.uint64)
    scratch = np.zeros(mid_words + (2 * int(square + widest) + 63) // 64 + 2, np.uint64)
    box = np.zeros(4, np.int64)
    allowed = np.zeros(4, np.int64)
    limits = np.zeros(4, np.int64)
    for tv in range(to_v):
        for tu in range(to_u):
            if not find_box(out[tv, tu], allowed):
                continue
            move_y = way * (tv + out_window[0]) + first_v + now_window[2] - out_window[2]
            move_x = way * (tu + out_window[1]) + first_u + now_window[3] - out_window[3]
            slope_v, slope_u = slope_of(tv, tu, out_window, scale)
            sine = steepest_sine(slope_v, slope_u, scale)
            change = largest_slope_change(sine, scale, depth)
            wide[allowed[0] : allowed[1] + 1] = 0
            for c in range(edges.shape[0]):
                low = edges[c - 1] if c > 0 else 0.0
                disc = (
                    largest_aside(sine, scale, depth, low * change, edges[c] * change) / scale[CELL] + SPARE
                )
                far = int(math.ceil(square + disc))
                limits[0] = max(allowed[0] - far - move_y, 0)
                limits[1] = min(allowed[1] + far - move_y, mid_rows - 1)
                limits[2] = max((64 * allowed[2] - far - move_x) // 64, 0)
                limits[3] = min((64 * allowed[3] + 63 + far - move_x) // 64, mid_words - 1)
                reach = edges[c] * change / scale[SLOPE_CELL] + blur * HALF_DIAGONAL + SPARE
                box[1] = -1
                _gather(
                    gathered, box, limits, table, boxes, tv + out_window[0] - now_window[0],
                    tu + out_window[1] - now_window[1], reach,
                )  # fmt: skip
                if box[1] >= 0:
                    dilate(wide, gathered, box, square, disc, move_y, move_x, scratch, row)
                    gathered[box[0] : box[1] + 1, box[2] : box[3] + 1] = 0
            for y in range(allowed[0], allowed[1] + 1):
                for w in range(words):
                    out[tv, tu, y, w] &= wide[y, w]


@inner_kernel
def _or_box(target, target_box, source, box):
    """OR one bitmap into another within the box of the first, which is added to that of the other."""
    if box[1] < box[0]:
        return
    for y in range(box[0], box[1] + 1):
        for w in range(box[2], box[3] + 1):
            target[y, w] |= source[y, w]
    if target_box[1] < target_box[0]:
        for m in range(4):
            target_box[m] = box[m]
        return
    for m in range(0, 4, 2):
        target_box[m] = min(target_box[m], box[m])
        target_box[m + 1] = max(target_box[m + 1], box[m + 1])


@inner_kernel
def _gather(target, target_box, limits, table, boxes, v, u, reach):
    """OR the bitmaps of all directions within `reach` cells of (v, u), as far as the box `limits` goes."""
    nv, nu = table.shape[1], table.shape[2]
    part = np.zeros(4, np.int64)
    far = int(math.floor(reach))
    for from_v in range(max(v - far, 0), min(v + far, nv - 1) + 1):
        width = int(math.floor(math.sqrt(reach * reach - (from_v - v) * (from_v - v))))
        low = max(u - width, 0)
        high = min(u + width, nu - 1)
        if low > high:
            continue
        level = 0
        while (1 << (level + 1)) <= high - low + 1:
            level += 1
        for side in range(2 if high - low + 1 > 1 << level else 1):
            at = low if side == 0 else high - (1 << level) + 1
            for m in range(0, 4, 2):
                part[m] = max(boxes[level, from_v, at, m], limits[m])
                part[m + 1] = min(boxes[level, from_v, at, m + 1], limits[m + 1])
            if part[0] <= part[1] and part[2] <= part[3]:
                _or_box(target, target_box, table[level, from_v, at], part)


@numba.njit(cache=True)
def escape_depth(rho, h, radius):
    """Return how deep a point lies among the points that no needle reaches, as a number below 0, in mm.

    It is `rho` mm aside of the needle and `h` mm ahead.  A needle that turns by 180 degrees in all reaches
    neither points in the torus of its tightest circles nor, behind it, points less than two radii aside.
    Points outside get 0 or more.  The number is 1-Lipschitz.
    """
    if h >= 0.0:
        return math.hypot(radius - rho, h) - radius
    return -min(math.hypot(rho, h), 2.0 * radius - rho)


@inner_kernel
def hope_of_place(h, y, x, scale, ends):
    """Return by how much a place may be moved before no path leads through it, in mm; below 0 if none does.

    It lies `h` mm deep, and (y, x) mm aside of the line from start to target.
    """
    radius = 1.0 / scale[KAPPA]
    norm2 = 1.0 + scale[FIRST_V] ** 2 + scale[FIRST_U] ** 2
    ahead = (h + y * scale[FIRST_V] + x * scale[FIRST_U]) / math.sqrt(norm2)
    aside2 = y * y + x * x
    rho = math.sqrt(max(h * h + aside2 - ahead * ahead, 0.0))
    hope = escape_depth(rho, ahead, radius)
    way = math.sqrt(h * h + aside2) + math.sqrt((ends[TOTAL] - h) ** 2 + aside2)
    hope = min(hope, 0.5 * (ends[LONGEST] - way))
    if ends[SPINDLE_RADIUS] < math.inf:
        from_centre = math.hypot(math.sqrt(aside2) + ends[SPINDLE_OFFSET], h - ends[SPINDLE_MIDDLE])
        hope = min(hope, ends[SPINDLE_RADIUS] - from_centre)
    return hope + SPARE


@inner_kernel
def _hope_of_state(h, y, x, slope_v, slope_u, blur, scale, ends):
    """Return the same for a state; `blur` is the angle between a cell's directions and its centre's."""
    radius = 1.0 / scale[KAPPA]
    norm = math.sqrt(1.0 + slope_v * slope_v + slope_u * slope_u)
    aside2 = y * y + x * x
    left = ends[TOTAL] - h
    sideways = y * slope_v + x * slope_u
    ahead = (left - sideways) / norm
    away2 = left * left + aside2
    hope = escape_depth(math.sqrt(max(away2 - ahead * ahead, 0.0)), ahead, radius)
    hope += math.sqrt(away2) * blur + ends[TOLERANCE]
    # The same path backward leads to the start.
    ahead = (h + sideways) / norm
    away2 = h * h + aside2
    back = escape_depth(math.sqrt(max(away2 - ahead * ahead, 0.0)), ahead, radius) + math.sqrt(away2) * blur
    return min(hope, back) + HALF_DIAGONAL * scale[CELL] + SPARE


@numba.njit(cache=True)
def keep_hopeful(states, window, scale, ends, depth, reference, max_angle):
    """Remove the states of a plane from which the goal cannot be reached, or which the start cannot reach.

    Parameters
    ----------
    states : (V, U, Y, W) uint64, window : (4,) int64
    scale, ends : (SCALE_SIZE,), (ENDS_SIZE,) float64
    depth : float
        Of the plane, mm.
    reference : (3,) float64
        Direction from which the limit of the angle counts: its component along the planes' normal, and its
        row and column.
    max_angle : float
        That limit, rad.
    """
    nv, nu, rows, words = states.shape
    cell = scale[CELL]
    top = scale[TOP_SINE] / math.sqrt(1.0 - scale[TOP_SINE] ** 2)
    possible = np.zeros((rows, words), np.uint64)
    for y in range(rows):
        side_y = (y + window[2]) * cell + depth * scale[FIRST_V]
        x = _FIRST_BIT
        while x < 64 * words:
            side_x = (x + window[3]) * cell + depth * scale[FIRST_U]
            hope = hope_of_place(depth, side_y, side_x, scale, ends) + HALF_DIAGONAL * cell
            x = _set_run(possible[y], x, hope, cell)
    box = np.zeros(4, np.int64)
    row = np.zeros(words, np.uint64)
    for v in range(nv):
        for u in range(nu):
            slope_v, slope_u = slope_of(v, u, window, scale)
            slope = math.hypot(slope_v, slope_u)
            least = max(slope - HALF_DIAGONAL * scale[SLOPE_CELL], 0.0)
            blur = HALF_DIAGONAL * scale[SLOPE_CELL] / math.sqrt(1.0 + least * least)
            cosine = (reference[0] + slope_v * reference[1] + slope_u * reference[2]) / math.hypot(1.0, slope)
            if least > top or math.acos(max(min(cosine, 1.0), -1.0)) - blur > max_angle + SPARE:
                states[v, u] = 0
                continue
            for y in range(rows):
                for w in range(words):
                    states[v, u, y, w] &= possible[y, w]
            if not find_box(states[v, u], box):
                continue
            # All of the box may be decided by the hope at its middle.
            middle_y = (0.5 * (box[0] + box[1]) + window[2]) * cell + depth * scale[FIRST_V]
            middle_x = (32.0 * (box[2] + box[3] + 1) - 0.5 + window[3]) * cell + depth * scale[FIRST_U]
            away = 0.5 * cell * math.hypot(box[1] - box[0], 64.0 * (box[3] - box[2] + 1))
            hope = _hope_of_state(depth, middle_y, middle_x, slope_v, slope_u, blur, scale, ends)
            if hope >= (1.0 + blur) * away:
                continue
            if hope < -(1.0 + blur) * away:
                states[v, u] = 0
                continue
            for y in range(box[0], box[1] + 1):
                row[box[2] : box[3] + 1] = 0
                side_y = (y + window[2]) * cell + depth * scale[FIRST_V]
                x = 64 * box[2]
                while x < 64 * (box[3] + 1):
                    side_x = (x + window[3]) * cell + depth * scale[FIRST_U]
                    hope = _hope_of_state(depth, side_y, side_x, slope_v, slope_u, blur, scale, ends)
                    x = _set_run(row[: box[3] + 1], x, hope, (1.0 + blur) * cell)
                for w in range(box[2], box[3] + 1):
                    states[v, u, y, w] &= row[w]


@inner_kernel
def _set_run(row, x, hope, step):
    """Set the bits from `x` on to whether there is hope, as far as its sign is sure; return where that ends.

    Hope changes by at most `step` from bit to bit.
    """
    run = min(max(int(math.ceil(abs(hope) / step)), 1), 64 * row.shape[0] - x)
    end = x + run
    if hope < 0.0:
        return end
    for w in range(x // 64, (end - 1) // 64 + 1):
        value = ALL
        if w == x // 64:
            value &= ALL << np.uint64(x - 64 * w)
        if end < 64 * (w + 1):
            value &= ALL >> np.uint64(64 * (w + 1) - end)
        row[w] |= value
    return end


@inner_kernel
def _probed_at(v, u, window, scale, depth):
    """Return the whole cells (y, x) by which a tangent has moved at a depth, and what that leaves in mm."""
    move = depth * scale[SLOPE_CELL] / scale[CELL]
    move_y = (v + window[0]) * move
    move_x = (u + window[1]) * move
    y = int(round(move_y))
    x = int(round(move_x))
    return y, x, abs(move_y - y) * scale[CELL], abs(move_x - x) * scale[CELL]


@numba.njit(cache=True)
def mark_probed(states, window, scale, depths, probed, corners):
    """Set the bits of the cells that the tangents of a plane's states meet at some depths.

    Parameters
    ----------
    states : (V, U, Y, W) uint64, window : (4,) int64
    scale : (SCALE_SIZE,) float64
    depths : (D,) float64
        As seen from the plane, mm.
    probed : (D, Y', W') uint64
    corners : (D, 2) int64
        Cell numbers (y, x) of the first cell of each.
    """
    nv, nu, _rows, _words = states.shape
    box = np.zeros(4, np.int64)
    for v in range(nv):
        for u in range(nu):
            if find_box(states[v, u], box):
                for d in range(depths.shape[0]):
                    y, x, _left_y, _left_x = _probed_at(v, u, window, scale, depths[d])
                    or_shifted(
                        probed[d], states[v, u], window[2] + y - corners[d, 0], window[3] + x - corners[d, 1]
                    )


@numba.njit(cache=True)
def clearance_above(space, required, spare, exempt_branch, x, y, z):
    """Return a clearance in mm that the true one of a point is never above, as far as it is worth knowing.

    Where the clearance is at least `required - spare` and the field says so, `required` is returned.
    """
    field, labels, geometry, bits = space
    squared, spread2 = interpolate_squared(field, geometry, x, y, z)
    least = max(required - spare, 0.0)
    if squared > 0.0 and squared - spread2 >= least * least:
        return required
    above = math.sqrt(squared) + math.sqrt(spread2) + FIELD_STEP_MM
    if exempt_branch < 0 and squared > 0.0 and above < 0.5 * required:
        return above
    return exact_distance(labels, geometry, x, y, z, bits, exempt_branch, required)[0]


@inner_kernel
def _grade_of(slacks, value):
    """Return which of the rising `slacks` is the first not below a value; their number if none is."""
    for q in range(slacks.shape[0]):
        if slacks[q] >= value:
            return q
    return slacks.shape[0]


@numba.njit(cache=True)
def grade_clearance(space, required, exempt_branch, origin, across, probed, slacks, grades):
    """Fill `grades` (Y, 64 W) uint8 with the first of the `slacks` that a cell's lack of clearance is within.

    Of the cells of one plane only those are looked at that are set in `probed` (Y, W).  A lack is required
    clearance less the clearance at the cell's centre; one beyond all of the Q `slacks` (rising) gets Q.
    `origin` is the first cell's centre, `across` (2, 3) are the steps from row to row and column to column.
    Airway voxels of `exempt_branch` (-1: none) do not count.
    """
    rows, words = probed.shape
    for y in range(rows):
        for x in range(64 * words):
            if not (probed[y, x // 64] >> np.uint64(x % 64)) & ONE:
                continue
            above = clearance_above(
                space, required, slacks[0], exempt_branch,
                origin[0] + y * across[0, 0] + x * across[1, 0],
                origin[1] + y * across[0, 1] + x * across[1, 1],
                origin[2] + y * across[0, 2] + x * across[1, 2],
            )  # fmt: skip
            grades[y, x] = _grade_of(slacks, required - above - SPARE)


@numba.njit(cache=True)
def keep_clear(states, window, scale, depths, corners, grades, slacks):
    """Remove the states from which half a slab behind or ahead is blocked for every path.

    Parameters
    ----------
    states : (V, U, Y, W) uint64, window : (4,) int64
    scale : (SCALE_SIZE,) float64
    depths, corners
        See `mark_probed`.
    grades : (D, Y', X') uint8, slacks : (Q,) float64
        See `grade_clearance`.
    """
    nv, nu, _rows, _words = states.shape
    free = np.zeros((depths.shape[0], slacks.shape[0], grades.shape[1], grades.shape[2] // 64), np.uint64)
    made = np.zeros((depths.shape[0], slacks.shape[0]), np.bool_)
    box = np.zeros(4, np.int64)
    for v in range(nv):
        for u in range(nu):
            slope_v, slope_u = slope_of(v, u, window, scale)
            sine = steepest_sine(slope_v, slope_u, scale)
            for d in range(depths.shape[0]):
                if not find_box(states[v, u], box):
                    break
                depth = abs(depths[d])
                y, x, left_y, left_x = _probed_at(v, u, window, scale, depths[d])
                half = 0.5 * (scale[CELL] + scale[SLOPE_CELL] * depth)
                bound = largest_second_derivative(sine + scale[KAPPA] * depth, scale)
                slack = math.hypot(half + left_y, half + left_x) + 0.5 * bound * depth * depth + SPARE
                q = _grade_of(slacks, slack)
                if q == slacks.shape[0]:
                    continue
                if not made[d, q]:
                    made[d, q] = True
                    _free_within(grades[d], q, free[d, q])
                and_shifted(
                    states[v, u], free[d, q], corners[d, 0] - window[2] - y, corners[d, 1] - window[3] - x
                )


@inner_kernel
def _free_within(grades, most, out):
    """Set the bits of the cells whose grade is at most `most`."""
    for y in range(grades.shape[0]):
        for x in range(grades.shape[1]):
            if grades[y, x] <= most:
                out[y, x // 64] |= ONE << np.uint64(x % 64)


@numba.njit(cache=True)
def extent(states, out):
    """Fill `out` (8,) with the first and last direction row, column, position row and word in use."""
    nv, nu, _rows, _words = states.shape
    out[0::2] = 1 << 40
    out[1::2] = -1
    box = np.zeros(4, np.int64)
    for v in range(nv):
        for u in range(nu):
            if find_box(states[v, u], box):
                out[0] = min(out[0], v)
                out[1] = max(out[1], v)
                out[2] = min(out[2], u)
                out[3] = max(out[3], u)
                for m in range(0, 4, 2):
                    out[4 + m] = min(out[4 + m], box[m])
                    out[5 + m] = max(out[5 + m], box[m + 1])


@numba.njit(cache=True)
def refine(coarse, halve_slopes, out):
    """Set the cells that overlap or touch a cell, twice as wide, that is set in `coarse` (V, U, Y, W).

    `out` is (2 V + 1, 2 U + 1, 2 Y + 1, 2 W + 1) and starts at twice the cell number less one.  Unless
    `halve_slopes`, the cells of directions stay, and so do the first two numbers of shape and start.
    """
    nv, nu, rows, words = coarse.shape
    box = np.zeros(4, np.int64)
    wide = np.zeros((2 * rows + 1, 2 * words + 1), np.uint64)
    for v in range(nv):
        for u in range(nu):
            if not find_box(coarse[v, u], box):
                continue
            wide[:] = 0
            for y in range(box[0], box[1] + 1):
                for w in range(2 * box[2], 2 * box[3] + 2):
                    value = _every_other(coarse[v, u, y, w // 2] >> np.uint64(32 * (w % 2)))
                    beyond = value >> np.uint64(62)
                    value |= value << ONE | value << np.uint64(2)
                    for to in range(2 * y, 2 * y + 3):
                        wide[to, w] |= value
                        wide[to, w + 1] |= beyond
            for to_v in range(2 * v if halve_slopes else v, 2 * v + 3 if halve_slopes else v + 1):
                for to_u in range(2 * u if halve_slopes else u, 2 * u + 3 if halve_slopes else u + 1):
                    for y in range(2 * box[0], 2 * box[1] + 3):
                        for w in range(2 * box[2], 2 * box[3] + 3):
                            out[to_v, to_u, y, w] |= wide[y, w]


@inner_kernel
def _every_other(word):
    """Return the lower 32 bits of a word, moved to its even places."""
    word &= np.uint64(0xFFFFFFFF)
    word = (word | (word << np.uint64(16))) & np.uint64(0x0000FFFF0000FFFF)
    word = (word | (word << np.uint64(8))) & np.uint64(0x00FF00FF00FF00FF)
    word = (word | (word << np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    word = (word | (word << np.uint64(2))) & np.uint64(0x3333333333333333)
    return (word | (word << ONE)) & np.uint64(0x5555555555555555)


@numba.njit(cache=True)
def flood(space, required, exempt_branch, exempt_mm, scale, ends, frame, side, corner, seen, queue):
    """Fill the cubes that may be passed, from that of the start on; return whether one of the goal's is met.

    A path goes from one cube to another through a point of both, so to one of its 26 neighbours.

    Parameters
    ----------
    space : tuple
        See `stages.needle.kernels.proof`.
    required : float
    exempt_branch : int, exempt_mm : float
        Branch whose airway voxels do not count less than so many mm away from the start.
    scale, ends : (SCALE_SIZE,), (ENDS_SIZE,) float64
    frame : (4, 3) float64
        Position of the start; the planes' normal, row and column direction.
    side : float
        Of the cubes, mm.
    corner : (3,) int64
        Cube numbers (depth, y, x) of the first cube; that of the start has numbers 0.
    seen : (H, Y, X) bool
        All False; those looked at are set.
    queue : (H Y X,) int32
    """
    nh, ny, nx = seen.shape
    half = 0.8661 * side + SPARE
    first = (-corner[0] * ny - corner[1]) * nx - corner[2]
    queue[0] = first
    seen[-corner[0], -corner[1], -corner[2]] = True
    begin = 0
    end = 1
    while begin < end:
        number = queue[begin]
        begin += 1
        i = number // (ny * nx)
        j = number // nx - i * ny
        k = number - (i * ny + j) * nx
        h, y, x = (i + corner[0]) * side, (j + corner[1]) * side, (k + corner[2]) * side
        if math.sqrt((ends[TOTAL] - h) ** 2 + y * y + x * x) <= ends[TOLERANCE] + half:
            return True
        for a in range(max(i - 1, 0), min(i + 2, nh)):
            for b in range(max(j - 1, 0), min(j + 2, ny)):
                for c in range(max(k - 1, 0), min(k + 2, nx)):
                    if seen[a, b, c]:
                        continue
                    seen[a, b, c] = True
                    h, y, x = (a + corner[0]) * side, (b + corner[1]) * side, (c + corner[2]) * side
                    if hope_of_place(h, y, x, scale, ends) + half < 0.0:
                        continue
                    exempt = exempt_branch if math.sqrt(h * h + y * y + x * x) - half < exempt_mm else -1
                    above = clearance_above(
                        space, required, half, exempt,
                        frame[0, 0] + h * frame[1, 0] + y * frame[2, 0] + x * frame[3, 0],
                        frame[0, 1] + h * frame[1, 1] + y * frame[2, 1] + x * frame[3, 1],
                        frame[0, 2] + h * frame[1, 2] + y * frame[2, 2] + x * frame[3, 2],
                    )  # fmt: skip
                    if above + half >= required:
                        queue[end] = (a * ny + b) * nx + c
                        end += 1
    return False


@numba.njit(cache=True)
def steepest_of(states, window, scale):
    """Return the largest sine in the cells of states."""
    box = np.zeros(4, np.int64)
    steepest = 0.0
    for v in range(states.shape[0]):
        for u in range(states.shape[1]):
            if find_box(states[v, u], box):
                slope_v, slope_u = slope_of(v, u, window, scale)
                slope = math.hypot(slope_v, slope_u) + HALF_DIAGONAL * scale[SLOPE_CELL]
                steepest = max(steepest, slope / math.sqrt(1.0 + slope * slope))
    return steepest
