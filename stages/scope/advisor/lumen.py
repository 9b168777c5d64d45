"""The interior voxels of the airways as a graph, and how wide the lumen is there."""

from dataclasses import field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from anatomy.base.errors import AnatomyError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int32, Labels
from anatomy.fields import DistanceField, corner_geometry, distance_field
from anatomy.grid import Grid, Volume, freeze_arrays, read_only
from anatomy.kernels.field import exact_at
from anatomy.lung import Lung
from anatomy.morphology import voxels_of
from anatomy.structures import OUTSIDE
from stages.scope.advisor.kernels.collision import FINE_DEPTH_MM
from stages.scope.advisor.kernels.voxel_graph import clearance_l1, widest_paths

DEPTH_UNITS_PER_MM = 256.0
"""Depths are compared as integers of 1/256 mm, the unit of the distance fields."""


@frozen_record
class Lumen:
    """The piece of the lumen that hangs together by voxel faces; N interior voxels.

    Make it with `lumen_of_lung` or `lumen_of_mask`.

    Args:
        grid: The box of the piece and one voxel more all around.
        index ((ni, nj, nk) int32): Number of each interior voxel, -1 elsewhere.
        voxels ((N, 3) int32): Their indices in `grid`, in raster order.
        neighbours ((N, 6) int32): The voxels before and after along i, j and k, -1 for the wall.
        depth: Distance to the nearest voxel that is not lumen, as a solid box.
        voxels_dropped: Lumen voxels that do not hang together with the piece.
    """

    grid: Grid
    index: Int32
    voxels: Int32
    neighbours: Int32
    depth: DistanceField
    voxels_dropped: int
    _widths: dict[int, Float] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        freeze_arrays(self, "index", "voxels", "neighbours")

    @property
    def count(self) -> int:
        """Number of interior voxels, N."""
        return len(self.voxels)

    @cached_property
    def geometry(self) -> Float:
        """The `(3, 6)` array that maps LPS mm to voxel corners, for kernels."""
        return corner_geometry(self.grid)

    @cached_property
    def solid(self) -> Labels:
        """What is not lumen, as OUTSIDE labels, `(ni, nj, nk)` uint16."""
        return read_only(np.asfortranarray(np.where(self.index < 0, OUTSIDE, 0).astype(np.uint16)))

    @cached_property
    def steps_to_wall(self) -> Float:
        """L1 distance of each voxel to the wall in voxels, `(N,)` [Rosell2012, sec. IV-A]."""
        return self.clearance(np.ones(3))

    def clearance(self, steps: ArrayLike) -> Float:
        """Return the L1 distance `(N,)` to the wall, a step along each axis counting `steps` (3,)."""
        out = np.zeros(self.count)
        clearance_l1(self.neighbours, np.array(steps, dtype=np.float64), out)
        return read_only(out)

    def centres(self, numbers: ArrayLike | None = None) -> Float:
        """Return the centres of voxels by their numbers, of all by default, `(M, 3)` LPS mm."""
        return self.grid.lps(self.voxels if numbers is None else self.voxels[np.asarray(numbers)])

    @cached_property
    def depth_mm(self) -> Float:
        """Distance of voxel centres to the wall, `(N,)` mm: exact in narrow places, else a lower bound."""
        centres = np.ascontiguousarray(self.centres())
        out = self.depth.lower_bound_mm(centres)
        narrow = np.flatnonzero(out < FINE_DEPTH_MM)
        exact = np.zeros(len(narrow))
        cap = FINE_DEPTH_MM + float(np.linalg.norm(self.grid.spacing_mm))
        exact_at(self.solid, self.geometry, centres[narrow], OUTSIDE, -1, cap, exact)
        out[narrow] = exact
        return read_only(out)

    def width_from(self, start: int) -> Float:
        """Return the radius (N,) mm, to half a voxel, of the largest ball that gets from `start` to each."""
        if start not in self._widths:
            depth = (self.depth_mm * DEPTH_UNITS_PER_MM).astype(np.int64)
            out = np.zeros(self.count, dtype=np.int64)
            widest_paths(self.neighbours, depth, start, out)
            self._widths[start] = read_only(out / DEPTH_UNITS_PER_MM)
        return self._widths[start]

    def voxel_at(self, point_lps: ArrayLike) -> int:
        """Return the number of the voxel that holds a point `(3,)` LPS mm, -1 if it is no interior one."""
        ijk = np.floor(self.grid.ijk(point_lps) + 0.5).astype(np.int64)
        if (ijk < 0).any() or (ijk >= self.grid.shape).any():
            return -1
        return int(self.index[tuple(ijk)])

    def nearest_voxel(self, point_lps: ArrayLike) -> tuple[int, float]:
        """Return the voxel whose centre is nearest to a point (the first on ties), and the distance in mm."""
        away = np.linalg.norm(self.centres() - np.asarray(point_lps, dtype=np.float64), axis=1)
        nearest = int(np.argmin(away))
        return nearest, float(away[nearest])


def lumen_of_lung(lung: Lung) -> Lumen:
    """Return the lumen that hangs together with the root of a lung's airway tree.

    Raises AnatomyError if the lung has no lumen.
    """
    return _lumen(lung.mask("lumen"), lung.tree.points_lps[0], lung.lumen_depth)


def lumen_of_mask(mask: Volume, root_lps: ArrayLike) -> Lumen:
    """Return the piece of a bool mask nearest to a point `(3,)` LPS mm.

    Raises AnatomyError if the mask is empty.
    """
    return _lumen(mask, root_lps, None)


def _lumen(mask: Volume, root_lps: ArrayLike, depth: DistanceField | None) -> Lumen:
    voxels = voxels_of(mask.array)
    if not len(voxels):
        raise AnatomyError(
            "The airway lumen is empty",
            expected="at least one voxel of lumen",
            remedy="Check the mask of the airway lumen",
        )
    low = voxels.min(axis=0) - 1
    grid = mask.grid.crop(low, voxels.max(axis=0) + 2)
    inside = np.zeros(grid.shape, dtype=bool)
    inside[tuple((voxels - low).T)] = True
    away = np.linalg.norm(mask.grid.lps(voxels) - np.asarray(root_lps, dtype=np.float64), axis=1)
    pieces, _count = ndimage.label(inside)
    seed = voxels[int(np.argmin(away))] - low
    numbered = np.ascontiguousarray(np.argwhere(pieces == pieces[tuple(seed)]), dtype=np.int32)
    index = np.full(grid.shape, -1, dtype=np.int32)
    index[tuple(numbered.T)] = np.arange(len(numbered))
    steps = np.repeat(np.eye(3, dtype=np.int32), 2, axis=0) * np.array([[-1], [1]] * 3, dtype=np.int32)
    neighbours = np.stack([index[tuple((numbered + step).T)] for step in steps], axis=1)
    if depth is None:
        depth = distance_field("lumen_depth", index < 0, grid)
    return Lumen(
        grid=grid,
        index=index,
        voxels=numbered,
        neighbours=neighbours,
        depth=depth,
        voxels_dropped=len(voxels) - len(numbered),
    )
