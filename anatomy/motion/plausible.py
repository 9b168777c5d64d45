"""Whether a motion can be that of lungs: it does not fold, and inhaling moves the bases to the feet."""

from dataclasses import replace

import numpy as np
from scipy import ndimage

from anatomy.base.errors import AnatomyError
from anatomy.base.typed import Float, Labels, Mask
from anatomy.base.words import percent
from anatomy.grid import Grid, Volume
from anatomy.motion.motion import LEFT, RIGHT, Motion
from anatomy.structures import OUTSIDE

SEEN_MM = 1.0
"""A motion of the bases below this has no direction that could be wrong."""
GREATEST_MM = 60.0
"""Twice the greatest motion of landmarks in quiet breathing: more is a wrong unit or frame."""


def require_plausible(motion: Motion, lungs: dict[int, Float]) -> Motion:
    """Return a motion with figures and warnings; AnatomyError if `(N, 3)` LPS mm of lungs cannot move so."""
    least = _require_invertible(motion)
    moved = {side: motion.amplitude * motion.displacements_mm(lungs[side], side) for side in lungs}
    far = {side: float(np.percentile(np.linalg.norm(each, axis=1), 95)) for side, each in moved.items()}
    down = {}
    for side, places in lungs.items():
        base, apex = places[:, 2].min(), places[:, 2].max()
        # The third of the height next to the diaphragm, which moves most.
        down[side] = float(-moved[side][places[:, 2] < base + (1.0 / 3.0) * (apex - base), 2].mean())
    if not all(value <= GREATEST_MM for value in far.values()):
        raise AnatomyError(
            f"The lungs move by up to {max(far.values()):.0f} mm",
            expected=f"less than {GREATEST_MM:g} mm in quiet breathing",
            remedy="Check that the displacements are mm, and their frame",
        )
    if not any(value >= -SEEN_MM for value in down.values()):
        raise AnatomyError(
            f"Inhaling moves the bases of the lungs to the head, by {-down[RIGHT]:.1f} mm (right) and "
            f"{-down[LEFT]:.1f} mm (left)",
            expected="a motion to the feet",
            remedy="The direction is reversed: state the other end in maps_from, or swap the two ends",
        )
    warnings = [
        f"Inhaling moves the base of the {name} lung to the head, by {-down[side]:.1f} mm."
        for side, name in ((RIGHT, "right"), (LEFT, "left"))
        if down[side] < -SEEN_MM
    ]
    # One lung that moves so much more than the other is unusual; in ten patients none did twice.
    if max(far.values()) > 3.0 * max(min(far.values()), SEEN_MM):
        warnings.append(
            f"The right lung moves by {far[RIGHT]:.1f} mm and the left one by {far[LEFT]:.1f} mm: look "
            "whether the motion is that of this patient, and not mirrored."
        )
    # A field that is split where the lungs touch is mended in 1 % of a lung.
    if motion.figures.get("mended_share", 0.0) > 0.05:
        warnings.append(
            f"The motion slides or folds in {percent(motion.figures['mended_share'])} of a lung; there "
            "it is continued from elsewhere, which leaves what the residual says."
        )
    if motion.warning_only:
        warnings.append(
            "The motion is that of other people's lungs: a window of breathing made with it is a warning, "
            f"not a promise; the model leaves {motion.figures['residual_mm']:.1f} mm."
        )
    figures = {
        **motion.figures,
        "right_95_mm": far[RIGHT],
        "left_95_mm": far[LEFT],
        "right_base_to_feet_mm": down[RIGHT],
        "left_base_to_feet_mm": down[LEFT],
        "least_stretch": least,
        **_volume_factors(motion, lungs),
    }
    return replace(motion, figures=figures, warnings=tuple(warnings))


