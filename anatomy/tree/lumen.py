"""Prepare a lumen mask for thinning: crop it, keep one piece, bridge short breaks, find cavities."""

import itertools

import numpy as np

from anatomy.airway_tree import GapBridged, PieceLeftOut, TreeReport
from anatomy.base.errors import AnatomyError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float, Float32, Int, Int32
from anatomy.grid import Grid, Volume
from anatomy.morphology import bounds, distance_mm, window
from anatomy.tree.bridge import Piece, join_pieces

CONNECT_26 = np.ones((3, 3, 3), dtype=bool)
MOST_NAMED = 20
"""Of the pieces that are left out the largest are described, so many at most: the others are a few voxels
each."""


@frozen_record
class PreparedLumen:
    """The lumen in its bounding box with an empty layer all around.

    Args:
        grid: Grid of the box.
        lumen (bool array): The largest piece and the pieces joined to it, as they are in the mask.
        solid (bool array): `lumen` with bridges across gaps and with its cavities filled: what is thinned.
        bridges (bool array): The voxels of the bridges.
        depth_mm (float32 array): Distance from the voxel centre to the nearest one outside `lumen`.
        solid_depth_mm (float32 array): The same for `solid`, so that a hole in the mask does not make the
            airway look narrow.
    """

    grid: Grid
    lumen: Bool
    solid: Bool
    bridges: Bool
    depth_mm: Float32
    solid_depth_mm: Float32
    report: TreeReport


def prepare_lumen(mask: Volume, max_gap_mm: float) -> PreparedLumen:
    """Crop a mask and keep its largest 26-connected piece with what belongs to it.

    Raises AnatomyError if the mask is empty, or falls into thousands of pieces.
    """
    from scipy import ndimage

    grid, box = _crop_to_content(mask)
    labels, count = ndimage.label(box, CONNECT_26)
    sizes = np.bincount(labels.ravel(order="K"), minlength=count + 1)
    main = int(np.argmax(sizes[1:])) + 1
    lumen = np.asarray(labels == main)
    bridges = np.zeros_like(lumen)
    gaps: list[GapBridged] = []
    left_out: tuple[PieceLeftOut, ...] = ()
    if count > 1:
        pieces = _pieces(labels, sizes, main, grid.spacing_mm)
        # A CT shows some hundred branches; every pair of pieces is looked at, which takes minutes for more.
        require_at_most(len(pieces), 2000, "separate pieces")
        for join in join_pieces(np.argwhere(lumen), pieces, grid.spacing_mm, max_gap_mm):
            lumen[tuple(join.voxels.T)] = True
            bridges[tuple(join.bridge.T)] = True
            gaps.append(
                GapBridged(
                    position_lps=grid.lps(join.middle_ijk),
                    length_mm=join.length_mm,
                    voxels_joined=len(join.voxels),
                )
            )
        apart = [piece for piece in pieces if not lumen[tuple(piece.voxels[0])]]
        left_out = _left_out(lumen, apart[:MOST_NAMED], grid)
    bridges &= ~box
    # Every hole that faces do not connect to the corner of the box is filled.
    solid = lumen | bridges
    outside, holes = ndimage.label(~solid)
    solid = solid if holes < 2 else np.asarray(outside != outside[0, 0, 0])
    cavity_voxels = int(solid.sum()) - int((lumen | bridges).sum())
    depth = distance_mm(lumen, grid.spacing_mm, bordered=True)
    return PreparedLumen(
        grid=grid,
        lumen=lumen,
        solid=solid,
        bridges=bridges,
        depth_mm=depth,
        solid_depth_mm=distance_mm(solid, grid.spacing_mm, bordered=True) if cavity_voxels else depth,
        report=TreeReport(
            gaps_bridged=tuple(gaps),
            pieces_left_out=left_out,
            components_dropped=count - 1 - len(gaps),
            voxels_dropped=int(sizes[1:].sum() - lumen.sum()),
            cavity_voxels=cavity_voxels,
        ),
    )


