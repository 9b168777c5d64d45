"""Add to a skeleton what thinning has lost.

Thinning keeps a line only where it is one voxel wide when its end is met; a tube of even width can be
eaten from its end, and with it a whole branch.  So every voxel must be near the skeleton, or a path from
it to the skeleton is added.
"""

import numpy as np

from anatomy.base.typed import Bool, Int
from anatomy.tree.lumen import CONNECT_26, PreparedLumen, require_at_most

MOST_PATHS = 500
"""An airway has some hundred branches; more paths than that come from noise in the mask."""


def complete(skeleton: Int, prepared: PreparedLumen) -> Int:
    """Return the skeleton voxels `(M, 3)` with paths to all parts of the mask that they do not reach.

    Raises:
        AnatomyError: If more than `MOST_PATHS` parts are not reached.
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
    margin = np.ceil((float(distance.min()) + 2 * float(prepared.solid_depth_mm.max())) / spacing).astype(
        np.int64
    )
    while True:
        low = np.maximum(open_voxels.min(axis=0) - margin, 0)
        high = np.minimum(open_voxels.max(axis=0) + margin + 1, prepared.solid.shape)
        window = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        starts = skeleton[((skeleton >= low) & (skeleton < high)).all(axis=1)] - low
        depth_mm = prepared.solid_depth_mm[window]
        solid = prepared.solid[window]
        floor = float(spacing.min()) / 4
        cost = np.asarray(np.where(solid, 1.0 / np.maximum(depth_mm.astype(np.float64), floor) ** 2, -1.0))
        search = MCP_Geometric(cost, fully_connected=True, sampling=tuple(spacing))
        end = tuple((target - low).tolist())
        total, _ = search.find_costs([tuple(s) for s in starts.tolist()], [end])
        if np.isfinite(total[end]) or (np.array(cost.shape) == prepared.solid.shape).all():
            path: Int = np.array(search.traceback(end)[1:]) + low
            return path
        margin = margin * 2
