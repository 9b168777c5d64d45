"""Exact geometry of a mask whose voxels are solid boxes: depth of points, segments inside."""

import numpy as np

from anatomy.base.typed import Bool, Float, Int

TOUCH = 1e-6
"""Fraction of a voxel by which a segment must stay clear of every other voxel."""

_SIGNS = np.array(np.meshgrid((-1, 1), (-1, 1), (-1, 1))).reshape(3, 8).T * TOUCH


def inside(lumen: Bool, ijk: Float) -> Bool:
    """Tell which positions `(..., 3)` in voxel units lie in a voxel of `lumen`; outside the array is not."""
    voxel = np.floor(ijk + 0.5).astype(np.int64)
    valid = np.asarray(((voxel >= 0) & (voxel < lumen.shape)).all(axis=-1))
    voxel = np.where(valid[..., None], voxel, 0)
    return np.asarray(lumen[voxel[..., 0], voxel[..., 1], voxel[..., 2]] & valid)


def segments_inside(lumen: Bool, begin_ijk: Float, end_ijk: Float) -> Bool:
    """Tell which straight segments, `(M, 3)` to `(M, 3)` in voxel units, stay strictly inside `lumen`.

    Exact: every voxel that a segment meets, or comes closer to than `TOUCH`, is looked up.
    """
    if len(begin_ijk) == 0:
        return np.zeros(0, dtype=bool)
    step = end_ijk - begin_ijk
    low = np.floor(np.minimum(begin_ijk, end_ijk) + 0.5)
    most = int((np.floor(np.maximum(begin_ijk, end_ijk) + 0.5) - low).max())
    planes = low[:, :, None] + 0.5 + np.arange(most)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (planes - begin_ijk[:, :, None]) / step[:, :, None]
    t = np.clip(np.nan_to_num(t, nan=0.0, posinf=0.0, neginf=0.0), 0.0, 1.0).reshape(len(step), -1)
    t = np.sort(np.concatenate((np.broadcast_to(np.array([0.0, 1.0]), (len(step), 2)), t), axis=1), axis=1)
    t = np.concatenate((t, (t[:, 1:] + t[:, :-1]) / 2), axis=1)
    samples = begin_ijk[:, None] + t[:, :, None] * step[:, None]
    return np.asarray(inside(lumen, samples[:, :, None] + _SIGNS).all(axis=(1, 2)))


def _border_voxels(lumen: Bool) -> Int:
    """Return the voxels `(M, 3)` outside `lumen` that share a face with it.

    `lumen` must have an empty layer all around.  The nearest solid box outside the lumen is always
    among them, or as far as one of them: around an edge or corner where lumen and not-lumen meet,
    some pair of them meets by a face.
    """
    touched = np.zeros_like(lumen)
    touched[1:] |= lumen[:-1]
    touched[:-1] |= lumen[1:]
    touched[:, 1:] |= lumen[:, :-1]
    touched[:, :-1] |= lumen[:, 1:]
    touched[:, :, 1:] |= lumen[:, :, :-1]
    touched[:, :, :-1] |= lumen[:, :, 1:]
    touched &= ~lumen
    # The transposed scan is the memory order of a Fortran array.
    return np.argwhere(touched.T)[:, ::-1] if touched.flags.f_contiguous else np.argwhere(touched)


def exact_depth_mm(lumen: Bool, spacing_mm: Float, ijk: Float) -> Float:
    """Return the distance of `(N, 3)` (voxels) to boxes outside `lumen`, empty at its edges; 0 outside."""
    from scipy.spatial import KDTree

    boxes = _border_voxels(lumen) * spacing_mm
    tree = KDTree(boxes)
    points = ijk * spacing_mm
    half_diagonal = float(np.linalg.norm(spacing_mm)) / 2
    depth = np.zeros(len(points))
    todo = np.flatnonzero(inside(lumen, ijk))
    k = 8
    while len(todo):
        k = min(k, len(boxes))
        centre_distance, index = tree.query(points[todo], k=k)
        centre_distance, index = centre_distance.reshape(-1, k), index.reshape(-1, k)
        offset = np.abs(points[todo, None] - boxes[index]) - spacing_mm / 2
        depth[todo] = np.linalg.norm(np.maximum(offset, 0.0), axis=2).min(axis=1)
        # A box that was not looked at has its centre at least as far as the last one that was.
        sure = (depth[todo] <= centre_distance[:, -1] - half_diagonal) | (k == len(boxes))
        todo = todo[~sure]
        k *= 4
    return depth
