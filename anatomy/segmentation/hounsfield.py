"""Whether air measures -1000 HU in an image, and the image as if it did."""

import numpy as np

from anatomy.base.typed import Mask
from anatomy.grid import Volume
from anatomy.segmentation.closing import distance_mm
from anatomy.segmentation.coarse import CoarseCt

AIR_HU = -1000.0
"""The scale defines air so."""
GREATEST_OFFSET_HU = 25.0
"""Scanners keep air around the patient within 10 HU; more is another scale."""
GREATEST_SCATTER_HU = 45.0
"""Scatter and contrast medium raise the air in the trachea by up to 40 HU, so it tells less where it is
alone."""
AROUND_HU = (-1099.0, -880.0)
"""Air around the patient, shifted or not: lower values are padding, higher ones table and clothes."""


def air_offset_hu(coarse: CoarseCt, airway: Mask) -> float:
    """Return by how much air, in the airway and around the patient, differs from -1000 HU; 0 if as usual."""
    depth = distance_mm(np.asfortranarray(airway), coarse.spacing_mm)
    # At this share of the airway's greatest depth nothing but air is measured.
    inside = float(np.median(coarse.hu[depth >= 0.6 * depth.max()])) - AIR_HU
    around = offset_around_hu(coarse)
    if around is None:
        return inside if abs(inside) > GREATEST_SCATTER_HU else 0.0
    # Noise of the difference: scatter only ever raises the air in the trachea.
    if -10.0 <= inside - around <= GREATEST_SCATTER_HU:
        return around if abs(around) > GREATEST_OFFSET_HU else 0.0
    smaller = inside if abs(inside) < abs(around) else around
    return smaller if inside * around > 0.0 and abs(smaller) > GREATEST_OFFSET_HU else 0.0


def offset_around_hu(coarse: CoarseCt) -> float | None:
    """Return by how much air at the sides of the image differs from -1000 HU; None if there is hardly any."""
    hu = coarse.hu
    sides = np.concatenate([side.ravel() for side in (hu[0], hu[-1], hu[:, 0], hu[:, -1])])
    air = sides[(sides > AROUND_HU[0]) & (sides < AROUND_HU[1])]
    # Air over less than this share of the image's sides may be lung that the image cuts off.
    return float(np.median(air)) - AIR_HU if air.size >= 0.01 * sides.size else None


def without_offset(ct: Volume, offset_hu: float) -> Volume:
    """Return the image with its values lowered by an offset; the image itself if that is 0."""
    if not offset_hu:
        return ct
    whole = np.rint(ct.array - np.float32(offset_hu)).astype(np.float32)
    return Volume(grid=ct.grid, array=np.clip(whole, -32768, 32767).astype(np.int16))


def offset_warning(offset_hu: float) -> tuple[str, ...]:
    """Say what was done to an image whose values are shifted."""
    if not offset_hu:
        return ()
    return (
        f"Air measures {AIR_HU + offset_hu:.0f} HU instead of {AIR_HU:.0f}: "
        f"{-offset_hu:+.0f} HU "
        "were added to every voxel. Vessels are told apart by their HU: if the scale is wrong in other ways, "
        "too many or too few of them are obstacles.",
    )
