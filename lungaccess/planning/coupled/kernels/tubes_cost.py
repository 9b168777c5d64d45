"""Compiled kernels of the coupled search: what tubes cost from an arc length on, piece by piece."""

import math

from anatomy.kernels.compiling import inner_kernel, kernel
from stages.needle.kernels import cost_of_arc
from stages.tube.kernels import bend_towards, carried

COST_STEP_MM = 0.5
"""Step of estimated integrals: about a voxel, since clearance changes by no more than one moves."""


@inner_kernel
def bent_towards(base, rotation):
    """Return the unit vector across a scope tip `base` (9,) towards which tubes of a rotation (rad) bend."""
    c, s = math.cos(rotation), math.sin(rotation)
    return (
        c * base[6] + s * (base[4] * base[8] - base[5] * base[7]),
        c * base[7] + s * (base[5] * base[6] - base[3] * base[8]),
        c * base[8] + s * (base[3] * base[7] - base[4] * base[6]),
    )


@inner_kernel
def cost_beyond(obstacles, objective, base, normal, arcs, begin, by_width):
    """Return the weighted cost of the arcs of tubes from an arc length on, each times its width or not."""
    pose = (base[0], base[1], base[2], base[3], base[4], base[5])
    across = normal
    total, start = 0.0, 0.0
    first = True
    for whole, direction, kappa, radius in arcs:
        skipped = min(max(begin - start, 0.0), whole)
        start += whole
        for length, counts in ((skipped, False), (whole - skipped, True)):
            if length <= 0.0:
                continue
            bend = bend_towards(pose, across, direction, kappa)
            if counts:
                cost = cost_of_arc(obstacles, objective, COST_STEP_MM, pose, bend, length, first)
                total += 2.0 * radius * cost if by_width else cost
                first = False
            pose, across = carried(pose, across, bend, direction, length)
    return total


@inner_kernel
def cost_in_tissue(obstacles, of_tubes, base, normal, arcs, behind):
    """Return what tubes cost by their width from an arc length `behind` the wall on.

    `of_tubes` is that of a `lungaccess.plans.evaluator.NeedleArrays`; where it weighs nothing, that is 0.
    """
    if of_tubes.inverse_clearance == 0.0:
        return 0.0
    return cost_beyond(obstacles, of_tubes, base, normal, arcs, behind, True)


@kernel(nogil=True)
def costs_in_tissue(obstacles, of_tubes, tips, deployed, shape, arcs, first_arc, costs):
    """Fill `costs` (N,) with what the tubes of many deployments cost by their width, beyond the wall.

    Args:
        tips ((N, 9) float64): The scope tip of each.
        deployed ((N, 2) float64): Rotation in rad, and arc length behind the wall, mm.
        shape, arcs, first_arc: The shape of each, the arcs of all shapes, and where those of each begin.
    """
    for n in range(costs.shape[0]):
        rotation, behind = deployed[n]
        own = arcs[first_arc[shape[n]] : first_arc[shape[n] + 1]]
        costs[n] = cost_in_tissue(obstacles, of_tubes, tips[n], bent_towards(tips[n], rotation), own, behind)
