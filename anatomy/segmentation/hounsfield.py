"""Whether air measures -1000 HU in an image, and the image as if it did."""

from __future__ import annotations

import numpy as np

from anatomy.grid import Volume
from anatomy.segmentation.closing import distance_mm
from anatomy.segmentation.coarse import CoarseCt
from anatomy.typed import Mask

AIR_HU = -1000.0
"""By definition of the scale."""
CORE_SHARE = 0.6
"""Of the greatest depth in the airway: so far from its wall nothing but air is measured."""
GREATEST_OFFSET_HU = 25.0
"""Scanners keep air within 10 HU, and scatter in the chest adds as much; more is another scale."""


def air_offset_hu(coarse: CoarseCt, airway: Mask) -> float:
    """Return by how much air in the airway differs from -1000 HU; 0 if it is as usual."""
    depth = distance_mm(np.asfortranarray(airway), coarse.spacing_mm)
    offset = float(np.median(coarse.hu[depth >= CORE_SHARE * depth.max()])) - AIR_HU
    return offset if abs(offset) > GREATEST_OFFSET_HU else 0.0


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
        f"Air measures {AIR_HU + offset_hu:.0f} HU in the trachea instead of {AIR_HU:.0f}: "
        f"{-offset_hu:+.0f} HU "
        "were added to every voxel. Vessels are told apart by their HU: if the scale is wrong in other ways, "
        "too many or too few of them are obstacles.",
    )
