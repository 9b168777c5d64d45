"""Directions of an image, upwards, forwards and to the left, as airway and lungs tell them."""

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.typed import Float
from anatomy.plausibility import DOUBTFUL, Finding

SAMPLE_MM = 3.0
"""Lungs are looked at in steps of this: their shape is known to a step."""
LEAST_TRACHEA_MM = 15.0
"""From a shorter trachea no direction can be told."""
HEART_MM = (70.0, 120.0)
"""The heart is looked for so far in front of the carina, and so far below it."""


def directions(tree: AirwayTree, left: Float, right: Float, lowest_mm: float) -> list[Finding]:
    """Return the directions that fail, as airway and lungs all speak against them, and those in doubt.

    Each direction is told by signs that do not depend on each other: 1 as in a patient whose header is right,
    -1 against it, 0 undecided.  Only a header that is wrong, or organs that are mirrored, turn all signs of a
    direction around; it is in doubt if one is.  The lungs are about one point in every cube of `SAMPLE_MM`,
    `(N, 3)` LPS mm; one that reaches `lowest_mm`, the height of the lowest voxels, may be cut off.
    """
    lungs = [left, right]
    top, carina = tree.points_lps[0], tree.carina_lps
    along = top - carina
    length = float(np.linalg.norm(along))
    up, front = [], []
    if length >= LEAST_TRACHEA_MM:
        # The trachea runs upwards within 60 degrees even in a bent patient.
        up.append(1 if along[2] >= 0.5 * length else -1)
        # The trachea runs backwards on its way down, by 8 to 40 degrees; less than 3 degrees say nothing.
        front.append(_sign(-along[1] / length, 0.05))
    whole = (points for points in lungs if len(points) and points[:, 2].min() > lowest_mm + 0.5 * SAMPLE_MM)
    bases = []
    for points in whole:
        # This share of each lung is its base, which lies behind, where the diaphragm slopes down.
        low = points[:, 2] <= np.quantile(points[:, 2], 0.15)
        bases.append(float(points[low, 1].mean() - points[~low, 1].mean()))
    if bases:
        # The base lies 9 to 30 mm behind the rest; less says nothing.
        front.append(_sign(float(np.mean(bases)), 3.0))
    found = []
    left_right = _left(tree, lungs, carina)
    for what, votes in (
        ("upside down or lying across: the trachea does not run upwards", up),
        ("front to back: trachea and bases of the lungs lie as if front and back were exchanged", front),
        ("mirrored: main bronchi and heart lie as if left and right were exchanged", left_right),
    ):
        decided, is_sides = [vote for vote in votes if vote], what.startswith("mirrored")
        name = "sides" if is_sides else "axes"
        if min(decided, default=0) > 0 or not (decided or is_sides):
            continue
        if max(decided, default=0) < 0 and (is_sides or len(decided) > 1 or what.startswith("upside")):
            remedy = "Check the header of the image: its directions may be wrong"
            remedy += "; or the organs of this patient are mirrored" if is_sides else ""
            found.append(Finding(name=name, found=f"The image is {what}", remedy=remedy))
            continue
        unsure = "left and right" if is_sides else "front and back"
        said = (
            f"The anatomy does not tell {unsure} for sure: look at a picture of the masks whether they are "
            "where they belong. If the header is wrong, every plan is for the wrong place."
        )
        found.append(Finding(name=name, verdict=DOUBTFUL, found=said))
    return found


def _left(tree: AirwayTree, lungs: list[Float], carina: Float) -> list[int]:
    signs: list[int] = []
    if not all(len(points) for points in lungs):
        return signs
    lengths = _main_bronchi(tree, lungs)
    if lengths is not None:
        # The left main bronchus is about twice as long as the right one, 5 against 2.5 cm.
        signs.append(_sign(float(np.log(lengths[0] / lengths[1])), float(np.log(1.2))))
    heart = _heart_mm(lungs, carina)
    if heart is not None:
        # Two thirds of the heart lie on the left: 10 to 30 mm on the average; less says nothing.
        signs.append(_sign(heart, 4.0))
    return signs


def _sign(value: float, least: float) -> int:
    return 0 if abs(value) < least else int(np.sign(value))


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
    left_is_right = lungs[0][:, 0].mean() < lungs[1][:, 0].mean()
    inner = []
    for n, points in enumerate(lungs):
        at = points[
            (points[:, 1] <= carina[1])
            & (points[:, 1] >= carina[1] - HEART_MM[0])
            # Above this lie vessels that are as wide on both sides.
            & (points[:, 2] <= carina[2] - 30.0)
            & (points[:, 2] >= low)
        ]
        lines = np.floor((at[:, 1:] - carina[1:]) / (2.0 * SAMPLE_MM)).astype(np.int64)
        # Of the places on a line the last one counts, which is the nearest to the other lung.
        order = np.argsort(at[:, 0] if (n == 0) == left_is_right else -at[:, 0])
        inner.append(dict(zip(map(tuple, lines[order].tolist()), at[order, 0].tolist(), strict=True)))
    shared = inner[0].keys() & inner[1].keys()
    # From fewer lines across the chest no place of the heart is told.
    if len(shared) < 20:
        return None
    middle = np.mean([0.5 * (inner[0][line] + inner[1][line]) for line in sorted(shared)])
    return float(middle - carina[0])
