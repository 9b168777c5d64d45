"""Compiled kernels of the coupled search: what tubes cost from an arc length on, piece by piece."""

from __future__ import annotations

import math

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from stages.needle.kernels import cost_of_arc
from stages.tube.kernels import bend_towards, carried, tube_pieces

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


@merged_kernel
def pieces_of(constants, outer, inner, arcs):
    """Return begin, end, direction, curvature and width of each piece of tubes `(P, 5)`.

    Planar tubes have no `arcs` (a, ARC_COLUMNS); others have them instead of insertions.
    """
    if arcs.shape[0] > 0:
        pieces, at = np.zeros((arcs.shape[0], 5)), 0.0
        for m in range(arcs.shape[0]):
            length, direction, kappa, radius = arcs[m]
            pieces[m] = np.array([at, at + length, direction, kappa, 2.0 * radius])
            at += length
        return pieces
    pieces = np.zeros((4, 5))
    for m, (start, stop, kappa, radius) in enumerate(tube_pieces(constants, outer, inner)):
        pieces[m] = np.array([start, stop, 0.0, kappa, 2.0 * radius])
    return pieces


@inner_kernel
def cost_beyond(obstacles, objective, base, normal, pieces, begin, by_width):
    """Return the weighted cost of the pieces of tubes from an arc length on, each times its width or not."""
    pose = (base[0], base[1], base[2], base[3], base[4], base[5])
    across = normal
    total = 0.0
    first = True
    for start, stop, direction, kappa, width in pieces:
        if stop <= start:
            continue
        skipped = min(max(begin - start, 0.0), stop - start)
        for length, counts in ((skipped, False), (stop - start - skipped, True)):
            if length <= 0.0:
                continue
            bend = bend_towards(pose, across, direction, kappa)
            if counts:
                cost = cost_of_arc(obstacles, objective, COST_STEP_MM, pose, bend, length, first)
                total += width * cost if by_width else cost
                first = False
            pose, across = carried(pose, across, bend, direction, length)
    return total


@inner_kernel
def cost_in_tissue(obstacles, of_tubes, constants, base, normal, outer, inner, arcs, behind):
    """Return what tubes cost by their width from an arc length `behind` the wall on.

    `of_tubes` is that of a `lungaccess.plans.evaluator.NeedleArrays`; where it weighs nothing, that is 0.
    """
    if of_tubes.inverse_clearance == 0.0:
        return 0.0
    pieces = pieces_of(constants, outer, inner, arcs)
    return cost_beyond(obstacles, of_tubes, base, normal, pieces, behind, True)


@kernel(nogil=True)
def costs_in_tissue(obstacles, of_tubes, constants, tips, deployed, shape, arcs, first_arc, costs):
    """Fill `costs` (N,) with what the tubes of many deployments cost by their width, beyond the wall.

    Parameters
    ----------
    tips : (N, 9) float64
        The scope tip of each.
    deployed : (N, 4) float64
        Rotation in rad, insertions of outer and inner tube, and arc length behind the wall, mm.
    shape : (N,) int64
        Of tubes that are not planar the shape of each; otherwise -1.
    arcs : (A, ARC_COLUMNS) float64
    first_arc : (S + 1,) int64
        The arcs of all shapes, and where those of each begin.
    """
    for n in range(costs.shape[0]):
        rotation, outer, inner, behind = deployed[n]
        begin, end = 0, 0
        if shape[n] >= 0:
            begin, end = first_arc[shape[n]], first_arc[shape[n] + 1]
        normal = bent_towards(tips[n], rotation)
        costs[n] = cost_in_tissue(
            obstacles, of_tubes, constants, tips[n], normal, outer, inner, arcs[begin:end], behind
        )
