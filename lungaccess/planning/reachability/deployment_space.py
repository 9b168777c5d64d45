"""All deployments that a system may make in a lung, in boxes: what every proof of a target begins with."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import islice, product
from typing import Any

import numpy as np

from anatomy import poses as frames
from anatomy.airway_tree import AirwayTree
from anatomy.base.records import frozen_record
from anatomy.base.typed import Array, Float, Int, Int32, Mask
from anatomy.kernels.field import UNITS_PER_MM
from anatomy.lung import Lung
from lungaccess.planning.coupled.kernels.box_of_tubes import HALF, INNER, OUTER, ROTATION
from lungaccess.planning.reachability.kernels.blocked import ProofEnvironment, deep_enough
from lungaccess.planning.reachability.kernels.deployment_boxes import BOX_COLUMNS, EAST, NORTH, PLACE_X
from lungaccess.planning.reachability.kernels.unreachable import Pieces, divide
from lungaccess.planning.reachability.layers import THREADS
from stages.scope import MAX_OFF_AXIS_MM, MAX_TURN_AT_TIP_RAD
from stages.tube.kernels import CURVED_LENGTH

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
    middles = (voxels + 0.5 - depth.geometry[:, 3]) @ to_lps
    at = np.floor(middles @ geometry[:, :3].T + geometry[:, 3]).astype(np.int64)
    # Those that lie in a voxel of the lumen, next to one, or beyond the grid.
    beside = np.any((at < 0) | (at >= not_lumen.shape), axis=1)
    for step in product((-1, 0, 1), repeat=3):
        beside |= not_lumen[tuple(np.clip(at + step, 0, np.array(not_lumen.shape) - 1).T)] == 0
    voxels = voxels[beside]
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


TASK_BOXES = 2048
"""Boxes that a thread takes at a time."""


@frozen_record
class DeploymentSpace:
    """Boxes `(M, BOX_COLUMNS)` that hold all deployments of a system in a lung, with the piece of each.

    `measures` are mm^3 of places x rad^2 of directions x rad of rotations x mm^2 of insertions.
    """

    pieces: tuple[PlacePiece, ...]
    arrays: Pieces
    boxes: Float
    owners: Int32
    measures: Float
    looked: int


def divided_space(
    environment: ProofEnvironment,
    tubes: Float,
    insertions: Float,
    pieces: Sequence[PlacePiece],
    *,
    between: Callable[[], None] = lambda: None,
) -> DeploymentSpace:
    """Halve the boxes of all pieces, the largest first, and drop those that hold no deployment.

    The `passable` of the environment does not count; `between` is called now and then.
    """
    arrays = Pieces(
        frames=np.array([piece.frame for piece in pieces]).reshape(-1, 3, 3),
        cones=np.concatenate([np.zeros((0, 7)), *(piece.cones for piece in pieces)]),
        first_cone=np.concatenate([[0], np.cumsum([len(piece.cones) for piece in pieces])]).astype(np.int64),
    )
    boxes, owners = _first_boxes(tubes, float(insertions.max()), pieces)
    looked = 0
    greatest = np.inf if not len(boxes) else float(_measures(boxes).max())
    with ThreadPoolExecutor(THREADS) as pool:
        # Boxes into which the space is divided: 20 MB, and a second or two of work before the first target.
        while 0 < len(boxes) <= 150_000 // 2:
            between()
            greatest *= 0.5
            looked += int((_measures(boxes) > greatest).sum())

            def part(begin: int, greatest: float = greatest, boxes: Float = boxes, owners: Int32 = owners):  # type: ignore[no-untyped-def]
                some, own = boxes[begin : begin + TASK_BOXES], owners[begin : begin + TASK_BOXES]
                parts, part_owners = np.zeros((2 * len(some), BOX_COLUMNS)), np.zeros(2 * len(some), np.int32)
                kept = divide(environment, tubes, insertions, arrays, some, own, greatest, parts, part_owners)
                return parts[:kept], part_owners[:kept]

            found = list(pool.map(part, range(0, len(boxes), TASK_BOXES)))
            boxes = np.concatenate([parts for parts, _ in found])
            owners = np.concatenate([own for _, own in found])
    return DeploymentSpace(
        pieces=tuple(pieces),
        arrays=arrays,
        boxes=boxes,
        owners=owners,
        measures=_measures(boxes),
        looked=looked,
    )


def in_tasks(pool: ThreadPoolExecutor, work: Callable[[Int], Any], rows: Int, size: int) -> Iterator[Int]:
    """Do work on rows, so many a task, on the threads of a pool; yield those that are done, in order."""
    tasks = iter(range(0, len(rows), size))
    # Tasks after which it is looked whether to stop; the same number whatever the threads.
    while begins := list(islice(tasks, 8)):
        list(pool.map(lambda begin: work(rows[begin : begin + size]), begins))
        yield rows[begins[0] : begins[-1] + size]


def _first_boxes(tubes: Float, longest: float, pieces: Sequence[PlacePiece]) -> tuple[Float, Int32]:
    """Return boxes that hold everything of each piece, up to the curved length and beyond; and the pieces."""
    curved = min(float(tubes[CURVED_LENGTH]), longest)
    ranges = [each for each in ((0.0, curved), (curved, longest)) if each[1] > each[0]]
    boxes = np.zeros((len(pieces), len(ranges), BOX_COLUMNS))
    boxes[..., [OUTER, HALF + OUTER]] = 0.5 * longest
    boxes[..., HALF + ROTATION] = np.pi
    for part, (low, high) in enumerate(ranges):
        boxes[:, part, [INNER, HALF + INNER]] = 0.5 * (low + high), 0.5 * (high - low)
    for each, piece in zip(boxes, pieces, strict=True):
        each[:, [HALF + EAST, HALF + NORTH]] = piece.wide
        least, greatest = piece.places
        each[:, PLACE_X:HALF] = 0.5 * (least + greatest)
        each[:, HALF + PLACE_X :] = 0.5 * (greatest - least)
    return boxes.reshape(-1, BOX_COLUMNS), np.repeat(np.arange(len(pieces), dtype=np.int32), len(ranges))


def _measures(boxes: Float) -> Float:
    return np.asarray(np.prod(2.0 * boxes[:, HALF:], axis=1))
