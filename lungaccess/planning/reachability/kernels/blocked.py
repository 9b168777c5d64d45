"""What rules out a box of deployments by the anatomy: blocked tips, and tubes that meet a hazard."""

from typing import NamedTuple

import numpy as np

import stages.tube.kernels as kernels
from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from anatomy.kernels.field import distance_bound, exact_distance
from anatomy.kernels.labels import LUMEN
from lungaccess.planning.coupled.kernels.box_of_tubes import HALF, INNER, OUTER, SPARE, minus, sample_of
from stages.needle.infeasibility.kernels import BackwardReach, never_along

LOOK_STEP_MM, FARTHEST_LOOK_MM = 5.0, 40.0
"""The path of the needle is looked at in such steps, as long as it is known so well."""
LOOSE_SWEEP_MM = 0.3
"""The sweep of a box is looked at where it is known so well."""
EXACT_BELOW_MM = 1.0
"""Where tubes of a box differ by less, distances to hazards and lumen are taken exactly."""
LEAST_STEP_MM, GREATEST_STEP_MM = 0.05, 4.0
"""Of samples; the least is no less than the step of `deployment.march` where it leaves the lumen."""


class ProofEnvironment(NamedTuple):
    """What a proof of one target looks at; fields of distances are those of `anatomy.kernels.field`.

    Args:
        lumen, may_be_left, hazards ((ni + 1, nj + 1, nk + 1) uint16): Distance to the lumen, to the lumen
            that tubes may leave, and to what they keep clear of.
        depth, tips ((ni + 1, nj + 1, nk + 1) uint16): Depth in the lumen, and distance to where the tip of
            the scope may be.
        passable ((ni + 1, nj + 1, nk + 1) uint16): Distance to where the needle may pass before the target.
        labels: (ni, nj, nk) uint16.
        not_lumen ((ni, nj, nk) uint8): 1 outside the lumen.
        geometry, depth_geometry ((3, 5) float64): Of the labels and the other distances, and of `depth` and
            `tips`.
        backward: Directions from which paths come to the target.
        hazard_bits: Structures that tubes keep clear of.
        loss_mm: By so much a bound of these fields may fall short of the distance.
        least_depth_mm: Of a scope tip in the lumen.
    """

    lumen: np.ndarray
    may_be_left: np.ndarray
    hazards: np.ndarray
    depth: np.ndarray
    tips: np.ndarray
    passable: np.ndarray
    labels: np.ndarray
    not_lumen: np.ndarray
    geometry: np.ndarray
    depth_geometry: np.ndarray
    backward: BackwardReach
    hazard_bits: int
    loss_mm: float
    least_depth_mm: float


@inner_kernel
def _is_deep(depth, depth_geometry, not_lumen, geometry, place, needed):
    """Tell whether the lumen is so deep at a place; beyond the grid of `not_lumen` nothing is a wall."""
    if distance_bound(depth, depth_geometry, place[0], place[1], place[2]) >= needed:
        return True
    _exact, wall = exact_distance(not_lumen, geometry, place[0], place[1], place[2], 1, -1, needed)
    return wall == 0


@kernel(nogil=True)
def deep_enough(depth, depth_geometry, not_lumen, geometry, points, needed, out):
    """Tell of points `(N, P, 3)`, LPS mm, where the lumen is so deep; `out` (N, P) bool receives it."""
    for n in range(points.shape[0]):
        for p in range(points.shape[1]):
            place = (points[n, p, 0], points[n, p, 1], points[n, p, 2])
            out[n, p] = _is_deep(depth, depth_geometry, not_lumen, geometry, place, needed)


@merged_kernel
def no_tip_near(environment, place, away):
    """Tell whether no tip of the scope may be within `away` of a place."""
    geometry = environment.depth_geometry
    if distance_bound(environment.tips, geometry, place[0], place[1], place[2]) > away:
        return True
    return not _is_deep(
        environment.depth,
        geometry,
        environment.not_lumen,
        environment.geometry,
        place,
        environment.least_depth_mm - away,
    )


@inner_kernel
def tips_in_lumen(environment, tip, away):
    """Tell whether the tips of all tubes of a box, within `away` of the middle one, are in the lumen."""
    return distance_bound(environment.depth, environment.depth_geometry, tip[0], tip[1], tip[2]) > away


