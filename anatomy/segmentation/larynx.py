"""Where the airway narrows to the larynx: the trachea is cut below, so that a scope can enter it."""

from __future__ import annotations

import numpy as np

from anatomy.base.typed import Int, Mask
from anatomy.grid import Grid

NARROW_SHARE = 0.6
"""Of the cross-section of the trachea; what is narrower at its upper end is larynx or a partial slice."""
TRACHEA_MM = 20.0
"""The cross-section is the median over this length above and below the seed."""


def without_larynx(lumen: Mask, seed_ijk: Int, grid: Grid) -> tuple[Mask, float]:
    """Cut the upper end of the airway off, as far as it is narrower than the trachea.

    Vocal cords that are closed while the breath is held taper the airway to a point, which
    would be too narrow for any scope, although a scope passes them in fact.

    Parameters
    ----------
    lumen : (ni, nj, nk) bool
    seed_ijk : (3,) int64
        A voxel in the trachea.
    grid : Grid

    Returns
    -------
    lumen : (ni, nj, nk) bool
        One flat end at the top; the same array if nothing was narrow.
    length_mm : float
        How much was cut off.
    """
    axis = int(np.argmax(np.abs(grid.lps_from_ijk[2, :3]) / grid.spacing_mm))
    up = 1 if grid.lps_from_ijk[2, axis] > 0 else -1
    areas = np.count_nonzero(lumen, axis=tuple(a for a in range(3) if a != axis))[::up]
    seed = int(seed_ijk[axis]) if up == 1 else len(areas) - 1 - int(seed_ijk[axis])
    reach = max(1, round(TRACHEA_MM / float(grid.spacing_mm[axis])))
    around = areas[max(seed - reach, 0) : seed + reach + 1]
    least = NARROW_SHARE * float(np.median(around[around > 0])) if around.any() else 0.0
    top = int(np.flatnonzero(areas)[-1]) if areas.any() else 0
    wide = np.flatnonzero(areas[seed : top + 1] >= least)
    if not wide.size or seed + int(wide[-1]) == top:
        return lumen, 0.0
    first = seed + int(wide[-1]) + 1
    cut = np.array(lumen, order="F")
    removed = [slice(None)] * 3
    removed[axis] = slice(first, None) if up == 1 else slice(0, len(areas) - first)
    cut[tuple(removed)] = False
    return cut, float((top + 1 - first) * grid.spacing_mm[axis])
