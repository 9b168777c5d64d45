"""Where the tip of the scope may be, piece by piece of the airway, and the directions that it may have."""

from itertools import product

import numpy as np

from anatomy import poses as frames
from anatomy.airway_tree import AirwayTree
from anatomy.base.records import frozen_record
from anatomy.base.typed import Array, Float, Int, Mask
from anatomy.kernels.field import UNITS_PER_MM
from anatomy.lung import Lung
from lungaccess.planning.reachability.kernels.blocked import deep_enough
from stages.scope import MAX_OFF_AXIS_MM, MAX_TURN_AT_TIP_RAD

PARTS = 3
"""A voxel has so many parts to a side, so that narrow airways hold few places besides those of tips."""
POINTS_A_PIECE = 11
"""A piece of 8 mm turns so little that one cone holds the directions of its tips."""
NOWHERE = -4.0
"""An angle (rad) so far below 0 that no direction of any box lies within it."""
SPARE_RAD = 1e-6
"""More than the rounding of any angle here, so that no direction is lost by it."""


@frozen_record
class PlacePiece:
    """The places of the scope tips to which N tree points in a row are the nearest.

    `cones` `(N, 7)` hold each point, LPS mm, the middle of the directions that tips nearest to it may have,
    and the greatest angle from it in rad; further rows are of points that belong to other pieces, and have
    the angle NOWHERE.  The rows of `frame` `(3, 3)` are the axes of a frame whose +z is the mean of these
    directions; `places` `(2, 3)` are the least and greatest coordinates of places along them, mm; `wide`
    is the greatest angle in rad between that +z and a direction.
    """

    cones: Float
    frame: Float
    places: Float
    wide: float


def places_of_tips(lung: Lung, not_lumen: Array, least_depth_mm: float) -> tuple[Mask, Float]:
    """Return where the tip of a scope may be: on the way from the trachea, in a lumen so deep.

    Args:
        not_lumen ((ni, nj, nk) uint8): 1 outside the lumen, on the lung's grid.

    Returns:
        - mask (bool, on the lattice of the lumen's depth) - Which voxels may hold a tip.
        - centres ((C, 3) float64, LPS mm) - Of the parts of these voxels, PARTS to a side, that may hold one.
    """
    from scipy import ndimage

    depth, half_mm = lung.lumen_depth, 0.5 * float(np.linalg.norm(lung.grid.spacing_mm))
    greatest = ndimage.maximum_filter(depth.corners, size=2, origin=-1)[:-1, :-1, :-1]
    voxels = np.argwhere((greatest + 1) / UNITS_PER_MM + half_mm >= least_depth_mm)
    to_lps = np.linalg.inv(depth.geometry[:, :3]).T
    geometry = lung.obstacle_field(with_fissures=False).geometry
    # Of a narrow scope that would be all of the lattice.
    voxels = voxels[_beside_lumen((voxels + 0.5 - depth.geometry[:, 3]) @ to_lps, not_lumen, geometry)]
    part = (np.arange(PARTS) + 0.5) / PARTS
    parts = np.stack(np.meshgrid(part, part, part, indexing="ij"), axis=-1).reshape(-1, 3)
    centres = (voxels[:, None] + parts - depth.geometry[:, 3]) @ to_lps
    hold = np.zeros(centres.shape[:2], dtype=bool)
    least = least_depth_mm - half_mm / PARTS
    deep_enough(depth.corners, depth.geometry, not_lumen, geometry, centres, least, hold)
    mask: Mask = np.zeros(greatest.shape, dtype=bool, order="F")
    mask[tuple(voxels[hold.any(axis=1)].T)] = True
    regions, _ = ndimage.label(mask, np.ones((3, 3, 3)))
    trachea = lung.tree.points_lps[lung.tree.branch_of_point == 0]
    at = np.floor(trachea @ depth.geometry[:, :3].T + depth.geometry[:, 3]).astype(np.int64)
    inside = ((at >= 0) & (at < regions.shape)).all(axis=1)
    entered = np.unique(regions[tuple(at[inside].T)])
    mask &= np.isin(regions, entered[entered > 0])
    return mask, np.asarray(centres[hold & mask[tuple(voxels.T)][:, None]])


