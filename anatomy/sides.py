"""Left and right lung: where the two touch, a septum keeps a needle from crossing over.

A filled lung mask often joins the lungs along the anterior and posterior junction lines, where four
layers of pleura lie together.  A path through it would leave one lung and enter the other.
"""

import numpy as np

from anatomy.base.typed import Array, Float, Int32, Mask
from anatomy.grid import Grid
from anatomy.morphology import at_label_borders, distance_mm, pieces_of


def coarse_sides(tissue: Mask, grid: Grid) -> tuple[Int32, tuple[int, ...]] | None:
    """Return the lung, 1, 2 or 0 for none, of coarse voxels, and their size; None if not told apart."""
    # The lungs are told apart on voxels of about this side: fast, and finer than any gap that matters.
    step = tuple(max(1, round(2.4 / float(s))) for s in grid.spacing_mm)
    sides = grow_sides(~_pooled(~tissue, step), _pooled(tissue, step), grid.lps_from_ijk[:3, :3] * step)
    return None if sides is None else (sides, step)


def points_of_sides(sides: Int32, step: tuple[int, ...], grid: Grid) -> tuple[Float, Float]:
    """Return the middles of coarse voxels of the left and the right lung, LPS mm, each `(N, 3)`."""
    size = np.array(step)
    one, other = (grid.lps(np.argwhere(sides == side) * size + (size - 1) / 2) for side in (1, 2))
    return (one, other) if one[:, 0].mean() > other[:, 0].mean() else (other, one)


def _pooled(mask: Mask, step: tuple[int, ...]) -> Mask:
    """Unite blocks of `step` voxels: a coarse voxel is True if any voxel in it is."""
    pooled = np.zeros(tuple(-(-n // s) for n, s in zip(mask.shape, step, strict=True)), dtype=bool, order="F")
    for offset in np.ndindex(*step):
        part = mask[tuple(slice(first, None, s) for first, s in zip(offset, step, strict=True))]
        pooled[tuple(slice(0, n) for n in part.shape)] |= part
    return pooled


def grow_sides(core: Mask, tissue: Mask, axes: Float) -> Int32 | None:
    """Label the lungs 1 and 2 over `tissue`, told apart by `core`; `axes` has voxel axes in LPS mm."""
    from skimage.segmentation import watershed

    depth = distance_mm(core, np.linalg.norm(axes, axis=0), bordered=True)
    # What erosion leaves of the smaller lung is at least this share of all tissue, else it is a crumb.
    least = 0.01 * float(np.count_nonzero(core))
    # Erosions that are tried in turn: none if the lungs do not touch, up to the width of a broad bridge.
    for neck in (0.0, 2.0, 4.0, 7.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0):
        markers = _two_largest(depth > neck / 2, axes, least)
        if markers is not None:
            return np.asarray(watershed(-depth, markers, mask=tissue), dtype=np.int32)
    return None


def _two_largest(mask: Mask, axes: Float, least: float) -> Int32 | None:
    """Label the two largest parts, of `least` voxels and a lung's size, 1 and 2 if they lie side by side."""
    from scipy import ndimage

    parts, sizes = pieces_of(mask)
    if len(sizes) < 3:
        return None
    order = np.argsort(sizes)[::-1]
    # The smaller of two lungs holds at least this share of the larger one.
    if sizes[order[1]] < max(0.1 * sizes[order[0]], least):
        return None
    centres = np.array(ndimage.center_of_mass(mask, parts, order[:2]))
    apart = np.abs(axes @ (centres[0] - centres[1]))
    if apart[0] < max(apart[1], apart[2]):
        return None
    markers = np.zeros(mask.shape, dtype=np.int32)
    markers[parts == order[0]] = 1
    markers[parts == order[1]] = 2
    return markers


def border_of(sides: Int32, step: tuple[int, ...], tissue: Mask) -> Mask:
    """Return voxels of `tissue` with a face neighbour on the other side, `(ni, nj, nk)`; `coarse_sides`."""
    border = np.zeros(tissue.shape, dtype=bool, order="F")
    meeting = np.argwhere(at_label_borders(sides))
    if not len(meeting):
        return border
    low = np.maximum(meeting.min(axis=0) - 1, 0)
    high = np.minimum(meeting.max(axis=0) + 2, sides.shape)
    near: Array = sides[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
    for axis, n in enumerate(step):
        near = np.repeat(near, n, axis=axis)
    start = low * step
    stop = np.minimum(start + near.shape, tissue.shape)
    window = tuple(slice(a, b) for a, b in zip(start, stop, strict=True))
    near = near[tuple(slice(0, b - a) for a, b in zip(start, stop, strict=True))]
    border[window] = at_label_borders(near * tissue[window])
    return border
