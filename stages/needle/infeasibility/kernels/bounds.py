"""What is known of all paths: how fast direction and place can change from plane to plane."""

import math

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel
from stages.needle.infeasibility.kernels.bitmaps import find_box

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
