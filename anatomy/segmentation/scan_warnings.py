"""What noise and slices of a CT do to the plans that are made on it."""

from __future__ import annotations

import numpy as np

from anatomy.base.typed import Array, Mask
from anatomy.grid import Volume
from anatomy.morphology import bounds, window
from anatomy.segmentation.input import slice_mm

TISSUE_HU = (-50.0, 150.0)
"""Muscle and blood, whose own texture is weak."""
PATCH_MM = 6.0
"""Noise is measured in cubes of this side."""
MOST_PATCHES = 20_000
"""A tenth of them lie in soft tissue: the spread of the quietest is then known to a few per cent."""
QUIET_SHARE = 0.2
"""Of the cubes: the others hold the edge of something."""
LEAST_PATCHES = 20
"""From fewer no noise is told."""
LOUD_HU = 30.0
"""Diagnostic CT of the chest has 10 to 30 HU."""
LOSS_PER_HU = 0.004
"""Share of the airway tree that each HU of noise above 20 costs in phantoms: 8 % at 40 HU, 20 % at 70 HU."""
COARSE_SLICES_MM = 1.5
"""Thinner slices show segmental bronchi nearly as wide as they are."""
METAL_HU, LEAST_METAL_ML = 2500.0, 0.1
"""Compact bone ends at 2000 HU; a screw has more than the volume, as has a vein while contrast medium
enters."""


def scan_warnings(ct: Volume, near: Mask) -> tuple[str, ...]:
    """Warn of noise and metal in the box of the lungs `near`, `(ni, nj, nk)` bool, and of thick slices."""
    warnings = []
    metal = np.count_nonzero(ct.array[window(*bounds(near))] > METAL_HU) * ct.grid.voxel_volume_mm3 / 1000.0
    if metal >= LEAST_METAL_ML:
        warnings.append(
            f"{metal:.1f} ml of metal lie between or beside the lungs: its streaks hide airways and "
            "vessels in the slices around it, so a path that looks free there may not be."
        )
    noise = noise_hu(ct, near)
    if noise > LOUD_HU:
        loss = 100.0 * LOSS_PER_HU * (noise - 20.0)
        warnings.append(
            f"The noise is {noise:.0f} HU: {loss:.0f} % of the airways or more, the thin ones, are not "
            "found, and reach is understated by what they lead to. A reconstruction with a smoother "
            "kernel or thicker slices (up to 1.5 mm) shows more."
        )
    if slice_mm(ct) > COARSE_SLICES_MM:
        warnings.append(
            f"The slices are {slice_mm(ct):.1f} mm apart: bronchi look narrower than they are, and thin "
            "ones are missing, so that reach is understated, most in the upper and lower lobes. Slices of "
            "1 mm show more."
        )
    return tuple(warnings)


def noise_hu(ct: Volume, near: Mask) -> float:
    """Return the noise in soft tissue of the box around the lungs, HU; 0 if unknown.

    It is the standard deviation of noise without correlation that leaves as much in the mean of a pixel and
    its four neighbours, which airways are searched in.  Correlated noise leaves more there than its own
    deviation tells.
    """
    box = window(*bounds(near))
    side = np.maximum(2, np.rint(PATCH_MM / ct.grid.spacing_mm)).astype(np.int64)
    patches = _cubes(ct.array[box], side)
    middles = patches.mean(axis=(1, 2, 3))
    patches = patches[(middles > TISSUE_HU[0]) & (middles < TISSUE_HU[1])]
    if len(patches) < LEAST_PATCHES or side[:2].min() < 3:
        return 0.0
    deviation = float(np.quantile(patches.std(axis=(1, 2, 3)), QUIET_SHARE))
    inner = patches[:, 1:-1, 1:-1]
    beside = patches[:, 2:, 1:-1] + patches[:, :-2, 1:-1] + patches[:, 1:-1, 2:] + patches[:, 1:-1, :-2]
    mean_of_five = (inner + beside) / np.float32(5.0)
    left = float(np.quantile(mean_of_five.std(axis=(1, 2, 3)), QUIET_SHARE))
    return max(deviation, float(np.sqrt(5.0)) * left)


def _cubes(values: Array, side: Array) -> Array:
    """Return cubes spread evenly over an image, `(N, *side)` float32."""
    counts = np.array(values.shape) // side
    total = int(counts.prod())
    chosen = np.unique(np.linspace(0, total - 1, min(total, MOST_PATCHES)).astype(np.int64))
    low = np.stack(np.unravel_index(chosen, tuple(counts)), axis=1) * side
    inside = np.stack(np.meshgrid(*(np.arange(n) for n in side), indexing="ij"), axis=-1).reshape(-1, 3)
    at = low[:, None, :] + inside[None]
    found = values[at[..., 0], at[..., 1], at[..., 2]].reshape(-1, *side)
    return np.asarray(found, dtype=np.float32)
