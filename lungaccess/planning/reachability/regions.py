"""Lungs and lobes of a patient, for figures by region."""

from collections.abc import Iterator, Mapping
from types import MappingProxyType

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Mask, UInt8
from anatomy.grid import Grid, Volume
from anatomy.lobes import LOBES
from anatomy.lung import Lung
from anatomy.structures import OBSTACLES

RIGHT, LEFT = 1, 2
NAMES: Mapping[int, str] = MappingProxyType({RIGHT: "right lung", LEFT: "left lung"})


@frozen_record
class Regions:
    """The region of each voxel of a grid: a key of `names`, or 0, in a volume of uint8.

    If `lungs_are_separate`, the two are parts of the mask without a bridge; else the plane through the carina
    divides them.  `lobes` has the numbers of `anatomy.lobes.LOBES`; None if the patient came without lobes.
    `segments` has 1 for the first of `segment_names` and so on, by the nearest bronchus; 0 where it has none.
    """

    volume: Volume
    names: Mapping[int, str]
    lungs_are_separate: bool
    segments: Volume
    segment_names: tuple[str, ...]
    lobes: Volume | None = None

    def parts(self) -> Iterator[tuple[str, Mask]]:
        """Yield the name and the voxels of each lung, then of each lobe."""
        for code, name in self.names.items():
            yield name, self.volume.array == code
        if self.lobes is not None:
            for code, name in LOBES.items():
                yield name, self.lobes.array == code

    def segment_parts(self) -> Iterator[tuple[str, Mask]]:
        """Yield the name and the voxels of each segment that has a named bronchus."""
        for code, name in enumerate(self.segment_names, start=1):
            yield name, self.segments.array == code


def lung_regions(lung: Lung, grid: Grid, where: Mask) -> Regions:
    """Return the side of the voxels of a grid, any in the same place, that are true in `where`; 0 of others.

    The lungs are the two largest parts of the free tissue between which no face is shared; smaller parts
    belong to the side of the carina on which they lie.
    """
    from scipy import ndimage

    parts, _count = ndimage.label((lung.labels & OBSTACLES) == 0)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    two = np.argsort(sizes)[::-1][:2]
    # The smaller of two lungs holds at least this share of the larger one.
    lungs_are_separate = len(two) == 2 and bool(sizes[two[1]] >= max(1.0, 0.1 * sizes[two[0]]))
    ijk = np.argwhere(where)
    points = grid.lps(ijk)
    # LPS: the patient's left is +x.
    codes = np.where(points[:, 0] > lung.tree.carina_lps[0], LEFT, RIGHT).astype(np.uint8)
    voxels = tuple(np.clip(lung.grid.voxels(points), 0, np.array(parts.shape) - 1).T)
    if lungs_are_separate:
        here = parts[voxels]
        first, second = here == two[0], here == two[1]
        first_is_left = _mean_x(points[first]) > _mean_x(points[second])
        codes[first] = LEFT if first_is_left else RIGHT
        codes[second] = RIGHT if first_is_left else LEFT

    def on_grid(values: UInt8) -> Volume:
        array = np.zeros(grid.shape, dtype=np.uint8, order="F")
        array[tuple(ijk.T)] = values
        return Volume(grid=grid, array=array)

    segments = np.array(lung.tree.bronchi.segments)
    names = sorted({*segments.tolist()} - {""}, key=lambda name: (name[0], int(name[2:].partition("+")[0])))
    nearest = lung.tree.branch_of_point[lung.tree.nearest_point_index.query(points)[1]]
    of_branch = np.array([names.index(name) + 1 if name else 0 for name in segments], dtype=np.uint8)
    return Regions(
        volume=on_grid(codes),
        names=NAMES,
        lungs_are_separate=lungs_are_separate,
        lobes=None if lung.lobes is None else on_grid(lung.lobes.array[voxels]),
        segments=on_grid(of_branch[nearest]),
        segment_names=tuple(names),
    )


def _mean_x(points: Float) -> float:
    return float(points[:, 0].mean()) if len(points) else 0.0
