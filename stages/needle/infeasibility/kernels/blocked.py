"""States around which every path is blocked, sets without them, and cubes that paths may pass."""

import math

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from anatomy.kernels.field import exact_distance, interpolate_squared
from anatomy.kernels.labels import LUMEN
from stages.needle.infeasibility.kernels import bounds
from stages.needle.infeasibility.kernels.bitmaps import ONE, and_shifted, find_box, or_shifted
from stages.needle.infeasibility.kernels.bounds import SPARE, TOLERANCE, TOTAL, place_margin
from stages.needle.kernels.proof import kept_from_lumen

NEIGHBOURS = 26

# What `span` holds: the first cube of the queue from which the flood has not gone on, and the end.
BEGIN, END = 0, 1

# Typed numbers: a kernel is compiled once more for every literal that it is called with.
_NOBODY = np.int64(-1)
_LUMEN = np.int64(LUMEN)

FIELD_STEP_MM = 0.005
"""A clearance field rounds off less."""


@inner_kernel
def _probed_at(v, u, window, scale, depth):
    """Return the whole cells (y, x) by which a tangent has moved at a depth, and what that leaves in mm."""
    move = depth * scale[bounds.SLOPE_CELL] / scale[bounds.CELL]
    move_y = (v + window[0]) * move
    move_x = (u + window[1]) * move
    y = int(round(move_y))
    x = int(round(move_x))
    return y, x, abs(move_y - y) * scale[bounds.CELL], abs(move_x - x) * scale[bounds.CELL]