def _beside_lumen(points: Float, not_lumen: Array, geometry: Float) -> Mask:
    """Tell which points `(N, 3)` lie in a voxel of the lumen, next to one, or beyond the grid."""
    at = np.floor(points @ geometry[:, :3].T + geometry[:, 3]).astype(np.int64)
    beside: Mask = np.any((at < 0) | (at >= not_lumen.shape), axis=1)
    last = np.array(not_lumen.shape) - 1
    for step in product((-1, 0, 1), repeat=3):
        beside |= not_lumen[tuple(np.clip(at + step, 0, last).T)] == 0
    return beside


def place_pieces(lung: Lung, centres: Float, leaving: Mask, reach_mm: float) -> list[PlacePiece]:
    """Return the pieces from which an exit is within reach; `centres` are those of `places_of_tips`."""
    from scipy.spatial import cKDTree

    exits = np.argwhere(leaving)
    if not len(exits) or not len(centres):
        return []
    tree = lung.tree
    voxel_mm = 0.5 * float(np.linalg.norm(lung.grid.spacing_mm))
    half_mm = voxel_mm / PARTS
    # An exit lies in a voxel whose centre may be half a diagonal away; a tip, in a part of a voxel.
    exit_mm, _ = cKDTree(lung.grid.lps(exits)).query(tree.points_lps)
    near = exit_mm <= reach_mm + voxel_mm + MAX_OFF_AXIS_MM
    nearest_mm, _ = tree.nearest_point_index.query(centres)
    around = cKDTree(centres).query_ball_point(tree.points_lps, MAX_OFF_AXIS_MM + half_mm)
    around = [np.array(found, dtype=np.int64) for found in around]
    own = [
        found[np.linalg.norm(centres[found] - point, axis=1) <= nearest_mm[found] + 2.0 * half_mm]
        for found, point in zip(around, tree.points_lps, strict=True)
    ]
    pieces = []
    for begin, end in zip(tree.branch_start[:-1], tree.branch_start[1:], strict=True):
        for first in range(int(begin), int(end), POINTS_A_PIECE):
            points = np.arange(first, min(first + POINTS_A_PIECE, int(end)))
            points = np.array([p for p in points[near[points]] if len(own[p])], dtype=np.int64)
            if len(points):
                held = np.concatenate([own[p] for p in points])
                pieces.append(_piece(tree, points, centres[held], half_mm))
    return pieces


def _piece(tree: AirwayTree, points: Int, centres: Float, half_mm: float) -> PlacePiece:
    from scipy.spatial import cKDTree

    turns = np.full((len(points), 1), MAX_TURN_AT_TIP_RAD + SPARE_RAD)
    own = np.hstack([tree.points_lps[points], tree.tangents[points], turns])
    axis = own[:, 3:6].sum(axis=0)
    axis = axis / np.linalg.norm(axis)
    frame = frames.pose(own[0, :3], axis)[:3, :3].T
    seen = centres @ frame.T
    from_axis = np.arccos(np.clip(own[:, 3:6] @ axis, -1.0, 1.0))
    others = np.flatnonzero(cKDTree(own[:, :3]).query(tree.points_lps)[0] <= 2.0 * MAX_OFF_AXIS_MM)
    others = np.setdiff1d(others, points)
    aside = np.hstack([tree.points_lps[others], tree.tangents[others], np.full((len(others), 1), NOWHERE)])
    return PlacePiece(
        cones=np.concatenate([own, aside]),
        frame=np.ascontiguousarray(frame),
        places=np.stack([seen.min(axis=0) - half_mm, seen.max(axis=0) + half_mm]),
        wide=float((from_axis + own[:, 6]).max()) + SPARE_RAD,
    )
