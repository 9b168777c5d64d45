"""From the set of states that paths can have on one plane to that on the next.

A plane's states are cells of direction and lateral position: `bits[v, u, y, word]`, with directions in rows v
and columns u, positions in rows y and columns x, of which 64 share a word.  `window` (4,) holds the cell
numbers (v, u, y, x) of the first cell.  Direction (v, u) is the slope `first slope + (v, u) * slope cell`;
position (y, x) lies `(y, x) * cell` beside the tangent of the start.  Cells are `2 cell / slope cell` apart
in depth, so that half a slab with a slope (v, u) moves a position by (v, u) cells and nothing is rounded.

Every function over-estimates; docs/theory/no_path.md has the inequalities.
"""

import math

import numpy as np

from anatomy.kernels.compiling import kernel, merged_kernel
from stages.needle.infeasibility.kernels import bounds
from stages.needle.infeasibility.kernels.bitmaps import dilate, find_box, or_box, or_shifted


@kernel(nogil=True)
def table_shape(now, reach):
    """Return the shape of the table of `step_sets`: levels, directions, rows and words half-way."""
    nv, nu, rows, words = now.shape
    levels = 1
    while (1 << levels) <= min(2 * reach + 3, nu):
        levels += 1
    return levels, nv, nu, rows + nv - 1, words + (nu - 1 + 63) // 64


@kernel(nogil=True)
def step_sets(now, now_window, scale, depth, direction, blur, edges, out, out_window):
    """Keep of the states of the next plane, or the one before, those that a plane's states may reach.

    Obstacles are not looked at.  On a path x(h) over depth, x(h + d) - x(h) = d (x'(h) + x'(h + d)) / 2 + the
    integral of (d / 2 - t) x'' over the slab.  With |x''| <= w the last term is at most w d^2 / 4, and by the
    inequality of Cauchy and Schwarz at most w d^2 sqrt((1 - r^2) / 12) where the slope changes by r w d.

    Args:
        now, out ((V, U, Y, W) uint64): States of this plane, and of the other; their windows are (4,) int64.
        scale: (SCALE_SIZE,) float64.
        depth, direction (float, int): Distance of the planes in mm; 1 to the next plane, -1 to the one
            before.
        blur (float): 2, or 1 if the one state in `now` is known exactly.
        edges ((C,) float64): Upper edges of the classes of slope change, as shares of the largest, rising to
            1.
    """
    nv, nu = now.shape[0], now.shape[1]
    to_v, to_u, rows, words = out.shape
    most = bounds.largest_reach(scale, depth, blur, out_window, to_v, to_u)
    levels, _nv, _nu, mid_rows, mid_words = table_shape(now, most)
    table = np.zeros((levels, nv, nu, mid_rows, mid_words), np.uint64)
    boxes = np.zeros((levels, nv, nu, 4), np.int64)
    boxes[..., 1] = -1
    # Half-way, states have moved by their own slope alone: by as many cells as the number of the slope says.
    first_v = now_window[0] if direction > 0 else -(now_window[0] + nv - 1)
    first_u = now_window[1] if direction > 0 else -(now_window[1] + nu - 1)
    for v in range(nv):
        for u in range(nu):
            shift_y = v if direction > 0 else nv - 1 - v
            or_shifted(table[0, v, u], now[v, u], shift_y, u if direction > 0 else nu - 1 - u)
            find_box(table[0, v, u], boxes[0, v, u])
        for level in range(1, levels):
            span = 1 << (level - 1)
            for u in range(nu - 2 * span + 1):
                for other in range(u, u + span + 1, span):
                    or_box(table[level, v, u], boxes[level, v, u], table[level - 1, v, other],
                            boxes[level - 1, v, other])  # fmt: skip
    widest = bounds.largest_aside(scale[bounds.TOP_SINE], scale, depth, 0.0, 1e9) / scale[bounds.CELL]
    square = blur + bounds.SPARE
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
            move_y = direction * (tv + out_window[0]) + first_v + now_window[2] - out_window[2]
            move_x = direction * (tu + out_window[1]) + first_u + now_window[3] - out_window[3]
            slope_v, slope_u = bounds.slope_of(tv, tu, out_window, scale)
            sine = bounds.steepest_sine(slope_v, slope_u, scale)
            change = bounds.largest_slope_change(sine, scale, depth)
            wide[allowed[0] : allowed[1] + 1] = 0
            for c in range(edges.shape[0]):
                low = edges[c - 1] if c > 0 else 0.0
                disc = (
                    bounds.largest_aside(sine, scale, depth, low * change, edges[c] * change)
                    / scale[bounds.CELL]
                    + bounds.SPARE
                )
                far = int(math.ceil(square + disc))
                limits[0] = max(allowed[0] - far - move_y, 0)
                limits[1] = min(allowed[1] + far - move_y, mid_rows - 1)
                limits[2] = max((64 * allowed[2] - far - move_x) // 64, 0)
                limits[3] = min((64 * allowed[3] + 63 + far - move_x) // 64, mid_words - 1)
                reach = (
                    edges[c] * change / scale[bounds.SLOPE_CELL] + blur * bounds.HALF_DIAGONAL + bounds.SPARE
                )
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


@merged_kernel
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
                or_box(target, target_box, table[level, from_v, at], part)
