"""What is known of all paths: how fast direction and place change, what is out of reach of either end."""

import math

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel
from stages.needle.infeasibility.kernels.bitmaps import ALL, find_box

# What `scale` holds: sides of cells in mm and as a slope, slope of the start (v, u), curvature in 1/mm, and
# the largest sine of the angle between a path and the planes' normal.
CELL, SLOPE_CELL, FIRST_V, FIRST_U, KAPPA, TOP_SINE, SCALE_SIZE = range(7)

# What `ends` holds: distance from start to target, goal tolerance, longest detour from start to target
# through any point of a path; of the spindle the depth of its middle, how far aside of it the centres of its
# arcs lie, and their radius (infinite: no spindle), all in mm.
TOTAL, TOLERANCE, LONGEST, SPINDLE_MIDDLE, SPINDLE_OFFSET, SPINDLE_RADIUS, ENDS_SIZE = range(7)
HALF_DIAGONAL = 0.7072
"""Half the diagonal of a square of side 1, rounded up."""
SPARE = 1e-6
"""Added to bounds in mm and in cells, for rounding and for limits that planners exceed by as little."""


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


@kernel(nogil=True)
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


@kernel(nogil=True)
def largest_aside(sine, scale, depth, low, high):
    """Return how far (mm) paths may miss where both slopes' mean leads; slopes change by `low` to `high`."""
    kappa = scale[KAPPA]
    other = sine / math.sqrt(1.0 - sine * sine) + high
    # The sine changes by kappa a mm, so between the ends it is at most their mean and half of that.
    half_way = 0.5 * (sine + other / math.sqrt(1.0 + other * other) + kappa * depth)
    bound = largest_second_derivative(min(sine + kappa * depth, half_way), scale)
    share = min(low / (bound * depth), 1.0)
    return bound * depth * depth * min(0.25, 0.28868 * math.sqrt(1.0 - share * share))


@kernel(nogil=True)
def largest_reach(scale, depth, blur, window, nv, nu):
    """Return by how many cells of directions a state may change over a slab, in the directions given."""
    steepest = 0.0
    for v in range(nv):
        for u in range(nu):
            slope_v, slope_u = slope_of(v, u, window, scale)
            steepest = max(steepest, steepest_sine(slope_v, slope_u, scale))
    change = largest_slope_change(steepest, scale, depth)
    return int(math.floor(change / scale[SLOPE_CELL] + blur * HALF_DIAGONAL + SPARE))


# With a type of its own a constant is no literal, for each of which what is called would be compiled anew.
_FIRST_BIT = np.int64(0)


@kernel(nogil=True)
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
def place_margin(h, y, x, scale, ends):
    """Return a margin of a place in mm; if it is below 0, no path leads through the place.

    The margin is 1-Lipschitz.  The place lies `h` mm deep, and (y, x) mm aside of the line to the target.
    """
    radius = 1.0 / scale[KAPPA]
    norm2 = 1.0 + scale[FIRST_V] ** 2 + scale[FIRST_U] ** 2
    ahead = (h + y * scale[FIRST_V] + x * scale[FIRST_U]) / math.sqrt(norm2)
    aside2 = y * y + x * x
    rho = math.sqrt(max(h * h + aside2 - ahead * ahead, 0.0))
    margin = escape_depth(rho, ahead, radius)
    detour = math.sqrt(h * h + aside2) + math.sqrt((ends[TOTAL] - h) ** 2 + aside2)
    margin = min(margin, 0.5 * (ends[LONGEST] - detour))
    if ends[SPINDLE_RADIUS] < math.inf:
        from_centre = math.hypot(math.sqrt(aside2) + ends[SPINDLE_OFFSET], h - ends[SPINDLE_MIDDLE])
        margin = min(margin, ends[SPINDLE_RADIUS] - from_centre)
    return margin + SPARE


@inner_kernel
def _state_margin(h, y, x, slope_v, slope_u, blur, scale, ends):
    """Return the same for a state; `blur` is the angle between a cell's directions and its centre's."""
    radius = 1.0 / scale[KAPPA]
    norm = math.sqrt(1.0 + slope_v * slope_v + slope_u * slope_u)
    aside2 = y * y + x * x
    left = ends[TOTAL] - h
    sideways = y * slope_v + x * slope_u
    ahead = (left - sideways) / norm
    away2 = left * left + aside2
    margin = escape_depth(math.sqrt(max(away2 - ahead * ahead, 0.0)), ahead, radius)
    margin += math.sqrt(away2) * blur + ends[TOLERANCE]
    # The same path backward leads to the start.
    ahead = (h + sideways) / norm
    away2 = h * h + aside2
    back = escape_depth(math.sqrt(max(away2 - ahead * ahead, 0.0)), ahead, radius) + math.sqrt(away2) * blur
    return min(margin, back) + HALF_DIAGONAL * scale[CELL] + SPARE


@kernel(nogil=True)
def prune_unreachable(states, window, scale, ends, depth, reference, max_angle):
    """Remove the states of a plane from which the goal cannot be reached, or which the start cannot reach.

    The plane lies `depth` mm deep.  The limit of the angle, `max_angle` rad, counts from the direction
    `reference` (3,): its component along the planes' normal, and its row and column.
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
            margin = place_margin(depth, side_y, side_x, scale, ends) + HALF_DIAGONAL * cell
            x = _set_run(possible[y], x, margin, cell)
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
            # The margin at the middle of the box may decide all of it.
            middle_y = (0.5 * (box[0] + box[1]) + window[2]) * cell + depth * scale[FIRST_V]
            middle_x = (32.0 * (box[2] + box[3] + 1) - 0.5 + window[3]) * cell + depth * scale[FIRST_U]
            away = 0.5 * cell * math.hypot(box[1] - box[0], 64.0 * (box[3] - box[2] + 1))
            margin = _state_margin(depth, middle_y, middle_x, slope_v, slope_u, blur, scale, ends)
            if margin >= (1.0 + blur) * away:
                continue
            if margin < -(1.0 + blur) * away:
                states[v, u] = 0
                continue
            for y in range(box[0], box[1] + 1):
                row[box[2] : box[3] + 1] = 0
                side_y = (y + window[2]) * cell + depth * scale[FIRST_V]
                x = 64 * box[2]
                while x < 64 * (box[3] + 1):
                    side_x = (x + window[3]) * cell + depth * scale[FIRST_U]
                    margin = _state_margin(depth, side_y, side_x, slope_v, slope_u, blur, scale, ends)
                    x = _set_run(row[: box[3] + 1], x, margin, (1.0 + blur) * cell)
                for w in range(box[2], box[3] + 1):
                    states[v, u, y, w] &= row[w]


@inner_kernel
def _set_run(row, x, margin, step):
    """Set the bits from `x` on where `margin`, which changes by `step` a bit, is surely not negative; return
    their end."""
    run = min(max(int(math.ceil(abs(margin) / step)), 1), 64 * row.shape[0] - x)
    end = x + run
    if margin < 0.0:
        return end
    for w in range(x // 64, (end - 1) // 64 + 1):
        value = ALL
        if w == x // 64:
            value &= ALL << np.uint64(x - 64 * w)
        if end < 64 * (w + 1):
            value &= ALL >> np.uint64(64 * (w + 1) - end)
        row[w] |= value
    return end
