"""Compiled kernels of the coupled search: they validate and cost a choice of scope pose, tubes and needle.

`tube` is the tuple (environment, constants, arcs, beside): the first two are those of `stages.tube.kernels`,
`arcs` (a, 4) and `beside` (mm) the shape of tubes that are not planar, as `validate_arcs` takes it; planar
tubes have no arcs.  `needle` is a `lungaccess.plans.evaluator.NeedleArrays`.  A choice has two parts.  `x`
holds a row of `scope_poses`, the rotation in rad, and the insertions of outer and inner tube in mm, which
count for planar tubes only.  `vias` are points (LPS mm) through which single arcs lead from the tube to the
target.  A row of `scope_poses` (9,) is a scope tip: point, unit tangent, and the unit vector across the
tangent from which the rotation counts.
"""

from __future__ import annotations

import math

import numpy as np

from anatomy.kernels.arcs import arc_to_point, pose_on_arc
from anatomy.kernels.compiling import inner_kernel
from stages.needle.kernels import blocker_on_arc, cost_of_arc, least_cosine, map_costs_on_arc
from stages.tube.kernels import (
    ACCEPTED,
    BRANCH,
    MAX_EXTENSION,
    MAX_PROTRUSION,
    tip_of_arcs,
    tip_pose,
    validate_arcs,
    validate_deployment,
)

SCOPE_POSE = 0
ROTATION = 1
OUTER = 2
INNER = 3
N_CHOICE = 4
"""Places of the numbers of a choice in `x`, and how many they are."""

ROUNDING = 1e-9
"""Share of each limit that stays unused, so that rounding does not carry a plan beyond the limit."""
SHORTEST_ARC_MM = 0.5
"""Shorter arcs are refused.  The value is a free choice, well below the length of any useful arc."""


@inner_kernel
def _needle_cost(needle, pose, vias, count, target, cost_limit):
    """Return the cost of the arcs through `count` vias; infinite beyond a limit or from `cost_limit` on."""
    limits = needle.limits
    length = 0.0
    turn = 0.0
    cost = 0.0
    start = pose
    cosine = math.cos(limits.max_angle_rad * (1.0 - ROUNDING))
    for m in range(count + 1):
        goal = target
        if m < count:
            goal = (vias[m, 0], vias[m, 1], vias[m, 2])
        arc, bend, angle = arc_to_point(pose, goal)
        length += arc
        turn += angle
        if (
            bend[0] > limits.kappa * (1.0 - ROUNDING)
            or length > limits.max_length_mm * (1.0 - ROUNDING)
            or turn > limits.max_turn_rad * (1.0 - ROUNDING)
            or arc < SHORTEST_ARC_MM
        ):
            return math.inf
        forward = pose[3] * start[3] + pose[4] * start[4] + pose[5] * start[5]
        aside = bend[1] * start[3] + bend[2] * start[4] + bend[3] * start[5]
        if least_cosine(forward, aside, angle) < cosine:
            return math.inf
        cost += cost_of_arc(needle.obstacles, needle.objective, limits.cost_step_mm, pose, bend, arc, m == 0)
        if not cost < cost_limit:
            return math.inf
        if needle.has_forbidden_voxels:
            geometry = needle.obstacles.geometry
            if map_costs_on_arc(needle.forbidden_map, geometry, pose, bend, arc, m == 0)[0] == math.inf:
                return math.inf
        if m < count:
            pose = pose_on_arc(pose, bend, arc)
    return cost


@inner_kernel
def _needle_clear(needle, pose, vias, count, target, branch):
    """Tell whether all arcs through the vias are proved clear."""
    length = 0.0
    for m in range(count + 1):
        goal = target
        if m < count:
            goal = (vias[m, 0], vias[m, 1], vias[m, 2])
        arc, bend, _angle = arc_to_point(pose, goal)
        if blocker_on_arc(needle.obstacles, needle.limits, pose, bend, arc, length, branch) != 0:
            return False
        length += arc
        pose = pose_on_arc(pose, bend, arc)
    return True


@inner_kernel
def validated_cost(tube, needle, scope_poses, allowed, x, vias, count, target, cost_limit, trace, tip):
    """Return the cost of a choice if it is below `cost_limit` and all of it is proved; else infinity.

    The fast tests come first: limits and cost of the needle, the deployment, the needle's clearance.
    """
    environment, constants, arcs, beside = tube
    planar = arcs.shape[0] == 0
    row = int(x[SCOPE_POSE])
    outer, inner = x[OUTER], x[INNER]
    if row < 0 or row >= scope_poses.shape[0] or not allowed[row]:
        return math.inf
    if planar and (outer < 0.0 or outer > inner or inner > constants[MAX_EXTENSION]):
        return math.inf
    if planar and inner - outer > constants[MAX_PROTRUSION]:
        return math.inf
    base = scope_poses[row]
    c, s = math.cos(x[ROTATION]), math.sin(x[ROTATION])
    normal = (
        c * base[6] + s * (base[4] * base[8] - base[5] * base[7]),
        c * base[7] + s * (base[5] * base[6] - base[3] * base[8]),
        c * base[8] + s * (base[3] * base[7] - base[4] * base[6]),
    )
    if planar:
        pose = tip_pose(constants, base, normal, outer, inner)
    else:
        pose = tip_of_arcs(base, normal, arcs)
    cost = _needle_cost(needle, pose, vias, count, target, cost_limit)
    if cost == math.inf:
        return math.inf
    towards = np.array(normal)
    if planar:
        reason = validate_deployment(environment, constants, base[:6], towards, outer, inner, trace, tip)
    else:
        reason = validate_arcs(environment, constants, base[:6], towards, arcs, beside, trace, tip)
    if reason != ACCEPTED:
        return math.inf
    branch = int(trace[BRANCH])
    if not _needle_clear(needle, pose, vias, count, target, branch):
        return math.inf
    return cost
