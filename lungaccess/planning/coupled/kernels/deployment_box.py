"""Boxes of deployments from a scope tip: whether all tubes of one are ruled out.

A box is one of `box_of_tubes`, from one scope tip.  Its first two sides say where the paths cross a sphere
halfway to the target, as a rotation vector (rad) from the straight line; a half width below 0 is no such
range.  docs/theory/cost_bound.md derives what is ruled out.
"""

import math
from typing import NamedTuple

import numpy as np

import stages.tube.kernels as kernels
from anatomy.kernels.compiling import inner_kernel, merged_kernel
from anatomy.kernels.field import distance_bound, exact_distance, most_distance
from anatomy.kernels.labels import BRANCH_SHIFT, LUMEN
from lungaccess.planning.coupled.kernels.box_of_tubes import (
    HALF,
    INNER,
    OUTER,
    ROTATION,
    SPARE,
    cross,
    minus,
    sample_of,
    times,
    tubes_of,
)

ACROSS, UP, SIDES = 0, 1, 5
BOUND, TIP, AWAY, WIDE, LOSS = 5, 6, 7, 13, 14
BOX_COLUMNS = LOSS + SIDES
"""`TIP` is the row of the scope tip, `AWAY` how far tips are from the middle one at most, mm, and `WIDE` the
greatest angle (rad) of that rotation vector; from `LOSS` on stands what each side costs, mm."""

TUBE_STEP_MM = 0.5
"""Step at which tubes of a small box are looked at."""
LOOSE_SWEEP_MM = 0.3
"""The samples of the sweep are looked at where they are known so well."""
SWEEPS_EVERY = 4
"""Of the samples of the sweep, one of so many is looked at."""
LOOK_AHEAD_MM = 0.5
"""Hazards that are farther from a tube than they must be are searched for within this."""
LEAST_STEP_MM = 0.1
"""The same where they leave their airway."""
WIDEST_LOOK_MM = 2.5
"""Lumen is searched for branches within less than this."""
NONE, SEVERAL = -2, -3
"""Instead of the branch of a lumen: no lumen, lumen of more than two branches."""


class TubeSurroundings(NamedTuple):
    """What tubes are kept clear of.

    Args:
        clearance ((ni + 1, nj + 1, nk + 1) uint16): Corner field of the distance to all obstacles.
        labels: (ni, nj, nk) uint16.
        geometry: (3, 6) float64.
        depth, depth_geometry: Corner field of the depth in the lumen.
        bits, hazard_bits: Structures that are obstacles: all, and those other than airways.
        mediastinal ((B,) bool): Airway branches that must not be left.
    """

    clearance: np.ndarray
    labels: np.ndarray
    geometry: np.ndarray
    depth: np.ndarray
    depth_geometry: np.ndarray
    bits: int
    hazard_bits: int
    mediastinal: np.ndarray


@inner_kernel
def tubes_at(tubes, tips, box):
    """Return the `BoxTubes` of a box from its scope tip, a row of `tips` (S, 9)."""
    tip = tips[int(box[TIP])]
    forward, first = (tip[3], tip[4], tip[5]), (tip[6], tip[7], tip[8])
    second = cross(forward, first)
    normal = minus(times(first, math.cos(box[ROTATION])), second, -math.sin(box[ROTATION]))
    return tubes_of(tubes, (tip[0], tip[1], tip[2]), forward, normal, 0.0, 0.0, box)