@merged_kernel
def tips_blocked(environment, limits, tip, tangent, far, away, swing):
    """Tell whether all tips are in the lumen or blocked ahead.

    They are within `away` (mm) and `swing` (rad) of the middle one, which is `far` mm from the target.
    """
    if tips_in_lumen(environment, tip, away):
        return True
    spare = limits.goal_tolerance_mm + SPARE
    exempt = limits.exempt_mm
    # A needle that ends within the exempt length keeps clear of nothing but hazards.
    length = exempt
    while length < far - away - spare:
        around = away + length * swing + 0.5 * limits.kappa * length * length
        if around > FARTHEST_LOOK_MM:
            break
        x, y, z = minus(tip, tangent, -length)
        if distance_bound(environment.passable, environment.geometry, x, y, z) > around + spare:
            return True
        length += max(around, LOOK_STEP_MM)
    return never_along(environment.backward, tip + tangent, away + spare, swing, exempt)


@merged_kernel
def _lacking(environment, point, away, required):
    """Return how much clearance all tubes lack that pass within `away` of a point, mm.

    Below 0 if some may lack none; then no tube that goes on from there lacks any for as many mm.
    """
    gap = distance_bound(environment.hazards, environment.geometry, point[0], point[1], point[2]) + away
    if gap >= required or away >= EXACT_BELOW_MM:
        return required - gap - environment.loss_mm
    exact, label = exact_distance(
        environment.labels,
        environment.geometry,
        point[0],
        point[1],
        point[2],
        environment.hazard_bits,
        -1,
        required,
    )
    return required - (exact if label != 0 else required) - away


@merged_kernel
def _is_out(environment, point, away):
    """Tell whether all tubes that pass within `away` of a point are noticeably out of every lumen there."""
    required = away + kernels.UNNOTICED_MM
    bound = distance_bound(environment.lumen, environment.geometry, point[0], point[1], point[2])
    if bound > required or bound + environment.loss_mm < required or away >= EXACT_BELOW_MM:
        return bound > required
    _exact, label = exact_distance(
        environment.labels, environment.geometry, point[0], point[1], point[2], LUMEN, -1, required
    )
    return label == 0


@inner_kernel
def tubes_blocked(environment, tubes, family, box):
    """Tell whether all tubes of a box leave no airway, or one that they must not leave, or meet a hazard.

    A tube leaves between the last sample that is in the lumen for all of the box and the first that is
    outside for all; there and beyond it keeps clear of hazards, and out of every lumen.  A hazard also
    refuses tubes that leave a little farther on, as they touch the wall there.
    """
    outer, inner = box[OUTER], box[INNER]
    half_outer, half_inner = box[HALF + OUTER], box[HALF + INNER]
    most = max(abs(tubes[kernels.INNER_CURVATURE]), abs(tubes[kernels.OVERLAP_CURVATURE]))
    loose = (half_outer + half_inner) * kernels.sweep_slope(most * tubes[kernels.CURVED_LENGTH])
    sweep = 0.0
    if loose < LOOSE_SWEEP_MM and inner > tubes[kernels.CURVED_LENGTH]:
        sweep = max(kernels.lateral_sweep(tubes, min(outer, inner), inner) - loose, 0.0)
    shortest, longest = max(inner - half_inner, 0.0), inner + half_inner
    beside, first_outer = tubes[kernels.MARGIN] + sweep, outer - half_outer
    may_leave = out = False
    refuted = s = 0.0  # Tubes that leave before the first of these arc lengths are refused.
    while True:
        point, away = sample_of(tubes, family, s)
        step = min(max(away, LEAST_STEP_MM), GREATEST_STEP_MM)
        radius = tubes[kernels.OUTER_RADIUS] if s <= first_outer else tubes[kernels.INNER_RADIUS]
        lacking = _lacking(environment, point, away, radius + beside)
        deep = (
            distance_bound(environment.depth, environment.depth_geometry, point[0], point[1], point[2]) - away
        )
        if out:
            if s <= shortest and (deep > kernels.LOOK_MM or lacking > SPARE):
                return True
            to_lumen = distance_bound(environment.lumen, environment.geometry, point[0], point[1], point[2])
            step = max(step, min(-lacking, to_lumen))
        else:
            to_allowed = distance_bound(
                environment.may_be_left, environment.geometry, point[0], point[1], point[2]
            )
            if s <= shortest and lacking > SPARE:
                refuted = max(refuted, kernels.refused_exits(tubes, s, lacking, first_outer))
            may_here = to_allowed <= away + step + kernels.CORNER_MM and refuted < s + step
            if (deep > 0.0 and s <= shortest) or refuted >= s:
                may_leave = may_here
            else:
                may_leave = may_leave or may_here
            out = _is_out(environment, point, away)
            if out and (not may_leave or refuted >= s or (lacking > SPARE and s <= shortest)):
                return True
            if deep > step:
                step = deep
        if s >= longest:
            return not may_leave or (not out and refuted >= longest)
        s = min(s + step, longest)
