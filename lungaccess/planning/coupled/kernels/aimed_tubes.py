"""Compiled kernel of the search without a needle: it aims tubes at a target, validates and costs them.

`tube` is that of `lungaccess.planning.coupled.kernels.candidate`.
"""

import math

import numpy as np

from anatomy.kernels.compiling import kernel
from lungaccess.planning.coupled.kernels.candidate import why_refused
from lungaccess.planning.coupled.kernels.tubes_cost import bent_towards, cost_beyond, cost_in_tissue
from stages.tube.kernels import ACCEPTED, LEFT_AT, N_TRACE, WALL_RUN, aim_shape, take_member

ROTATION, COST, JOINTS = range(3)
"""Columns of what is found; the joints of the tubes begin at the last."""
MISSES = -1
"""Stands for a reason where no insertions bring the tip to the target."""
SPOILT_WAY = -3
"""Stands for a reason where the tubes would snap, sweep or be strained too much on their way there."""
TIP_OFF_MM = 5e-7
"""So far from the target may a tip be after its whole way was followed: half of what a proof allows."""
NOT_TRIED = -2
"""Stands for a reason where the scope cannot take the tip, or enough were found before."""


@kernel(nogil=True)
def aim_tubes(
    tube,
    obstacles,
    weights,
    map_weights,
    of_tubes,
    scope_poses,
    allowed,
    pose_of,
    shapes,
    targets,
    enough,
    found,
    why,
):
    """Aim the tubes at targets from many scope tips, and validate and cost what hits them.

    Args:
        weights, map_weights (ObjectiveArrays): The objective without its costs of the map, which count from
            the exit on, and with these alone, which count beyond the wall that the tubes pierce.
        of_tubes (ObjectiveArrays): What counts for each mm of the tubes' width, beyond that wall, too.
        scope_poses, allowed ((K, 9) float64, (K,) bool): Scope tips, and which of them the scope can take.
        pose_of ((N,) int64): The row of `scope_poses` of each attempt, which begins from one of the shapes.
        targets ((K, 3) float64): Where they are to end from each pose.
        enough (int): So many deployments end the attempts.
        found ((N, JOINTS + 2 n) float64): Receives rotation, estimated cost and joints; the cost is infinite
            where the tubes are refused.
        why ((N,) int64): Receives ACCEPTED, MISSES, SPOILT_WAY, NOT_TRIED, or a reason of
            `stages.tube.kernels`.
    """
    environment, constants, design, near, shape = tube
    trace = np.zeros(N_TRACE)
    tip = np.zeros(9)
    for n in range(pose_of.shape[0]):
        base, goal = scope_poses[pose_of[n]], targets[pose_of[n]]
        target = (goal[0], goal[1], goal[2])
        found[n, COST] = math.inf
        why[n] = NOT_TRIED
        if enough <= 0 or not allowed[pose_of[n]]:
            continue
        take_member(near, shapes, n)
        rotation, miss, kept = aim_shape(design, near, shape, base, target)
        if not (miss <= TIP_OFF_MM and kept):
            why[n] = SPOILT_WAY if miss <= TIP_OFF_MM else MISSES
            continue
        normal = bent_towards(base, rotation)
        found[n, ROTATION], found[n, JOINTS:] = rotation, shape.joints
        why[n] = why_refused(environment, constants, shape, base[:6], np.array(normal), trace, tip)
        if why[n] != ACCEPTED:
            continue
        left_at = trace[LEFT_AT]
        behind, arcs = left_at + trace[WALL_RUN], shape.arcs[: shape.number[0]]
        cost = cost_beyond(obstacles, weights, base, normal, arcs, left_at, False)
        if map_weights.map_integral > 0.0 or map_weights.voxel_sum > 0.0:
            cost += cost_beyond(obstacles, map_weights, base, normal, arcs, behind, False)
        cost += cost_in_tissue(obstacles, of_tubes, base, normal, arcs, behind)
        found[n, COST] = cost
        enough -= 1