@inner_kernel
def least_sweep(tubes, box):
    """Return a sideways sweep (mm) that no deployment of a box goes below; see `stages.tube.lateral_sweep`.

    It looks at where the inner tube's curve ends, and at the sample at which the middle deployment sweeps
    most.  docs/theory/cost_bound.md derives how both change with the insertions.
    """
    curved, inner, outer = tubes[kernels.CURVED_LENGTH], box[INNER], box[OUTER]
    longest, first_outer = inner + box[HALF + INNER], max(outer - box[HALF + OUTER], 0.0)
    if inner - box[HALF + INNER] <= curved or outer > inner:
        return 0.0
    unlike = abs(tubes[kernels.OVERLAP_CURVATURE] - tubes[kernels.INNER_CURVATURE])
    opening = abs(tubes[kernels.OVERLAP_CURVATURE])
    if longest - curved > first_outer:
        opening = max(opening, abs(tubes[kernels.INNER_CURVATURE]))
    least = kernels.off_track(tubes, outer, inner, curved) - opening * curved * box[HALF + INNER]
    least -= 2.0 * unlike * max(curved - first_outer, 0.0) * box[HALF + OUTER]
    if opening * curved * box[HALF + INNER] < LOOSE_SWEEP_MM:
        greatest = share = 0.0
        for m in range(SWEEPS_EVERY, kernels.SWEEP_SAMPLES + 1, SWEEPS_EVERY):
            off = kernels.off_track(tubes, outer, inner, inner * m / kernels.SWEEP_SAMPLES)
            if off > greatest:
                greatest, share = off, m / kernels.SWEEP_SAMPLES
        by_inner = opening * (curved + share * ((1.0 - share) * longest + curved))
        greatest -= by_inner * box[HALF + INNER]
        greatest -= 2.0 * unlike * max(share * longest - first_outer, 0.0) * box[HALF + OUTER]
        least = max(least, greatest)
    return max(least - SPARE, 0.0)


@merged_kernel
def _branches_of_lumen(surroundings, point, reach, branches):
    """Return the branches of all lumen within `reach` of a point, and of what was found before: see NONE."""
    labels, geometry = surroundings.labels, surroundings.geometry
    one, other = branches
    if one == SEVERAL or reach > WIDEST_LOOK_MM:
        return SEVERAL, NONE
    x, y, z = point
    u = geometry[0, 0] * x + geometry[0, 1] * y + geometry[0, 2] * z + geometry[0, 3]
    v = geometry[1, 0] * x + geometry[1, 1] * y + geometry[1, 2] * z + geometry[1, 3]
    w = geometry[2, 0] * x + geometry[2, 1] * y + geometry[2, 2] * z + geometry[2, 3]
    half = geometry[0, 5]
    su, sv, sw = math.sqrt(geometry[0, 4]), math.sqrt(geometry[1, 4]), math.sqrt(geometry[2, 4])
    for k in range(max(int(w - reach / sw), 0), min(int(w + reach / sw) + 1, labels.shape[2])):
        dw = max(abs(k + 0.5 - w) - half, 0.0) * sw
        for j in range(max(int(v - reach / sv), 0), min(int(v + reach / sv) + 1, labels.shape[1])):
            dv = max(abs(j + 0.5 - v) - half, 0.0) * sv
            for i in range(max(int(u - reach / su), 0), min(int(u + reach / su) + 1, labels.shape[0])):
                label = int(labels[i, j, k])
                here = (label >> BRANCH_SHIFT) - 1
                if label & LUMEN == 0 or here == one or here == other:
                    continue
                du = max(abs(i + 0.5 - u) - half, 0.0) * su
                if du * du + dv * dv + dw * dw > reach * reach:
                    continue
                if one == NONE:
                    one = here
                elif other == NONE:
                    other = here
                else:
                    return SEVERAL, NONE
    return one, other


@inner_kernel
def _must_not_leave(surroundings, branch):
    """Tell whether tubes must not leave a branch, or there is none."""
    return branch == NONE or branch == -1 or (branch >= 0 and surroundings.mediastinal[branch])


@inner_kernel
def _within(surroundings, point, bits, branch, reach):
    """Tell whether a structure, but airways of a branch, is within `reach` mm of a point."""
    if reach <= 0.0:
        return False
    x, y, z = point
    if distance_bound(surroundings.clearance, surroundings.geometry, x, y, z) >= reach:
        return False
    labels, geometry = surroundings.labels, surroundings.geometry
    _distance, label = exact_distance(labels, geometry, x, y, z, bits, branch, reach)
    return label != 0


