"""Cubes that paths may pass, filled from the start."""

import math

from anatomy.kernels.compiling import kernel
from stages.needle.infeasibility.kernels.blocked import clearance_above
from stages.needle.infeasibility.kernels.bounds import SPARE, TOLERANCE, TOTAL
from stages.needle.infeasibility.kernels.reachability_pruning import place_margin

NEIGHBOURS = 26

# What `span` holds: the first cube of the queue from which the flood has not gone on, and the end.
BEGIN, END = 0, 1


@kernel(nogil=True)
def flood(
    obstacles, limits, exempt_branch, inserted, scale, ends, frame, side, corner, seen, queue, span, most
):  # fmt: skip
    """Fill the cubes that may be passed, from that of the start on; return whether one of the goal's is met.

    A path goes from one cube to another through a point of both, so to one of its 26 neighbours.

    Parameters
    ----------
    obstacles : Obstacles
    limits : Limits
    exempt_branch : int
        Branch whose wall is exempt in the exit; -1 for none.
    inserted : float
        Length of the needle at the start, mm.
    scale, ends : (SCALE_SIZE,), (ENDS_SIZE,) float64
    frame : (4, 3) float64
        Position of the start; the planes' normal, row and column direction.
    side : float
        Of the cubes, mm.
    corner : (3,) int64
        Cube numbers (depth, y, x) of the first cube; that of the start has numbers 0.
    seen : (H, Y, X) bool
        All False at first; those looked at are set.
    queue : (Q,) int32
        Cubes that may be passed, with room for the NEIGHBOURS of so many.
    span : (2,) int64
        Part of the queue that is left, 0 at first; the flood is complete where it is empty.
    most : int
        Cubes from which the flood goes on, at most.
    """
    nh, ny, nx = seen.shape
    half = 0.8661 * side + SPARE
    if span[END] == 0:
        queue[0] = (-corner[0] * ny - corner[1]) * nx - corner[2]
        seen[-corner[0], -corner[1], -corner[2]] = True
        span[END] = 1
    end = span[END]
    for at in range(span[BEGIN], span[BEGIN] + most):
        if at == end:
            break
        number = queue[at]
        span[BEGIN] = at + 1
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
                    if place_margin(h, y, x, scale, ends) + half < 0.0:
                        continue
                    length = inserted + max(math.sqrt(h * h + y * y + x * x) - half, 0.0)
                    exempt = exempt_branch if length < limits.exempt_mm else -1
                    above = clearance_above(
                        obstacles, limits, half, exempt, length,
                        frame[0, 0] + h * frame[1, 0] + y * frame[2, 0] + x * frame[3, 0],
                        frame[0, 1] + h * frame[1, 1] + y * frame[2, 1] + x * frame[3, 1],
                        frame[0, 2] + h * frame[1, 2] + y * frame[2, 2] + x * frame[3, 2],
                    )  # fmt: skip
                    if above + half >= limits.required_mm:
                        queue[end] = (a * ny + b) * nx + c
                        end += 1
        span[END] = end
    return False