@kernel(nogil=True)
def mark_probed(states, window, scale, depths, probed, corners):
    """Set the bits of the cells that the tangents of a plane's states meet at depths `(D,)` from it, mm.

    Seen from the plane these are `depths` (D,) mm; `probed` (D, Y', W') uint64 receives the bits, and
    `corners` (D, 2) int64 are cell numbers (y, x) of the first cell of each.
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


@inner_kernel
def clearance_above(obstacles, limits, spare, exempt_branch, inserted, x, y, z):
    """Return a clearance in mm that the true one of a point is never above, as far as it is worth knowing.

    A needle is at least `inserted` mm long there.  Where the clearance is at least the required one less
    `spare` and the field says so, the required one is returned.  In the exit, where airway voxels of
    `exempt_branch` (-1: none) do not count, it is less by what is missing from the distance to every lumen
    (`stages.needle.kernels.proof.exact_gap`), which never needs to be less where the needle is longer.
    """
    required = limits.required_mm
    squared, spread2 = interpolate_squared(obstacles.clearance, obstacles.geometry, x, y, z)
    least = max(required - spare, 0.0)
    if squared > 0.0 and squared - spread2 >= least * least:
        return required
    above = math.sqrt(squared) + math.sqrt(spread2) + FIELD_STEP_MM
    if exempt_branch < 0 and squared > 0.0 and above < 0.5 * required:
        return above
    labels, geometry = obstacles.labels, obstacles.geometry
    clearance = exact_distance(labels, geometry, x, y, z, obstacles.bits, exempt_branch, required)[0]
    kept = min(kept_from_lumen(limits, inserted)[0], required)
    if exempt_branch >= 0 and kept > 0.0:
        lumen = exact_distance(labels, geometry, x, y, z, _LUMEN, _NOBODY, kept)[0]
        clearance = min(clearance, required - (kept - lumen))
    return clearance


@inner_kernel
def _grade_of(slacks, value):
    """Return which of the rising `slacks` is the first not below a value; their number if none is."""
    for q in range(slacks.shape[0]):
        if slacks[q] >= value:
            return q
    return slacks.shape[0]


@kernel(nogil=True)
def grade_clearance(obstacles, limits, exempt_branch, inserted, origin, across, probed, slacks, grades):
    """Fill `grades` (Y, 64 W) uint8 with the first of the `slacks` that a cell's lack of clearance is within.

    Of the cells of one plane only those are looked at that are set in `probed` (Y, W).  A lack is required
    clearance less the clearance at the cell's centre; one beyond all of the Q `slacks` (rising) gets Q.
    `origin` is the first cell's centre, `across` (2, 3) are the steps from row to row and column to column.
    See `clearance_above` for `exempt_branch` and `inserted`.
    """
    rows, words = probed.shape
    for y in range(rows):
        for x in range(64 * words):
            if not (probed[y, x // 64] >> np.uint64(x % 64)) & ONE:
                continue
            above = clearance_above(
                obstacles, limits, slacks[0], exempt_branch, inserted,
                origin[0] + y * across[0, 0] + x * across[1, 0],
                origin[1] + y * across[0, 1] + x * across[1, 1],
                origin[2] + y * across[0, 2] + x * across[1, 2],
            )  # fmt: skip
            grades[y, x] = _grade_of(slacks, limits.required_mm - above - bounds.SPARE)


@kernel(nogil=True)
def keep_clear(states, window, scale, depths, corners, grades, slacks):
    """Remove the states from which half a slab behind or ahead is blocked for every path.

    `depths` and `corners` are those of `mark_probed`, `grades` (D, Y', X') uint8 and `slacks` (Q,) those of
    `grade_clearance`.
    """
    nv, nu, _rows, _words = states.shape
    free = np.zeros((depths.shape[0], slacks.shape[0], grades.shape[1], grades.shape[2] // 64), np.uint64)
    made = np.zeros((depths.shape[0], slacks.shape[0]), np.bool_)
    box = np.zeros(4, np.int64)
    for v in range(nv):
        for u in range(nu):
            slope_v, slope_u = bounds.slope_of(v, u, window, scale)
            sine = bounds.steepest_sine(slope_v, slope_u, scale)
            for d in range(depths.shape[0]):
                if not find_box(states[v, u], box):
                    break
                depth = abs(depths[d])
                y, x, left_y, left_x = _probed_at(v, u, window, scale, depths[d])
                half = 0.5 * (scale[bounds.CELL] + scale[bounds.SLOPE_CELL] * depth)
                bound = bounds.largest_second_derivative(sine + scale[bounds.KAPPA] * depth, scale)
                slack = math.hypot(half + left_y, half + left_x) + 0.5 * bound * depth * depth + bounds.SPARE
                q = _grade_of(slacks, slack)
                if q == slacks.shape[0]:
                    continue
                if not made[d, q]:
                    made[d, q] = True
                    _free_within(grades[d], q, free[d, q])
                and_shifted(
                    states[v, u], free[d, q], corners[d, 0] - window[2] - y, corners[d, 1] - window[3] - x
                )


@merged_kernel
def _free_within(grades, most, out):
    """Set the bits of the cells whose grade is at most `most`."""
    for y in range(grades.shape[0]):
        for x in range(grades.shape[1]):
            if grades[y, x] <= most:
                out[y, x // 64] |= ONE << np.uint64(x % 64)


@kernel(nogil=True)
def flood(
    obstacles, limits, exempt_branch, inserted, scale, ends, frame, side, corner, seen, queue, span, most
):  # fmt: skip
    """Fill the cubes that may be passed, from that of the start on; return whether one of the goal's is met.

    A path goes from one cube to another through a point of both, so to one of its 26 neighbours.

    Args:
        exempt_branch (int): Branch whose wall is exempt in the exit; -1 for none.
        inserted, side (float): Length of the needle at the start, and side of the cubes, mm.
        scale, ends: (SCALE_SIZE,), (ENDS_SIZE,) float64.
        frame ((4, 3) float64): Position of the start; the planes' normal, row and column direction.
        corner ((3,) int64): Cube numbers (depth, y, x) of the first cube; that of the start has numbers 0.
        seen ((H, Y, X) bool): All False at first; those looked at are set.
        queue ((Q,) int32): Cubes that may be passed, with room for the NEIGHBOURS of so many.
        span ((2,) int64): Part of the queue that is left, 0 at first; the flood is complete where it is
            empty.
        most (int): Cubes from which the flood goes on, at most.
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
