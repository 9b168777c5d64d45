"""Where the edge of the image cuts the lung off."""

from __future__ import annotations

import numpy as np

from anatomy.base.typed import Mask
from anatomy.grid import Grid


def truncation(lung: Mask, grid: Grid) -> tuple[str, ...]:
    """Warn of each face of the image that cuts the lung off."""
    names = (("right", "left"), ("front", "back"), ("lower end", "upper end"))
    found = []
    for axis in range(3):
        direction = grid.lps_from_ijk[:3, axis]
        along = int(np.argmax(np.abs(direction)))
        for end in (0, -1):
            face = lung[tuple(end if a == axis else slice(None) for a in range(3))]
            area_cm2 = np.count_nonzero(face) * grid.voxel_volume_mm3
            area_cm2 /= 100.0 * float(grid.spacing_mm[axis])
            if area_cm2 > 0:
                name = names[along][int((end == -1) == (direction[along] > 0))]
                found.append(f"The lung is cut off at the {name} of the image, over {area_cm2:.1f} cm2.")
    return tuple(found)