def _left_out(lumen: Bool, pieces: list[Piece], grid: Grid) -> tuple[PieceLeftOut, ...]:
    from scipy.spatial import KDTree

    if not pieces:
        return ()
    kept = np.argwhere(lumen)
    nearest = KDTree(kept * grid.spacing_mm)
    found = []
    for piece in pieces:
        distance, index = nearest.query(piece.voxels * grid.spacing_mm)
        at = int(np.argmin(distance))
        ends = np.stack([piece.voxels[at], kept[index[at]]])
        between_mm = np.maximum(np.abs(ends[0] - ends[1]) - 1, 0) * grid.spacing_mm
        found.append(
            PieceLeftOut(
                position_lps=grid.lps(ends.mean(axis=0)),
                length_mm=float(np.linalg.norm(between_mm)),
                middle_lps=grid.lps(piece.voxels.mean(axis=0)),
                voxels=len(piece.voxels),
            )
        )
    return tuple(found)


def _crop_to_content(mask: Volume) -> tuple[Grid, Bool]:
    """Return grid and array of the bounding box of a mask, with one empty layer all around."""
    array = np.asarray(mask.array != 0) if mask.array.dtype != bool else mask.array
    start, stop = bounds(array)
    if not stop.any():
        raise AnatomyError(
            "The airway mask is empty",
            expected="a mask of the airway lumen from the trachea to the bronchi",
            remedy="Check that the file and the label are those of the airway",
        )
    box = np.zeros(tuple(stop - start + 2), dtype=bool, order="F")
    box[1:-1, 1:-1, 1:-1] = array[window(start, stop)]
    return mask.grid.crop(start - 1, stop + 1), box


def _pieces(labels: Int32, sizes: Int, main: int, spacing_mm: Float) -> list[Piece]:
    """List the other pieces that are long enough to have a direction, largest first."""
    from scipy import ndimage

    boxes = ndimage.find_objects(labels)
    pieces = []
    for label in np.argsort(-sizes[1:], kind="stable") + 1:
        if label == main or sizes[label] < Piece.MIN_VOXELS:
            continue
        where = boxes[label - 1]
        voxels = np.argwhere(labels[where] == label) + [s.start for s in where]
        extent = (voxels.max(axis=0) - voxels.min(axis=0) + 1) * spacing_mm
        if float(np.linalg.norm(extent)) >= Piece.MIN_EXTENT_MM:
            pieces.append(Piece(voxels=voxels))
    return pieces


def require_at_most(count: int, most: int, what: str) -> None:
    """Raise AnatomyError if a mask has more of something than a tree of airways can have."""
    if count > most:
        raise AnatomyError(
            f"The airway mask is no tree of airways: it has {count} {what}",
            expected=f"at most {most}: a CT shows some hundred branches",
            remedy="Give the mask of the airway lumen alone; noise, or a leak into the lung, looks like this",
        )


def tunnels(voxels: Int) -> int:
    """Return how many tunnels run through voxels `(N, 3)` without cavities: 1 minus the Euler number."""
    # Of the complex at doubled resolution a cell has as many dimensions as odd coordinates.
    middle = 2 * (voxels - voxels.min(axis=0)) + 1
    sides = middle.max(axis=0) + 2
    euler = 0
    for offset_size, sign in enumerate((-1, 1, -1, 1)):
        offsets = [o for o in itertools.product((-1, 0, 1), repeat=3) if np.abs(o).sum() == offset_size]
        cells = (middle[:, None] + np.array(offsets)).reshape(-1, 3)
        euler += sign * len(np.unique(np.ravel_multi_index(tuple(cells.T), tuple(sides))))
    return 1 - euler


MOST_PATHS = 500
"""An airway has some hundred branches; more paths than that come from noise in the mask."""


