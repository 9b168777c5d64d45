"""Many start poses and one target: the workspace test, and the direct arcs."""

from anatomy.kernels.arcs import arc_to_point
from anatomy.kernels.compiling import kernel
from stages.needle.kernels.connections import seen_from, single_arc_exceeds
from stages.needle.kernels.cost import inverse_clearance_on_arc
from stages.needle.kernels.goal_ball import workspace_length
from stages.needle.kernels.proof import blocker_on_arc


@kernel(nogil=True)
def workspace_scan(positions, tangents, target, limits, lengths):
    """Fill `lengths` (N,) with the shortest path length from each pose to `target`, inf outside."""
    for n in range(positions.shape[0]):
        x, y, z = positions[n]
        tx, ty, tz = tangents[n]
        rho, h = seen_from((x, y, z, tx, ty, tz), target)
        lengths[n] = workspace_length(rho, h, limits)


@kernel(nogil=True)
def direct_arcs(obstacles, limits, positions, tangents, branches, target, blockers, costs):
    """Try the single arc from each pose to `target`.

    `blockers` (N,) gets 0 where the arc is proved clear, the label that blocks it, or -1 where no
    single arc within the limits exists; `costs` (N, 2) gets its length and, where it is clear, the
    estimated integral of 1 / clearance.
    """
    for n in range(positions.shape[0]):
        x, y, z = positions[n]
        tx, ty, tz = tangents[n]
        pose = (x, y, z, tx, ty, tz)
        length, bend, turn = arc_to_point(pose, target)
        costs[n, 0] = length
        if single_arc_exceeds(limits, bend, length, turn):
            blockers[n] = -1
            continue
        blockers[n] = blocker_on_arc(obstacles, limits, pose, bend, length, 0.0, branches[n])
        if blockers[n] == 0:
            costs[n, 1] = inverse_clearance_on_arc(obstacles, limits.cost_step_mm, pose, bend, length)
