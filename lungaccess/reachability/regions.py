"""Left and right lung of a patient, for figures by side."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from anatomy.grid import Grid, Volume
from anatomy.lung import Lung
from anatomy.records import frozen_record
from anatomy.structures import OBSTACLES
from anatomy.typed import Float, Mask

RIGHT, LEFT = 1, 2
NAMES: Mapping[int, str] = MappingProxyType({RIGHT: "right lung", LEFT: "left lung"})
SMALLER_LUNG_SHARE = 0.1
"""The smaller of two lungs holds at least this share of the larger one."""


@frozen_record
class Regions:
    """The region of each voxel of a grid: a key of `names`, or 0, in a volume of uint8.

    If `lungs_are_separate`, the two are parts of the mask without a bridge; else the plane through the carina
    divides them.
    """

    volume: Volume
    names: Mapping[int, str]
    lungs_are_separate: bool


def lung_regions(lung: Lung, grid: Grid, where: Mask) -> Regions:
    """Return the side of the voxels of a grid, any in the same place, that are true in `where`; 0 of others.

    The lungs are the two largest parts of the free tissue between which no face is shared; smaller parts
    belong to the side of the carina on which they lie.  The anatomy keeps no lobes: fissures are open
    here and there, so that lobes are not separate parts.
    """
    from scipy import ndimage

    parts, _count = ndimage.label((lung.labels & OBSTACLES) == 0)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    two = np.argsort(sizes)[::-1][:2]
    lungs_are_separate = len(two) == 2 and bool(sizes[two[1]] >= max(1.0, SMALLER_LUNG_SHARE * sizes[two[0]]))
    ijk = np.argwhere(where)
    points = grid.lps(ijk)
    # LPS: the patient's left is +x.
    codes = np.where(points[:, 0] > lung.tree.carina_lps[0], LEFT, RIGHT).astype(np.uint8)
    if lungs_are_separate:
        voxels = np.clip(np.floor(lung.grid.ijk(points) + 0.5).astype(int), 0, np.array(parts.shape) - 1)
        here = parts[tuple(voxels.T)]
        first, second = here == two[0], here == two[1]
        first_is_left = _mean_x(points[first]) > _mean_x(points[second])
        codes[first] = LEFT if first_is_left else RIGHT
        codes[second] = RIGHT if first_is_left else LEFT
    array = np.zeros(grid.shape, dtype=np.uint8, order="F")
    array[tuple(ijk.T)] = codes
    return Regions(volume=Volume(grid=grid, array=array), names=NAMES, lungs_are_separate=lungs_are_separate)


def _mean_x(points: Float) -> float:
    return float(points[:, 0].mean()) if len(points) else 0.0
