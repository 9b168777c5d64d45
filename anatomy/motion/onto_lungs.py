"""Whether a motion leads the lungs of the masks onto a mask of the lungs at the other end of the breath."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from anatomy.base.errors import AnatomyError
from anatomy.base.typed import Float, Labels, Mask
from anatomy.grid import Grid, Volume
from anatomy.motion.motion import LEFT, RIGHT, Motion
from anatomy.structures import OUTSIDE

SAMPLE_MM = 4.0
"""Distance of the places that are compared: a lung has some fifty thousand."""
LEAST_DICE = 0.8
"""Less is a border that is 5 mm off everywhere: what breathing itself moves the middle of a lung by."""
SAME_DICE = 0.005
"""Two Dice scores of samples that differ by less are equal."""


def other_phase(motion: Motion) -> float:
    """Return the end of the breath that is farther from the phase of the masks."""
    return 1.0 if motion.masks_phase <= 0.5 else 0.0


def require_onto_lungs(motion: Motion, labels: Labels, grid: Grid, other: Volume) -> dict[str, float]:
    """Return how well the motion leads lungs onto lungs, or raise AnatomyError if it does not.

    Parameters
    ----------
    labels : (ni, nj, nk) uint16
        See `anatomy.structures`; on `grid`.
    other : Volume of bool
        The lungs at the end of the breath that is farther from the phase of the masks.

    Returns
    -------
    dict of str to float
        Dice of the moved lungs and of the lungs as they are with the others, and the mean distance of the
        borders, mm.
    """
    low, high = motion.grid.corners_lps.min(axis=0), motion.grid.corners_lps.max(axis=0)
    shape = np.ceil((high - low) / SAMPLE_MM).astype(int) + 1
    lattice = Grid.from_spacing(shape, (SAMPLE_MM,) * 3, low)
    points = lattice.lps(np.moveaxis(np.indices(lattice.shape), 0, -1)).reshape(-1, 3)
    there = _at(other.array, other.grid, points)
    lungs = (labels & OUTSIDE) == 0
    still, is_left = _at(lungs, grid, points), points[:, 0] > motion.middle_x_mm
    moved, phase = np.zeros(len(points), dtype=bool), other_phase(motion)
    for side, chosen in ((RIGHT, ~is_left), (LEFT, is_left)):
        moved[chosen] = _at(lungs, grid, motion.pulled_back(points[chosen], phase, side))
    dice, unmoved = _dice(moved, there), _dice(still, there)
    if dice < max(LEAST_DICE, unmoved - SAME_DICE):
        raise AnatomyError(
            f"The motion leads the lungs onto the other lungs with a Dice of {dice:.3f}; without it they "
            f"have {unmoved:.3f}",
            expected=f"at least {LEAST_DICE:g}, and no less than without the motion",
            remedy="Check maps_from and masks_phase, and that other_lungs shows this patient at the other "
            f"end of the breath, phase {phase:g}",
        )
    # The mean distance from the border of each mask to that of the other, mm.
    borders = [
        mask & ~ndimage.binary_erosion(mask)
        for mask in (moved.reshape(lattice.shape), there.reshape(lattice.shape))
    ]
    away = [ndimage.distance_transform_edt(~border, sampling=SAMPLE_MM) for border in borders]
    both = np.concatenate([away[1][borders[0]], away[0][borders[1]]])
    apart = float(both.mean())
    return {"lungs_dice": dice, "lungs_dice_unmoved": unmoved, "lungs_borders_mm": apart}


def _at(mask: Mask, grid: Grid, points: Float) -> Mask:
    """Return whether points `(N, 3)` LPS mm are in a mask; beyond its grid they are not."""
    index = np.rint(grid.ijk(points)).astype(int)
    within = ((index >= 0) & (index < np.asarray(grid.shape))).all(axis=1)
    inside = np.zeros(len(points), dtype=bool)
    inside[within] = mask[tuple(index[within].T)]
    return inside


def _dice(a: Mask, b: Mask) -> float:
    return float(2.0 * (a & b).sum() / max(a.sum() + b.sum(), 1))
