"""Boxes of lattice values cut out of a patient's fields around a candidate."""

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Array, Float, Int
from anatomy.fields import corner_geometry, distance_corners
from anatomy.grid import Grid, Volume
from anatomy.kernels.field import UNITS_PER_MM
from anatomy.lung import Lung
from anatomy.structures import AIRWAY, BRANCH_SHIFT, LUMEN

BOX_VALUES = (100_000, 100_000, 40_000, 20_000, 100_000)
"""Most values of the boxes, in this order: clearance, spared, wall, lumen, map.  From a finer lattice every
second (third, ...) value is taken along the axes of the smallest spacing."""
CLEARANCE, SPARED, WALL, LUMEN_SHARE, MAP = range(5)
"""Places of the boxes in that order."""
FEWEST = 6
"""Fewest values along an axis: a cubic B-spline needs four, and the cells at the ends one more each."""
LUMEN_WIDTH_MM = 0.945
"""A ball of the radius within which that test looks has this spread along each axis."""


@frozen_record
class FieldBox:
    """Values `(V,)` on a lattice of a shape `(3,)`, the first index fastest.

    Value `(i, j, k)` lies where `lattice_from_lps`, `(3, 4)`, maps LPS mm to `i, j, k`.
    """

    values: Float
    shape: Int
    lattice_from_lps: Float


def clearance_box(lung: Lung, points: Float, margin_mm: float, *, with_fissures: bool) -> FieldBox:
    """Return the clearance in mm around points `(N, 3)` LPS mm."""
    field = lung.obstacle_field(with_fissures=with_fissures)
    low, high = _range(field.geometry, field.corners.shape, points, margin_mm)
    return _box(CLEARANCE, field.corners, field.geometry, low, high, 1.0 / UNITS_PER_MM)


def spared_box(lung: Lung, points: Float, margin_mm: float, *, bits: int, branch: int) -> FieldBox:
    """Return the clearance in mm from all but the airway of a branch; what lies outside does not count.

    Args:
        bits: Structures that are obstacles.
    """
    geometry = corner_geometry(lung.grid)
    low, high = _range(geometry, lung.labels.shape, points, margin_mm)
    labels = lung.labels[low[0] : high[0], low[1] : high[1], low[2] : high[2]]
    hit = labels & np.uint16(bits)
    spared = (hit == AIRWAY) & ((labels >> np.uint16(BRANCH_SHIFT)) == branch + 1)
    corners = distance_corners((hit != 0) & ~spared, lung.grid.spacing_mm)
    return _cut_box(SPARED, corners, geometry, low, 1.0 / UNITS_PER_MM)


def wall_box(lung: Lung, points: Float, margin_mm: float, *, with_fissures: bool, kept_mm: float) -> FieldBox:
    """Return how thick a tube may be around points: as the lumen is deep, or else clear of all but airway.

    Args:
        kept_mm: Margins kept beyond the tube's surface where it touches the wall.
    """
    fields = [lung.fields[name] for name in ("vessel", "pleura")]
    if with_fissures and lung.has_fissures:
        fields.append(lung.fields["fissure"])
    low, high = _range(fields[0].geometry, fields[0].corners.shape, points, margin_mm)
    cut = tuple(slice(*pair) for pair in zip(low, high, strict=True))
    clear = np.minimum.reduce([field.corners[cut] for field in fields]).astype(np.float64)
    corners = np.stack(np.meshgrid(*map(np.arange, low, high), indexing="ij"), axis=-1).reshape(-1, 3)
    depth = lung.lumen_depth.lower_bound_mm(lung.grid.lps(corners - 0.5)).reshape(clear.shape)
    return _cut_box(WALL, np.maximum(clear / UNITS_PER_MM - kept_mm, depth), fields[0].geometry, low, 1.0)


def lumen_box(lung: Lung, points: Float, margin_mm: float) -> FieldBox:
    """Return the share of lumen around each place, weighted as a bell of LUMEN_WIDTH_MM.

    Its gradient points to the centroid of the lumen nearby, as the wall's normal of the tubes' test does.
    """
    from scipy import ndimage

    centres = _centres(lung.grid)
    low, high = _range(centres, lung.grid.shape, points, margin_mm)
    labels = lung.labels[tuple(slice(*pair) for pair in zip(low, high, strict=True))]
    lumen = ((labels & np.uint16(LUMEN)) != 0).astype(np.float32)
    share = ndimage.gaussian_filter(
        lumen, LUMEN_WIDTH_MM / lung.grid.spacing_mm, mode="nearest", truncate=3.0
    )
    return _cut_box(LUMEN_SHARE, share, centres, low, 1.0)


def map_box(cost: Volume, points: Float, margin_mm: float) -> FieldBox:
    """Return the cost map around points; infinite costs count as the greatest finite one."""
    centres = _centres(cost.grid)
    low, high = _range(centres, cost.grid.shape, points, margin_mm)
    finite = np.isfinite(cost.array[low[0] : high[0], low[1] : high[1], low[2] : high[2]])
    part = cost.array[low[0] : high[0], low[1] : high[1], low[2] : high[2]]
    greatest = float(part[finite].max()) if finite.any() else 0.0
    return _cut_box(MAP, np.where(finite, part, greatest), centres, low, 1.0)


def _centres(grid: Grid) -> Float:
    """Return the map from LPS mm to voxel centres with the squared voxel sizes, as `corner_geometry`."""
    geometry = corner_geometry(grid).copy()
    geometry[:, 3] -= 0.5
    return geometry


def _range(geometry: Float, shape: tuple[int, ...], points: Float, margin_mm: float) -> tuple[Int, Int]:
    """Return the first index and the one behind the last of a lattice around points."""
    lattice = points @ geometry[:, :3].T + geometry[:, 3]
    margin = margin_mm / np.sqrt(geometry[:, 4])
    low = np.floor(lattice.min(axis=0) - margin).astype(np.int64)
    high = np.ceil(lattice.max(axis=0) + margin).astype(np.int64) + 1
    size = np.array(shape)
    return np.clip(low, 0, size - FEWEST), np.clip(high, FEWEST, size)


def _cut_box(kind: int, values: Array, geometry: Float, low: Int, unit: float) -> FieldBox:
    """Return the box of values that were cut out from index `low` on."""
    moved = geometry.copy()
    moved[:, 3] -= low
    return _box(kind, values, moved, np.zeros(3, dtype=np.int64), np.array(values.shape), unit)


def _box(kind: int, values: Array, geometry: Float, low: Int, high: Int, unit: float) -> FieldBox:
    """Return the values between two indices, thinned out until they are few enough."""
    stride, spacing = np.ones(3, dtype=np.int64), np.sqrt(geometry[:, 4])
    while np.prod((high - low + stride - 1) // stride) > BOX_VALUES[kind]:
        stride[np.argmin(stride * spacing)] += 1
    part = values[tuple(slice(*three) for three in zip(low, high, stride, strict=True))]
    lattice = geometry[:, :4].copy()
    lattice[:, 3] -= low
    return FieldBox(
        values=part.ravel(order="F").astype(np.float64) * unit,
        shape=np.array(part.shape),
        lattice_from_lps=lattice / stride[:, None],
    )
