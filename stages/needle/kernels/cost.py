"""What an arc costs, as estimated within the searches.

Voxels are found in closed form.  Along an arc every voxel coordinate is `a + b sin + c cos` of the angle
turned, so that it is monotone between extrema half a circle apart.  The arc is cut at the extrema of all
three; in such a piece no voxel is met twice, and the voxels at its two ends say how often each coordinate
crosses a face, and where is the root of a quadratic equation.
"""

import math
from typing import NamedTuple

import numpy as np

from anatomy.base.typed import Float32
from anatomy.kernels.arcs import SMALL_ANGLE, point_on_arc
from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from anatomy.kernels.field import distance_estimate
from stages.needle.kernels.proof import TINY

CLEARANCE_FLOOR_MM = 0.1
"""Nearer than this, 1 / clearance stays at its value here, so that the integral is finite."""

OFF_GRID = -1
"""The number of every voxel beyond the grid."""


class ObjectiveArrays(NamedTuple):
    """The weights of the costs of a path, and the cost map.

    Args:
        inverse_clearance: Weight of the integral of 1 / clearance.
        map_integral: Weight of the line integral of the cost map, 1/mm.
        length: Weight of length, 1/mm.
        voxel_sum: Weight of the sum of the cost map over the set of voxels crossed.
        least_rate: Least cost of a mm anywhere.
        cost_map ((ni, nj, nk) float32): Infinite is an obstacle.
    """

    inverse_clearance: float
    map_integral: float
    length: float
    voxel_sum: float
    least_rate: float
    cost_map: Float32


@kernel()
def inverse_clearance_on_arc(obstacles, step, pose, bend, length):
    """Estimate the integral of 1 / clearance along an arc [Kuntz2015, eq. 1] by the trapezoid rule."""
    # Fields of a tuple are taken before a loop: each access to an array counts its references.
    clearance, geometry = obstacles.clearance, obstacles.geometry
    count = max(int(math.ceil(length / step)), 1)
    total = 0.0
    for m in range(count + 1):
        x, y, z = point_on_arc(pose, bend, length * m / count)
        weight = 0.5 if m == 0 or m == count else 1.0
        total += weight / max(distance_estimate(clearance, geometry, x, y, z), CLEARANCE_FLOOR_MM)
    return total * length / count


@inner_kernel
def _coordinates(geometry, pose, bend, s):
    """Return the voxel coordinates (corners are whole numbers) of the point at arc length `s`."""
    x, y, z = point_on_arc(pose, bend, s)
    return (
        geometry[0, 0] * x + geometry[0, 1] * y + geometry[0, 2] * z + geometry[0, 3],
        geometry[1, 0] * x + geometry[1, 1] * y + geometry[1, 2] * z + geometry[1, 3],
        geometry[2, 0] * x + geometry[2, 1] * y + geometry[2, 2] * z + geometry[2, 3],
    )


@kernel()
def _directions(geometry, x, y, z):
    """Return a direction in voxels per mm."""
    return (
        geometry[0, 0] * x + geometry[0, 1] * y + geometry[0, 2] * z,
        geometry[1, 0] * x + geometry[1, 1] * y + geometry[1, 2] * z,
        geometry[2, 0] * x + geometry[2, 1] * y + geometry[2, 2] * z,
    )


@merged_kernel
def _first_crossing(kappa, slope, bow, change):
    """Return the arc length, below half a circle, at which a monotone coordinate has changed by `change`.

    The coordinate starts with `slope` along the tangent and `bow` along the normal.  With
    `x = 2 tan(kappa s / 2) / kappa` it changes by `(slope x + kappa bow x^2 / 2) / (1 + kappa^2 x^2 / 4)`.
    """
    if change == 0.0:
        return 0.0
    square = slope * slope - kappa * change * (kappa * change - 2.0 * bow)
    below = slope + math.copysign(math.sqrt(max(square, 0.0)), change)
    if below == 0.0:
        return math.inf
    x = 2.0 * change / below
    half = 0.5 * kappa * x
    if abs(half) < SMALL_ANGLE:
        return x * (1.0 - half * half / 3.0)
    return 2.0 * math.atan(half) / kappa


@merged_kernel
def _next_extremum(kappa, tangents, normals, s, length):
    """Return the arc length beyond `s` at which some coordinate is extreme, `length` if there is none."""
    stop = length
    if kappa > 0.0:
        angle = kappa * s
        for axis in range(3):
            extreme = math.atan2(-tangents[axis], normals[axis])
            ahead = (extreme - angle) % math.pi
            if ahead < TINY:
                ahead += math.pi
            stop = min(stop, s + ahead / kappa)
    return stop


@inner_kernel
def _voxel(shape, cell):
    """Return the number of a voxel, the first index running fastest; OFF_GRID beyond the grid."""
    for axis in range(3):
        if not 0 <= cell[axis] < shape[axis]:
            return OFF_GRID
    return cell[0] + shape[0] * (cell[1] + shape[1] * cell[2])


@merged_kernel
def _most_voxels(geometry, bend, length):
    """Return a number of voxels that an arc cannot exceed: one, and one for every face it can cross."""
    faces = 0.0
    for axis in range(3):
        faces += length / math.sqrt(geometry[axis, 4])
    pieces = 3.0 * (bend[0] * length / math.pi + 1.0) + 1.0
    return int(math.ceil(faces + 3.0 * pieces)) + 1


