"""Which voxels a person means who paints in slices: a brush, a fill, a cut through a leak, a bridge."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Float32, Mask
from anatomy.grid import Grid
from anatomy.morphology import Window, bounds, pieces_of, window

LONGEST_GAP_MM = 40.0
"""A gap in an airway is shorter: what lies farther apart is joined by painting."""
AIR_HU, TISSUE_COST = -1000.0, 50.0
"""A bridge follows air: a voxel costs its HU above that of air, and at least so much for its length."""
HuAt = Callable[[Window], Float32]
"""Returns the CT in HU in a box of voxels of the patient."""


@frozen_record
class Stroke:
    """What was drawn.

    `paint` and `erase` act within a ball along the points, `fill` on what is connected to the first point and
    as dense, `cut` erases the ball and what then hangs on nothing, and `join` paints a bridge from the first
    to the last point along the air between them.

    Args:
        points_lps ((N, 3) float64): Along the stroke, LPS mm.
        radius_mm: Of the brush; of a fill how far it may reach.
        normal_lps ((3,) float64): Normal of the slice in which alone brush and fill act; None for all around.
        level_hu: By how much a filled voxel may differ from the first point.
    """

    tool: str
    points_lps: Float
    radius_mm: float
    normal_lps: Float | None = None
    level_hu: float = 150.0


def meant_voxels(stroke: Stroke, grid: Grid, structure: Mask, hu_at: HuAt) -> tuple[Window, Mask]:
    """Return the box of a stroke, and which voxels of it are painted or erased.

    Args:
        structure: The structure as it is now, on `grid`; of an airway its lumen with its wall.

    Raises:
        SettingsError: If a gap is too long to be joined, or the stroke lies outside the image.
    """
    points = np.asarray(stroke.points_lps, dtype=np.float64).reshape(-1, 3)
    if not grid.contains(points).all():
        raise SettingsError(
            "The stroke leaves the box of the masks",
            expected="points in or beside the lungs",
            remedy="Paint there",
        )
    if stroke.tool == "fill":
        return _filled(stroke, points[0], grid, hu_at)
    if stroke.tool == "join":
        points = _bridge(points[0], points[-1], grid, hu_at)
    box, brush = _brushed(points, stroke, grid)
    if stroke.tool == "erase":
        brush &= structure[box]
    if stroke.tool == "cut":
        return _cut(box, brush, structure)
    return box, brush


def _brushed(points: Float, stroke: Stroke, grid: Grid) -> tuple[Window, Mask]:
    """Return what a ball covers that is drawn along points, in its slice alone where one is stated."""
    box = grid.window(points, stroke.radius_mm)
    covered = np.zeros(tuple(axis.stop - axis.start for axis in box), dtype=np.bool_)
    first = np.array([axis.start for axis in box])
    for one, other in pairwise(points if len(points) > 1 else np.repeat(points, 2, axis=0)):
        near = grid.window(np.stack([one, other]), stroke.radius_mm)
        index = tuple(slice(axis.start - low, axis.stop - low) for axis, low in zip(near, first, strict=True))
        at = _centres(near, grid) - one
        along = other - one
        share = np.clip(at @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
        covered[index] |= np.linalg.norm(at - share[..., None] * along, axis=-1) <= stroke.radius_mm
    covered[tuple(np.clip(grid.voxels(points) - first, 0, np.array(covered.shape) - 1).T)] = True
    return box, covered & _in_slice(box, points[0], stroke, grid)


def _centres(box: Window, grid: Grid) -> Float:
    """Return the centres of the voxels of a box, `(i, j, k, 3)` LPS mm."""
    ijk = np.stack(np.meshgrid(*(np.arange(axis.start, axis.stop) for axis in box), indexing="ij"), axis=-1)
    return grid.lps(ijk.reshape(-1, 3)).reshape(ijk.shape)


def _in_slice(box: Window, point: Float, stroke: Stroke, grid: Grid) -> Mask:
    """Return which voxels of a box lie in the slice of a stroke, of the thickness of a voxel."""
    if stroke.normal_lps is None:
        return np.ones(tuple(axis.stop - axis.start for axis in box), dtype=np.bool_)
    normal = np.asarray(stroke.normal_lps) / np.linalg.norm(stroke.normal_lps)
    thick_mm = float(np.abs(normal @ (grid.lps_from_ijk[:3, :3])).max())
    depth = (_centres(box, grid) - point) @ normal
    return np.asarray((depth > -0.5 * thick_mm) & (depth <= 0.5 * thick_mm))


def _filled(stroke: Stroke, seed: Float, grid: Grid, hu_at: HuAt) -> tuple[Window, Mask]:
    """Return what is connected to a point, as dense as it, and no farther than a stroke allows."""
    from scipy.ndimage import label

    box, near = _brushed(seed[None], stroke, grid)
    hu = hu_at(box)
    at = tuple((grid.voxels(seed) - np.array([axis.start for axis in box])).tolist())
    parts, _count = label(near & (np.abs(hu - hu[at]) <= stroke.level_hu))
    return box, parts == parts[at] if parts[at] else np.zeros_like(near)


def _cut(box: Window, brush: Mask, structure: Mask) -> tuple[Window, Mask]:
    """Return the brush within a structure, and the parts that do not hang on its largest one without it."""
    from scipy.ndimage import label

    cut = np.zeros_like(structure)
    cut[box] = brush & structure[box]
    whole = window(*bounds(structure))
    cut, left = cut[whole], structure[whole]
    before = label(left)[0]
    left = left & ~cut
    parts, sizes = pieces_of(left)
    # What hung on nothing before is left alone: the cut has not freed it.
    freed = np.isin(before, np.unique(before[cut])) & left & (parts != np.argmax(sizes)) & (before > 0)
    return whole, cut | freed


def _bridge(start: Float, end: Float, grid: Grid, hu_at: HuAt) -> Float:
    """Return the way `(N, 3)` from one point to another that is shortest and most in air."""
    from skimage.graph import MCP_Geometric

    apart_mm = float(np.linalg.norm(end - start))
    if apart_mm > LONGEST_GAP_MM:
        raise SettingsError(
            f"The two ends lie {apart_mm:.0f} mm apart",
            expected=f"a gap of at most {LONGEST_GAP_MM:.0f} mm",
            remedy="Paint the airway between them",
        )
    # A bridge over a gap leaves the straight line by no more than this.
    box = grid.window(np.stack([start, end]), 12.0)
    first = np.array([axis.start for axis in box])
    cost = np.maximum(hu_at(box).astype(np.float64) - AIR_HU, 0.0) + TISSUE_COST
    one, other = (tuple((grid.voxels(point) - first).tolist()) for point in (start, end))
    way = MCP_Geometric(cost, sampling=tuple(grid.spacing_mm))
    way.find_costs([one], [other])
    steps = np.array(way.traceback(other))
    # Every second voxel is enough for a brush of a millimetre, and the ends stay.
    kept = np.unique(np.append(np.arange(0, len(steps), 2), len(steps) - 1))
    return grid.lps(steps[kept] + first)
