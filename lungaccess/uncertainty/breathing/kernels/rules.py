"""What must hold at a point of the devices in a stretch of phases, and how far along them it is then proved.

Within the ball of `reach` mm about X, the place of the masks where the point is, tissue is stretched by at
least `least` in all phases of the stretch, and d changes by at most `norm` a mm.  If no obstacle is nearer
to X than `reach`, none is nearer to the point than `least reach`.  Going on by `step` along the device and
by `half` in the share moves X by at most `(step + half speed) / least`; so the clearance stays above `least
reach - step - half speed`.  The derivation stands in docs/theory/proofs.md.
"""

import math
from typing import NamedTuple

import numpy as np

from anatomy.base.typed import Float, Labels, UInt16
from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from anatomy.kernels.field import distance_bound, exact_distance
from anatomy.kernels.labels import AIRWAY, LUMEN
from anatomy.kernels.motion import displacement_at, pulled_back, stretch_near
from lungaccess.uncertainty.breathing.kernels.rigid import carried
from lungaccess.uncertainty.breathing.kernels.warped import deformed_distance

IN_LUMEN, BEFORE_WALL, IN_WALL, TUBE, NEEDLE_AT_EXIT, NEEDLE = range(6)
"""Where a section of the devices is: the rule that holds for it, see docs/theory/proofs.md."""
CLEAR, BLOCKED, UNDECIDED = range(3)
TARGET_MISSED, LEAVES_LUMEN, HOLE_SHIFTS = -1, -2, -3
"""Reasons beside the label of the voxel that is too near."""

CORNER_MM = 0.05
"""An axis in the airway cuts corners of voxels by no more than this, as in the proof of the masks' phase."""
OUT_OF_LUMEN_MM = 0.02
"""So far the axis of a tube stays from every lumen beyond its wall, as there."""
MOST_MM = 4.0
"""Clearance beyond this is not looked for: steps are long already, and more cells would loosen the bounds."""
SEARCH_MM = 0.5
"""How far beyond what decides an exact distance is looked for, as in the proof of the masks' phase."""
LONG_STEP_MM = 0.05
"""A step that is long enough not to look closer."""
BEYOND_MM = 0.1
"""How much farther than what is to be kept deformed voxels are looked for."""
LEAST_STEP_MM = 0.0005
"""A proof that goes on by less gives up: near its exit a tube moves by so little in 1 % of a breath."""
BROKEN_MM = 0.001
"""With less than this to spare a rule counts as broken."""
OVERLAP = 1e-6
"""By so much a chord is gone on beyond its end, so that its length by the arc is reached."""
NEAR_MM = 5e-5
"""Taken off every clearance: more than the sagitta between two points, and far more than rounding."""

# Typed numbers: a kernel is compiled once more for every literal that it is called with.
_NOBODY = np.int64(-1)
_LUMEN = np.int64(LUMEN)


class Tissue(NamedTuple):
    """What the devices collide with; see `stages.tube.kernels.wall_exit.Environment`; the pierced branch."""

    clearance: UInt16
    labels: Labels
    geometry: Float
    bits: int
    lumen: UInt16
    lumen_geometry: Float
    branch: int


class Breath(NamedTuple):
    """The motion of one lung: nodes `(ni, nj, nk, 3)`, their frame `(4,)` and bounds of their cells.

    `hysteresis` is how far tissue may be from where the motion puts it, by its distance from the scope's tip.
    """

    nodes: Float
    frame: Float
    cells: Float
    hysteresis: float


class Stretch(NamedTuple):
    """A stretch of phases: middle and half as shares, the devices' pose in the middle, bounds of rates."""

    share: float
    half: float
    rotation: Float
    rate: Float
    most_rate: float
    most_change: float


@kernel()
def place(breath, rigid, stretch, point, guess):
    """Fill `guess` (3,) with the place of the masks where a point of the devices is in the middle phase.

    Returns what is left of the search in mm, the point's speed against tissue in mm a share, and its lever.
    """
    qx, qy, qz, vx, vy, vz = carried(
        rigid, stretch.share, stretch.rotation, stretch.rate, point[0], point[1], point[2]
    )
    x, y, z, rest = pulled_back(
        breath.nodes, breath.frame, stretch.share, qx, qy, qz, guess[0], guess[1], guess[2]
    )
    guess[0], guess[1], guess[2] = x, y, z
    dx, dy, dz = displacement_at(breath.nodes, breath.frame, x, y, z)
    speed = math.sqrt((vx - dx) ** 2 + (vy - dy) ** 2 + (vz - dz) ** 2)
    lx, ly, lz = point[0] - rigid.centre[0], point[1] - rigid.centre[1], point[2] - rigid.centre[2]
    return rest, speed, math.sqrt(lx * lx + ly * ly + lz * lz)


@inner_kernel
def kept_from_straying(breath, kept, lever):
    """Return the clearance by the motion that leaves `kept` wherever tissue strays, mm.

    What is at a distance c of a point is at most `lever + c` from the tip, and strays by the share of that.
    """
    return (kept + breath.hysteresis * lever) / (1.0 - breath.hysteresis)