@inner_kernel
def tubes_blocked(surroundings, tubes, family, box, sweep):
    """Tell whether all tubes of a box are refused, or end in a lumen.

    A tube leaves its airway behind the last sample at which all tubes are in the lumen, and before the first
    at which all are out of every lumen.  Where they all leave one branch, other branches count as obstacles.
    A hazard also refuses tubes that leave beyond it and touch the wall from there on: see
    `docs/theory/cost_bound.md`.  No tube of the box sweeps sideways by less than `sweep` mm.
    """
    first_outer, longer = box[OUTER] - box[HALF + OUTER], 2.0 * box[HALF + INNER]
    shortest = max(box[INNER] - box[HALF + INNER], 0.0)
    hazards, bits = surroundings.hazard_bits, surroundings.bits
    beside = tubes[kernels.MARGIN] + sweep - SPARE
    left, branches = False, (NONE, NONE)
    refused = other_refused = touching = False
    refuted = 0.0  # Tubes that leave before this arc length are refused.
    s = back = looked = 0.0
    while True:
        point, away = sample_of(tubes, family, s)
        x, y, z = point
        deep = distance_bound(surroundings.depth, surroundings.depth_geometry, x, y, z)
        radius = tubes[kernels.OUTER_RADIUS] if s <= first_outer else tubes[kernels.INNER_RADIUS]
        reach = radius + beside - away
        if not left:
            step = max(min(TUBE_STEP_MM, 2.0 * away), LEAST_STEP_MM, away)
            if deep > away + back:
                branches = (NONE, NONE)
                step = max(step, 0.5 * (deep - away))
            else:
                around = away + back
                branches = _branches_of_lumen(surroundings, point, around + 2.0 * kernels.CORNER_MM, branches)
            deepest = most_distance(surroundings.depth, surroundings.depth_geometry, x, y, z) + away
            touching = touching and deepest + back < radius
            if deep < away + radius and s >= looked and reach > 0.0:
                near, _label = exact_distance(
                    surroundings.labels, surroundings.geometry, x, y, z, hazards, -1, reach + LOOK_AHEAD_MM
                )
                lack = reach - near
                looked = s + abs(lack)  # Before, the same holds by and large.
                if lack > 0.0:
                    refuted = max(refuted, kernels.refused_exits(tubes, s, lack, first_outer))
                    touching = touching or deepest + kernels.FINE_STEP_MM < radius
            if touching or refuted >= s:
                branches = (NONE, NONE)
            left = deep <= 0.0 and not _within(surroundings, point, LUMEN, -1, away + kernels.UNNOTICED_MM)
            if left and (touching or refuted >= s):
                return True
            if left and branches[0] != SEVERAL:
                refused = _must_not_leave(surroundings, branches[0])
                other_refused = _must_not_leave(surroundings, branches[1])
        if left:
            if deep > away + kernels.LOOK_MM:
                return True
            if branches[0] == SEVERAL:
                refused = other_refused = _within(surroundings, point, hazards, -1, reach)
            else:
                refused = refused or _within(surroundings, point, bits, branches[0], reach)
                other_refused = other_refused or _within(surroundings, point, bits, branches[1], reach)
            if refused and other_refused:
                return True
            clear = distance_bound(surroundings.clearance, surroundings.geometry, x, y, z)
            step = max(TUBE_STEP_MM, away, clear - radius - beside - away)
        if s >= shortest:
            if not left and (
                refuted >= s + longer or (touching and deepest + longer < tubes[kernels.INNER_RADIUS])
            ):
                return True
            return deep > away + longer + SPARE
        back = min(step, shortest - s)
        s = min(s + step, shortest)