def _require_invertible(motion: Motion) -> float:
    """Return a bound, above 0, of how little of a length is left in any phase: then no two places meet."""
    least = np.stack([motion.least_stretch(side) for side in (RIGHT, LEFT)])
    worst = np.unravel_index(int(least.argmin()), least.shape)
    value = float(least[worst])
    if not value > 0.0:
        at = motion.grid.lps(np.array(worst[1:]) + 0.5)
        folded = float((least <= 0.0).mean())
        raise AnatomyError(
            f"The motion is not proved to be invertible in {percent(folded)} of its cells: at "
            f"lps:{at[0]:.0f},{at[1]:.0f},{at[2]:.0f} lengths may shrink by a factor of {value:.2f}",
            expected="a motion that squeezes tissue nowhere to nothing, a factor above 0",
            remedy="Smooth the field, or register again with more regularisation",
        )
    return value


def _volume_factors(motion: Motion, lungs: dict[int, Float]) -> dict[str, float]:
    """Return the factors by which each lung's volume grows from end-exhale to end-inhale."""
    out = {}
    for side, name in ((RIGHT, "right"), (LEFT, "left")):
        step = 0.5 * float(motion.frame[3])
        ahead, behind = (
            np.stack([motion.displacements_mm(lungs[side] + by * axis, side) for axis in np.eye(3)], axis=-1)
            for by in (step, -step)
        )
        gradient = (ahead - behind) / (2.0 * step)
        volumes = [np.linalg.det(np.eye(3) + motion.share(phase) * gradient).mean() for phase in (0.0, 1.0)]
        out[f"{name}_volume_factor"] = float(volumes[1] / volumes[0])
    return out


SAMPLE_MM = 4.0
"""Distance of the places in the lungs at which a motion is looked at: a lung has some fifty thousand."""
LEAST_DICE = 0.8
"""Less is a border that is 5 mm off everywhere: what breathing itself moves the middle of a lung by."""


def require_onto_lungs(motion: Motion, labels: Labels, grid: Grid, other: Volume) -> dict[str, float]:
    """Return how well the motion leads lungs onto lungs, or raise AnatomyError if it does not.

    `labels` are those of `anatomy.structures` on `grid`; `other` are the lungs at the end of the breath that
    is farther from the phase of the masks.  Returned are Dice of the moved lungs and of the lungs as they are
    with the others, and the mean distance of the borders, mm.
    """
    low, high = motion.grid.corners_lps.min(axis=0), motion.grid.corners_lps.max(axis=0)
    lattice = Grid.over(low, high, SAMPLE_MM)
    points = lattice.centres_lps.reshape(-1, 3)
    there = other.at(points, False)
    lungs = (labels & OUTSIDE) == 0
    still, is_left = grid.values_at(lungs, points, False), points[:, 0] > motion.middle_x_mm
    moved, phase = np.zeros(len(points), dtype=bool), 1.0 if motion.masks_phase <= 0.5 else 0.0
    for side, chosen in ((RIGHT, ~is_left), (LEFT, is_left)):
        moved[chosen] = grid.values_at(lungs, motion.pulled_back(points[chosen], phase, side), False)
    dice, unmoved = _dice(moved, there), _dice(still, there)
    # Two Dice scores of samples that differ by less are equal.
    if not dice >= max(LEAST_DICE, unmoved - 0.005):
        raise AnatomyError(
            f"The motion leads the lungs onto the other lungs with a Dice of {dice:.3f}; without it they "
            f"have {unmoved:.3f}",
            expected=f"at least {LEAST_DICE:g}, and no less than without the motion",
            remedy="Check maps_from and masks_phase, and that other_lungs shows this patient at the other "
            f"end of the breath, phase {phase:g}",
        )
    # The mean distance from the border of each mask to that of the other, mm.
    masks = (moved.reshape(lattice.shape), there.reshape(lattice.shape))
    borders = [mask & ~ndimage.binary_erosion(mask) for mask in masks]
    away = [ndimage.distance_transform_edt(~border, sampling=SAMPLE_MM) for border in borders]
    both = np.concatenate([away[1][borders[0]], away[0][borders[1]]])
    return {"lungs_dice": dice, "lungs_dice_unmoved": unmoved, "lungs_borders_mm": float(both.mean())}


def _dice(a: Mask, b: Mask) -> float:
    return float(2.0 * (a & b).sum() / max(a.sum() + b.sum(), 1))