@inner_kernel
def step_left(stretch, breath, at, rest, speed, lever, reach, kept):
    """Return how far along the device a clearance of `kept` is proved, if `reach` mm about `at` are free.

    Negative if it is not proved at the point itself.  The speed against tissue is, at most, `(base + slope
    step) / slack`.
    """
    begin, end = stretch.share - stretch.half, stretch.share + stretch.half
    least, norm = stretch_near(breath.cells, breath.frame, begin, end, at[0], at[1], at[2], reach)
    if least <= 0.0:
        return -math.inf
    half = stretch.half
    slack = 1.0 - half * norm / least
    if slack <= 0.0:
        return -math.inf
    base = (speed + half * stretch.most_change * lever + rest * norm / least) / slack
    slope = (stretch.most_rate + norm / least + half * stretch.most_change) / slack
    spare = least * reach - rest - NEAR_MM - half * base - kept_from_straying(breath, kept, lever)
    return spare / (1.0 + half * slope + breath.hysteresis / (1.0 - breath.hysteresis))


@inner_kernel
def _drift(stretch, speed, lever, near, norm):
    """Return by how much distances to voxels within `near` mm of X change in the stretch, and their slope.

    A voxel at O moves by d(O), which differs from d(X) by at most `norm near`; X stays.
    """
    most = speed + stretch.half * stretch.most_change * lever + norm * near
    return stretch.half * most, stretch.half * (stretch.most_rate + stretch.half * stretch.most_change)


@inner_kernel
def gap_to_voxels(tissue, breath, stretch, at, rest, speed, lever, bits, branch, kept):
    """Return the proved step beside deformed voxels, by how much they surely are too near, and the label.

    The second is a bound of the clearance less `kept` that holds in all phases of the stretch.

    The first three numbers of `at` are X, the others lead to the next point of the devices, in their own
    frame: up to there a step counts by as much as it leads towards each voxel, and not in full.
    Voxels within `reach` of X are measured as they are deformed in the middle phase; what lies beyond is far
    by the stretch of tissue (`step_left`).
    """
    begin, end = stretch.share - stretch.half, stretch.share + stretch.half
    least, norm = stretch_near(breath.cells, breath.frame, begin, end, at[0], at[1], at[2], MOST_MM)
    if least <= 0.0:
        return -math.inf, math.inf, 0
    kept_all = kept_from_straying(breath, kept, lever)
    base, slope = _drift(stretch, speed, lever, kept_all, norm)
    reach = min((kept_all + base + BEYOND_MM) / least, MOST_MM)
    far = step_left(stretch, breath, at, rest, speed, lever, reach, kept)
    base, slope = _drift(stretch, speed, lever, reach, norm)
    slope += breath.hysteresis / (1.0 - breath.hysteresis)
    uncertain = base + rest * (1.0 + norm) + NEAR_MM
    way = np.zeros(3)
    chord = 0.0
    for axis in range(3):
        chord += at[3 + axis] ** 2
    chord = math.sqrt(chord) * (1.0 + OVERLAP)
    if chord > 0.0:
        for axis in range(3):
            for other in range(3):
                way[axis] += stretch.rotation[axis, other] * at[3 + other] / chord
    low, high, label, along = deformed_distance(
        tissue, breath, stretch.share, at, bits, branch, reach, least, way, chord, uncertain + kept_all, slope
    )
    if label == 0:
        return far, math.inf, 0
    step = max((low - uncertain - kept_all) / (1.0 + slope), along)
    return min(step, far), high + uncertain - kept_all, label


@inner_kernel
def step_clear_of(tissue, breath, stretch, at, rest, speed, lever, bits, branch, kept):
    """Return the proved step, and the label that limits it, where `kept` mm from voxels are to be kept."""
    if bits & AIRWAY:
        free = min(distance_bound(tissue.clearance, tissue.geometry, at[0], at[1], at[2]), MOST_MM)
        step = step_left(stretch, breath, at, rest, speed, lever, free, kept)
        if step >= LONG_STEP_MM:
            return step, 0
    needed = kept_from_straying(breath, kept, lever) + stretch.half * speed
    cap = min(1.5 * needed + SEARCH_MM, MOST_MM)
    free, label = exact_distance(tissue.labels, tissue.geometry, at[0], at[1], at[2], bits, branch, cap)
    step = step_left(stretch, breath, at, rest, speed, lever, free, kept)
    if step >= LONG_STEP_MM or free <= 0.0:
        return step, label
    other, _over, nearest = gap_to_voxels(tissue, breath, stretch, at, rest, speed, lever, bits, branch, kept)
    return max(step, other), nearest if nearest else label


@merged_kernel
def step_in_lumen(tissue, breath, stretch, at, rest, speed, lever):
    """Return the proved step in which the axis is in a lumen, or cuts a corner of it."""
    depth = distance_bound(tissue.lumen, tissue.lumen_geometry, at[0], at[1], at[2])
    if depth <= 0.0:
        out, _label = exact_distance(
            tissue.labels, tissue.geometry, at[0], at[1], at[2], _LUMEN, _NOBODY, 4.0 * CORNER_MM
        )
        depth = -out
    return step_left(stretch, breath, at, rest, speed, lever, min(depth + CORNER_MM, MOST_MM), 0.0)


@inner_kernel
def step_of(tissue, breath, stretch, at, rest, speed, lever, kind, kept, radius):
    """Return the proved step of a rule beyond the exit, and the reason that limits it."""
    bits, branch = tissue.bits, tissue.branch
    if kind == NEEDLE:
        branch = _NOBODY
    step, reason = step_clear_of(tissue, breath, stretch, at, rest, speed, lever, bits, branch, kept)
    if kind in (TUBE, NEEDLE_AT_EXIT):
        from_lumen = radius if kind == NEEDLE_AT_EXIT else OUT_OF_LUMEN_MM
        other, label = step_clear_of(
            tissue, breath, stretch, at, rest, speed, lever, _LUMEN, _NOBODY, from_lumen
        )
        if other < step:
            return other, label
    return step, reason