def complete(skeleton: Int, prepared: PreparedLumen) -> Int:
    """Return the skeleton voxels `(M, 3)` with paths to all parts of the mask that they do not reach.

    Raises AnatomyError if more than `MOST_PATHS` parts are not reached.
    """
    from scipy import ndimage

    if len(skeleton) == 0:
        return skeleton
    solid = np.argwhere(prepared.solid.T)[:, ::-1]
    missed = solid[~_reached(solid, skeleton, prepared)]
    if len(missed) == 0:
        return skeleton
    low = missed.min(axis=0)
    marks = np.zeros(missed.max(axis=0) - low + 1, dtype=bool)
    marks[tuple((missed - low).T)] = True
    labels, count = ndimage.label(marks, CONNECT_26)
    label = labels[tuple((missed - low).T)]
    paths = 0
    for part in range(1, count + 1):
        open_voxels = missed[label == part]
        while len(open_voxels := open_voxels[~_reached(open_voxels, skeleton, prepared)]):
            paths += 1
            require_at_most(paths, MOST_PATHS, "bulges beyond its middle line")
            skeleton = np.concatenate((skeleton, _way_to_farthest(open_voxels, skeleton, prepared)))
    return skeleton[np.lexsort(skeleton.T[::-1])]


def _reached(voxels: Int, skeleton: Int, prepared: PreparedLumen) -> Bool:
    """Tell which voxels lie near a skeleton voxel, measured by the depth there."""
    from scipy.spatial import KDTree

    spacing = prepared.grid.spacing_mm
    tree = KDTree(skeleton * spacing)
    voxel = float(spacing.max())
    neighbours = np.array([len(n) for n in KDTree(skeleton).query_ball_point(skeleton, 1.8)]) - 1
    # A flattened airway is up to this many times as wide as its inscribed sphere.
    # At an end, a flat cap has its rim at 1.4 radii.
    radii = np.where(neighbours <= 1, 1.5, 2.0)
    # Roughness of the mask by so many voxels beyond the skeleton's spheres is no branch.
    limit = np.maximum(prepared.solid_depth_mm[tuple(skeleton.T)], voxel / 2) * radii + 2.0 * voxel
    reached = np.zeros(len(voxels), dtype=bool)
    for most in (4, 32, 256):
        todo = np.flatnonzero(~reached)
        if len(todo) == 0:
            break
        k = min(most, len(skeleton))
        distance, index = tree.query(voxels[todo] * spacing, k=k)
        reached[todo] = (distance.reshape(-1, k) <= limit[index.reshape(-1, k)]).any(axis=1)
    return reached


def _way_to_farthest(open_voxels: Int, skeleton: Int, prepared: PreparedLumen) -> Int:
    """Return the new voxels of the path along the middle from the skeleton to the farthest open voxel."""
    from scipy.spatial import KDTree
    from skimage.graph import MCP_Geometric

    spacing = prepared.grid.spacing_mm
    distance, _ = KDTree(skeleton * spacing).query(open_voxels * spacing)
    target = open_voxels[int(np.argmax(distance))]
    margin_mm = float(distance.min()) + 2 * float(prepared.solid_depth_mm.max())
    margin = np.ceil(margin_mm / spacing).astype(np.int64)
    while True:
        low = np.maximum(open_voxels.min(axis=0) - margin, 0)
        high = np.minimum(open_voxels.max(axis=0) + margin + 1, prepared.solid.shape)
        box = window(low, high)
        starts = skeleton[((skeleton >= low) & (skeleton < high)).all(axis=1)] - low
        depth_mm = prepared.solid_depth_mm[box]
        solid = prepared.solid[box]
        floor = float(spacing.min()) / 4
        cost = np.asarray(np.where(solid, 1.0 / np.maximum(depth_mm.astype(np.float64), floor) ** 2, -1.0))
        search = MCP_Geometric(cost, fully_connected=True, sampling=tuple(spacing))
        end = tuple((target - low).tolist())
        total, _ = search.find_costs([tuple(s) for s in starts.tolist()], [end])
        if np.isfinite(total[end]) or (np.array(cost.shape) == prepared.solid.shape).all():
            path: Int = np.array(search.traceback(end)[1:]) + low
            return path
        margin = margin * 2
