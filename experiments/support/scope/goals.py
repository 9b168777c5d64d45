"""Goals in the airways of a lung, and a lumen of the size that [Rosell2012] had."""

from __future__ import annotations

import numpy as np

from anatomy.grid import Grid, Volume
from anatomy.lung import Lung
from stages.scope.advisor.kernels.voxel_graph import widest_paths
from stages.scope.advisor.kinematics import ScopeModel
from stages.scope.advisor.lumen import Lumen, lumen_of_mask
from stages.scope.advisor.nf1 import Goal, goal_at, navigation_field

PAPER_VOXELS = 116_758
PAPER_SPACING_MM = (0.7, 0.7, 0.6)


def resampled(mask: Volume, spacing_mm: tuple[float, float, float]) -> Volume:
    """Return a mask on a grid of other voxels along the LPS axes: the value at the nearest voxel centre."""
    inside = mask.grid.lps(np.argwhere(mask.array))
    low, high = inside.min(axis=0) - 2.0, inside.max(axis=0) + 2.0
    grid = Grid.from_spacing(np.ceil((high - low) / spacing_mm), spacing_mm, low)
    centres = grid.lps(np.stack(np.meshgrid(*map(np.arange, grid.shape), indexing="ij"), axis=-1))
    ijk = np.floor(mask.grid.ijk(centres) + 0.5).astype(np.int64)
    within = ((ijk >= 0) & (ijk < mask.grid.shape)).all(axis=-1)
    array = np.zeros(grid.shape, dtype=bool)
    array[within] = mask.array[tuple(ijk[within].T)]
    return Volume(grid=grid, array=array)


def paper_sized(lung: Lung) -> Lumen:
    """Return a lumen with the paper's voxels: resampled, its trachea cut from above to the paper's count."""
    volume = resampled(lung.mask("lumen"), PAPER_SPACING_MM)
    above = np.cumsum(volume.array.sum(axis=(0, 1))[::-1])[::-1]
    kept = volume.array.copy()
    kept[:, :, int(np.argmin(np.abs(above[0] - above - PAPER_VOXELS))) :] = False
    return lumen_of_mask(Volume(grid=volume.grid, array=kept), lung.tree.carina_lps)


def ends(lung: Lung) -> list[int]:
    """Return the tree points where airways end."""
    return [int(lung.tree.branch_points(int(branch))[-1]) for branch in lung.tree.leaf_branches]


def end_goals(lumen: Lumen, lung: Lung) -> list[Goal]:
    """Return the ends of all airways as goals."""
    return [goal_at(lumen, lung.tree.points_lps[point]) for point in ends(lung)]


def goal_with_clearance(lumen: Lumen, lung: Lung, point: int, model: ScopeModel, spare_voxels: int) -> Goal:
    """Return the last voxel before an airway's end with so many voxels of clearance more than eq. 1 asks."""
    end = goal_at(lumen, lung.tree.points_lps[point])
    field = navigation_field(lumen, end.voxel, metric="voxels")
    start, _away = lumen.nearest_voxel(lung.tree.carina_lps)
    width = np.zeros(lumen.count, dtype=np.int64)
    widest_paths(lumen.neighbours, lumen.steps_to_wall.astype(np.int64), start, width)
    roomy = np.flatnonzero(width > model.link_mm / lumen.grid.spacing_mm.max() + spare_voxels)
    voxel = int(roomy[np.argmin(field.potential[roomy])])
    return goal_at(lumen, lumen.centres(voxel), 0.5 * float(lumen.grid.spacing_mm.min()))
