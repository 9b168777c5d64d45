"""How a patient lies in an image, told by the airway and the lungs: up, front and left.

Each direction is told by signs that do not depend on each other.  Only a header that is wrong, or organs that
are mirrored, turn all signs of a direction around.
"""

from __future__ import annotations

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.records import frozen_value
from anatomy.base.typed import Float, Mask
from anatomy.grid import Grid

SAMPLE_MM = 3.0
"""Lungs are looked at in steps of this: their shape is known to a step."""
LEAST_TRACHEA_MM = 15.0
"""From a shorter trachea no direction can be told."""
LEAST_UP = 0.5
"""The trachea runs upwards within 60 degrees even in a bent patient."""
LEAST_TILT = 0.05
"""The trachea runs backwards on its way down, by 8 to 40 degrees; less than 3 degrees say nothing."""
LOWEST_SHARE = 0.15
"""So much of each lung is its base, which lies behind, where the diaphragm slopes down."""
LEAST_BACK_MM = 3.0
"""The base lies 9 to 30 mm behind the rest; less says nothing."""
LEAST_RATIO = 1.2
"""The left main bronchus is about twice as long as the right one, 5 against 2.5 cm."""
HEART_MM = (70.0, 120.0)
"""The heart is looked for so far in front of the carina, and so far below it."""
BELOW_CARINA_MM = 30.0
"""Above this lie vessels that are as wide on both sides."""
LEAST_HEART_MM = 4.0
"""Two thirds of the heart lie on the left: 10 to 30 mm on the average; less says nothing."""
LEAST_LINES = 20
"""From fewer lines across the chest no place of the heart is told."""


@frozen_value
class Landmarks:
    """Signs of each direction: 1 as in a patient whose header is right, -1 against it, 0 undecided."""

    up: tuple[int, ...]
    front: tuple[int, ...]
    left: tuple[int, ...]


def landmarks(tree: AirwayTree, left: Mask, right: Mask, grid: Grid) -> Landmarks:
    """Return what airway and lungs, bool `(ni, nj, nk)` on `grid`, say about the directions."""
    lungs = [_points(mask, grid) for mask in (left, right)]
    top, carina = tree.points_lps[0], tree.carina_lps
    along = top - carina
    length = float(np.linalg.norm(along))
    up, front = [], []
    if length >= LEAST_TRACHEA_MM:
        up.append(1 if along[2] >= LEAST_UP * length else -1)
        front.append(_sign(-along[1] / length, LEAST_TILT))
    bases = [_base(points) for points, mask in zip(lungs, (left, right), strict=True) if _whole(mask)]
    if bases:
        front.append(_sign(float(np.mean(bases)), LEAST_BACK_MM))
    return Landmarks(up=tuple(up), front=tuple(front), left=_left(tree, lungs, carina))


def _left(tree: AirwayTree, lungs: list[Float], carina: Float) -> tuple[int, ...]:
    if not all(len(points) for points in lungs):
        return ()
    signs = []
    lengths = _main_bronchi(tree, lungs)
    if lengths is not None:
        signs.append(_sign(float(np.log(lengths[0] / lengths[1])), float(np.log(LEAST_RATIO))))
    heart = _heart_mm(lungs, carina)
    if heart is not None:
        signs.append(_sign(heart, LEAST_HEART_MM))
    return tuple(signs)


def _sign(value: float, least: float) -> int:
    return 0 if abs(value) < least else int(np.sign(value))


def _points(mask: Mask, grid: Grid) -> Float:
    """Return voxels of a mask in steps of some millimetres, `(N, 3)` LPS mm."""
    step = np.maximum(1, np.rint(SAMPLE_MM / grid.spacing_mm)).astype(np.int64)
    return np.asarray(grid.lps(np.argwhere(mask[tuple(slice(None, None, int(s)) for s in step)]) * step))


def _whole(mask: Mask) -> bool:
    """Tell whether the lower end of a lung is in the image, the third axis running upwards."""
    return bool(mask.any()) and not bool(mask[:, :, 0].any())


def _base(points: Float) -> float:
    """Return how far the base of a lung lies behind the rest, mm."""
    low = points[:, 2] <= np.quantile(points[:, 2], LOWEST_SHARE)
    return float(points[low, 1].mean() - points[~low, 1].mean())


def _main_bronchi(tree: AirwayTree, lungs: list[Float]) -> tuple[float, float] | None:
    """Return the lengths of the left and right main bronchus, mm; None unless the trachea leads to both."""
    middle = 0.5 * (lungs[0][:, 0].mean() + lungs[1][:, 0].mean())
    left_at_plus_x = lungs[0][:, 0].mean() > lungs[1][:, 0].mean()
    top = np.arange(tree.n_branches)
    for branch in range(1, tree.n_branches):  # the child of the trachea that each branch hangs on
        parent = int(tree.branch_parent[branch])
        top[branch] = branch if parent == 0 else top[parent]
    ends = tree.points_lps[tree.branch_start[1:] - 1]
    is_left = (ends[:, 0] > middle) == left_at_plus_x
    found = []
    for side in (is_left, ~is_left):
        counts = np.bincount(top[1:][side[1:]], minlength=tree.n_branches)
        if not counts.any():
            return None
        found.append(int(np.argmax(counts)))
    if found[0] == found[1]:
        return None
    left, right = (float(tree.branch_length_mm[b]) for b in found)
    return (left, right) if min(left, right) > 0.0 else None


def _heart_mm(lungs: list[Float], carina: Float) -> float | None:
    """Return how far left of the carina the middle between the lungs lies in front of it and below, mm."""
    low = max(float(carina[2]) - HEART_MM[1], *(float(np.quantile(p[:, 2], 0.03)) for p in lungs))
    bins = []
    for points in lungs:
        at = points[
            (points[:, 1] <= carina[1])
            & (points[:, 1] >= carina[1] - HEART_MM[0])
            & (points[:, 2] <= carina[2] - BELOW_CARINA_MM)
            & (points[:, 2] >= low)
        ]
        lines = np.floor((at[:, 1:] - carina[1:]) / (2.0 * SAMPLE_MM)).astype(np.int64)
        bins.append((at[:, 0], lines))
    left_is_right = lungs[0][:, 0].mean() < lungs[1][:, 0].mean()
    inner = []
    for n, (x, lines) in enumerate(bins):
        towards_plus = (n == 0) == left_is_right
        nearest: dict[tuple[int, int], float] = {}
        for value, line in zip(x.tolist(), map(tuple, lines.tolist()), strict=True):
            known = nearest.get(line, value)
            nearest[line] = max(known, value) if towards_plus else min(known, value)
        inner.append(nearest)
    shared = inner[0].keys() & inner[1].keys()
    if len(shared) < LEAST_LINES:
        return None
    middle = np.mean([0.5 * (inner[0][line] + inner[1][line]) for line in sorted(shared)])
    return float(middle - carina[0])
