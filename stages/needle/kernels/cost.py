"""What an arc costs, as estimated within the searches.

`objective` is the tuple (weights, cost map): weights of the integral of 1 / clearance, of the line
integral of the cost map, and of length; the last weight is the least cost of a mm anywhere.
"""

from __future__ import annotations

import math

import numba

from anatomy.kernels.arcs import point_on_arc
from anatomy.kernels.field import distance_estimate

CLEARANCE_FLOOR_MM = 0.1
"""Nearer than this, 1 / clearance stays at its value here, so that the integral is finite."""

INVERSE_CLEARANCE = 0
MAP_INTEGRAL = 1
LENGTH = 2
LEAST_RATE = 3


@numba.njit(cache=True)
def inverse_clearance_on_arc(space, step, pose, bend, length):
    """Estimate the integral of 1 / clearance along an arc [Kuntz2015, eq. 1] by the trapezoid rule."""
    field, _labels, geometry, _bits = space
    count = max(int(math.ceil(length / step)), 1)
    total = 0.0
    for m in range(count + 1):
        x, y, z = point_on_arc(pose, bend, length * m / count)
        weight = 0.5 if m == 0 or m == count else 1.0
        total += weight / max(distance_estimate(field, geometry, x, y, z), CLEARANCE_FLOOR_MM)
    return total * length / count


@numba.njit(cache=True)
def map_integral_on_arc(costs, geometry, step, pose, bend, length):
    """Estimate the line integral of the cost map along an arc by the midpoint rule; inf off the grid."""
    count = max(int(math.ceil(length / step)), 1)
    ni, nj, nk = costs.shape
    total = 0.0
    for m in range(count):
        x, y, z = point_on_arc(pose, bend, length * (m + 0.5) / count)
        u = geometry[0, 0] * x + geometry[0, 1] * y + geometry[0, 2] * z + geometry[0, 3]
        v = geometry[1, 0] * x + geometry[1, 1] * y + geometry[1, 2] * z + geometry[1, 3]
        w = geometry[2, 0] * x + geometry[2, 1] * y + geometry[2, 2] * z + geometry[2, 3]
        if not (0.0 <= u < ni and 0.0 <= v < nj and 0.0 <= w < nk):
            return math.inf
        total += costs[int(u), int(v), int(w)]
    return total * length / count


@numba.njit(cache=True)
def cost_of_arc(space, objective, step, pose, bend, length):
    """Return the weighted cost of an arc."""
    weights, costs = objective
    total = weights[LENGTH] * length
    if weights[INVERSE_CLEARANCE] > 0.0:
        total += weights[INVERSE_CLEARANCE] * inverse_clearance_on_arc(space, step, pose, bend, length)
    if weights[MAP_INTEGRAL] > 0.0:
        total += weights[MAP_INTEGRAL] * map_integral_on_arc(costs, space[2], step, pose, bend, length)
    return total