@kernel()
def voxels_on_arc(shape, geometry, pose, bend, length):
    """Return the voxels that an arc crosses, in its order.

    They are those that hold one of its ends or more than 1e-9 mm of it.  An end on a face lies in the voxel
    of the higher index.  Returned are their numbers (N,) int64, the first index running fastest and OFF_GRID
    beyond the grid; the length of arc in each (N,), mm; and the number of pieces: if 1, no voxel is met
    twice.
    """
    kappa = bend[0]
    most = _most_voxels(geometry, bend, length)
    voxels = np.zeros(most, dtype=np.int64)
    lengths = np.zeros(most)
    tangents = _directions(geometry, pose[3], pose[4], pose[5])
    normals = _directions(geometry, bend[1], bend[2], bend[3])
    here = _coordinates(geometry, pose, bend, 0.0)
    cell = np.zeros(3, dtype=np.int64)
    last = np.zeros(3, dtype=np.int64)
    crossing = np.zeros(3)
    for axis in range(3):
        cell[axis] = int(math.floor(here[axis]))
    count = 0
    pieces = 0
    entered = 0.0
    s = 0.0
    while True:
        pieces += 1
        stop = _next_extremum(kappa, tangents, normals, s, length)
        there = _coordinates(geometry, pose, bend, stop)
        c, d = math.cos(kappa * s), math.sin(kappa * s)
        for axis in range(3):
            last[axis] = int(math.floor(there[axis]))
            crossing[axis] = -1.0
        while True:
            first = -1
            for axis in range(3):
                if cell[axis] == last[axis]:
                    continue
                if crossing[axis] < 0.0:
                    face = cell[axis] + 1.0 if last[axis] > cell[axis] else float(cell[axis])
                    slope = c * tangents[axis] + d * normals[axis]
                    bow = c * normals[axis] - d * tangents[axis]
                    at = s + _first_crossing(kappa, slope, bow, face - here[axis])
                    crossing[axis] = min(max(at, s), stop)
                if first < 0 or crossing[axis] < crossing[first]:
                    first = axis
            if first < 0:
                break
            at = max(crossing[first], entered)
            if at - entered > TINY or count == 0:
                voxels[count] = _voxel(shape, cell)
                lengths[count] = at - entered
                count += 1
                entered = at
            cell[first] += 1 if last[first] > cell[first] else -1
            crossing[first] = -1.0
        if stop >= length:
            break
        s = stop
        here = there
    voxels[count] = _voxel(shape, cell)
    lengths[count] = length - entered
    return voxels[: count + 1], lengths[: count + 1], pieces


@merged_kernel
def _sort(values):
    """Sort a few hundred numbers in place, by the method of Shell; it compiles faster than `ndarray.sort`."""
    gap = len(values)
    while gap > 1:
        gap = max(gap * 5 // 11, 1)
        for m in range(gap, len(values)):
            value = values[m]
            at = m
            while at >= gap and values[at - gap] > value:
                values[at] = values[at - gap]
                at -= gap
            values[at] = value


@kernel()
def map_costs_on_arc(costs, geometry, pose, bend, length, first):
    """Return the line integral of the cost map along an arc, and its sum over the voxels crossed.

    In the sum each voxel counts once, and that of the start not at all unless the arc is the `first` of its
    path: so the sums over the arcs of a path count the voxels that hold their joints once, and only a voxel
    that the path leaves and meets again on another arc counts twice.  Both are infinite if the arc meets a
    voxel of infinite cost or leaves the grid.
    """
    ni, nj, _nk = costs.shape
    voxels, lengths, pieces = voxels_on_arc(costs.shape, geometry, pose, bend, length)
    begin = voxels[0]
    integral = 0.0
    for m in range(len(voxels)):
        if voxels[m] == OFF_GRID:
            return math.inf, math.inf
        cost = costs[voxels[m] % ni, voxels[m] // ni % nj, voxels[m] // (ni * nj)]
        if cost == math.inf:
            return math.inf, math.inf
        integral += cost * lengths[m]
    if pieces > 1:
        _sort(voxels)
    total = 0.0
    for m in range(len(voxels)):
        if (m > 0 and voxels[m] == voxels[m - 1]) or (voxels[m] == begin and not first):
            continue
        total += costs[voxels[m] % ni, voxels[m] // ni % nj, voxels[m] // (ni * nj)]
    return integral, total


@kernel()
def cost_of_arc(obstacles, objective, step, pose, bend, length, first):
    """Return the weighted cost of an arc; `first` tells whether its path starts with it."""
    total = objective.length * length
    if objective.inverse_clearance > 0.0:
        total += objective.inverse_clearance * inverse_clearance_on_arc(obstacles, step, pose, bend, length)
    if objective.map_integral > 0.0 or objective.voxel_sum > 0.0:
        integral, voxel_sum = map_costs_on_arc(
            objective.cost_map, obstacles.geometry, pose, bend, length, first
        )
        if integral == math.inf:
            return math.inf
        total += objective.map_integral * integral + objective.voxel_sum * voxel_sum
    return total
