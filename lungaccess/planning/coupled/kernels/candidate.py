"""Compiled kernels of the coupled search: they validate and cost a choice of scope pose, tubes and needle.

`tube` is the tuple (environment, constants, design, near, shape): the first two are those of
`stages.tube.kernels`; then follow the `DesignArrays`, a proved shape near that of the choice, and a shape
that is filled with that of the choice.  `needle` is a `lungaccess.plans.evaluator.NeedleArrays`.  A choice
has two parts.  `x` holds a row of `scope_poses`, the rotation in rad, and the insertions of the tubes in mm,
the outermost first; then how far the rear end of each is turned beside that rotation, in rad.  `vias` are
points (LPS mm) through which single arcs lead from the tube to the target.  A row of `scope_poses` (9,) is a
scope tip: point, unit tangent, and the unit vector across the tangent from which the rotation counts.
"""

import math

import numpy as np

import stages.tube.kernels as kernels
from anatomy.kernels.arcs import arc_to_point, pose_on_arc
from anatomy.kernels.compiling import inner_kernel, merged_kernel
from lungaccess.planning.coupled.kernels.tubes_cost import bent_towards, cost_in_tissue
from stages.needle.kernels import blocker_on_arc, cost_of_arc, least_cosine, map_costs_on_arc

SCOPE_POSE = 0
ROTATION = 1
INSERTED = 2
"""Places of the numbers of a choice in `x`; the insertions of all tubes begin at the last."""

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


@merged_kernel
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


@merged_kernel
def _shape_nearby(design, near, shape, x):
    """Fill `shape` with that of a choice; return whether there is one, and whether it is the one nearby."""
    n = design.radii.shape[0]
    same = True
    for i in range(n):
        shape.joints[i] = x[INSERTED + n - 1 - i]
        shape.joints[n + i] = x[INSERTED + 2 * n - 1 - i]
        same = same and shape.joints[i] == near.joints[i] and shape.joints[n + i] == near.joints[n + i]
    if same:
        kernels.take_over(shape, near)
        return True, True
    return kernels.near_shape(design, near, shape), False


@inner_kernel
def why_refused(environment, constants, shape, base, towards, trace, tip):
    """Return ACCEPTED, or why a shape from a scope tip `base` (6,) is refused; see `validate_arcs`."""
    arcs, beside = shape.arcs[: shape.number[0]], kernels.required_beside(shape)
    return kernels.validate_arcs(environment, constants, base, towards, arcs, beside, trace, tip)


@inner_kernel
def validated_cost(tube, needle, scope_poses, allowed, x, vias, count, target, cost_limit, trace, tip):
    """Return the cost of a choice if it is below `cost_limit` and all of it is proved; else infinity.

    The fast tests come first: limits and cost of the needle, the deployment and its cost, the needle's
    clearance.  The tip is that of a shape reached from the one nearby; only where it passes those of the
    needle, the whole way to it is followed.
    """
    environment, constants, design, near, shape = tube
    row = int(x[SCOPE_POSE])
    if row < 0 or row >= scope_poses.shape[0] or not allowed[row]:
        return math.inf
    base = scope_poses[row]
    normal = bent_towards(base, x[ROTATION])
    found, followed = _shape_nearby(design, near, shape, x)
    if not found:
        return math.inf
    pose = kernels.tip_of_arcs(base, normal, shape.arcs[: shape.number[0]])
    cost = _needle_cost(needle, pose, vias, count, target, cost_limit)
    if cost == math.inf:
        return math.inf
    towards = np.array(normal)
    if not followed and not kernels.whole_way(design, shape):
        return math.inf
    if why_refused(environment, constants, shape, base[:6], towards, trace, tip) != kernels.ACCEPTED:
        return math.inf
    if not followed:
        pose = (tip[0], tip[1], tip[2], tip[3], tip[4], tip[5])
        cost = _needle_cost(needle, pose, vias, count, target, cost_limit)
        if cost == math.inf:
            return math.inf
    cost += cost_in_tissue(
        needle.obstacles,
        needle.of_tubes,
        base,
        normal,
        shape.arcs[: shape.number[0]],
        trace[kernels.LEFT_AT] + trace[kernels.WALL_RUN],
    )
    if not cost < cost_limit:
        return math.inf
    branch = int(trace[kernels.BRANCH])
    if not _needle_clear(needle, pose, vias, count, target, branch):
        return math.inf
    return cost
