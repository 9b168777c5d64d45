"""Compiled kernel of explanations: where single arcs come too near to something, and by how much."""

import math

from anatomy.kernels.arcs import arc_to_point, point_on_arc
from anatomy.kernels.compiling import kernel
from anatomy.kernels.field import distance_bound
from stages.needle.kernels import exact_gap, single_arc_exceeds

# Columns of `found`.
SHORTFALL = 0
"""How much less than the required clearance there is where it is least, mm."""
BLOCKED = 1
"""Length over which the required clearance is not kept, mm."""
FIRST_AT, FIRST = 2, 3
"""Length at which it is first not kept, mm, and that point, LPS mm."""
LENGTH = 6
"""Length of the arc, mm."""
N_COLUMNS = 7
# Columns of `labels`: of the structure that is too near first, and of the one that is too near by most.
FIRST_LABEL, WORST_LABEL = 0, 1

STEP_MM = 0.5
"""Less than a voxel, so that no structure is passed over."""


@kernel(nogil=True)
def look_along_arcs(obstacles, limits, positions, tangents, branches, target, found, labels):
    """Look along the single arc from each pose to the target, in steps of STEP_MM: no proof.

    Args:
        positions, tangents: (N, 3) float64.
        branches: (N,) int64.
        target: tuple of 3 floats.
        found ((N, N_COLUMNS) float64): Receives the columns above; a shortfall of -1 where no arc keeps the
            needle's limits.
        labels ((N, 2) int64): Receives the labels of the structures; 0 where nothing is too near.
    """
    for n in range(positions.shape[0]):
        pose = (
            positions[n, 0], positions[n, 1], positions[n, 2],
            tangents[n, 0], tangents[n, 1], tangents[n, 2],
        )  # fmt: skip
        length, bend, turn = arc_to_point(pose, target)
        found[n, LENGTH] = length
        if single_arc_exceeds(limits, bend, length, turn):
            found[n, SHORTFALL] = -1.0
            continue
        count = max(int(math.ceil(length / STEP_MM)), 1)
        for m in range(count + 1):
            s = length * m / count
            x, y, z = point_on_arc(pose, bend, s)
            if distance_bound(obstacles.clearance, obstacles.geometry, x, y, z) >= limits.required_mm:
                continue
            gap, label, _distance, _needed = exact_gap(obstacles, limits, s, x, y, z, branches[n])
            if gap >= 0.0:
                continue
            if labels[n, FIRST_LABEL] == 0:
                labels[n, FIRST_LABEL] = label
                found[n, FIRST_AT] = s
                found[n, FIRST] = x
                found[n, FIRST + 1] = y
                found[n, FIRST + 2] = z
            found[n, BLOCKED] += length / count
            if -gap > found[n, SHORTFALL]:
                found[n, SHORTFALL] = -gap
                labels[n, WORST_LABEL] = label
