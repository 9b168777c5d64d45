"""Masks of tubes with known radii, lengths and angles."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from anatomy.airway_tree import AirwayTree
from anatomy.base.typed import Float
from anatomy.grid import Grid, Volume

Tube = tuple[ArrayLike, ArrayLike, float]
"""Both ends, LPS mm, and the radius."""

CARINA = (0.0, 0.0, 0.0)
Y: tuple[Tube, ...] = (
    ((0.0, 0.0, 80.0), CARINA, 8.0),
    (CARINA, (40.0, 0.0, -40.0), 6.0),
    (CARINA, (-25.0, 0.0, -40.0), 6.5),
)


def tubes(parts: Iterable[Tube], spacing_mm: ArrayLike = (1.0, 1.0, 1.0), margin_mm: float = 3.0) -> Volume:
    """Rasterise tubes with round ends: a voxel is lumen if its centre is."""
    parts = [(np.asarray(a, float), np.asarray(b, float), r) for a, b, r in parts]
    spacing = np.asarray(spacing_mm, float)
    low = np.min([np.minimum(a, b) - r for a, b, r in parts], axis=0) - margin_mm
    high = np.max([np.maximum(a, b) + r for a, b, r in parts], axis=0) + margin_mm
    grid = Grid.from_spacing(np.ceil((high - low) / spacing).astype(int), spacing, low)
    array = np.zeros(grid.shape, dtype=bool, order="F")
    for a, b, r in parts:
        start = np.maximum(np.floor((np.minimum(a, b) - r - low) / spacing).astype(int), 0)
        stop = np.minimum(np.ceil((np.maximum(a, b) + r - low) / spacing).astype(int) + 1, grid.shape)
        index = np.meshgrid(*[np.arange(s, e) for s, e in zip(start, stop, strict=True)], indexing="ij")
        centre = grid.lps(np.stack(index, axis=-1))
        window = tuple(slice(s, e) for s, e in zip(start, stop, strict=True))
        array[window] |= distance_to_segment(centre, a, b) <= r
    return Volume(grid=grid, array=array)


def distance_to_segment(points: Float, a: Float, b: Float) -> Float:
    """Distance of points `(..., 3)` to a segment."""
    along = b - a
    t = np.clip((points - a) @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - (a + t[..., None] * along), axis=-1))


def edit(volume: Volume, lps_low: Sequence[float], lps_high: Sequence[float], value: bool) -> Volume:
    """Set the voxels whose centres lie in a box."""
    array = volume.array.copy(order="F")
    index = np.stack(np.meshgrid(*[np.arange(n) for n in array.shape], indexing="ij"), axis=-1)
    lps = volume.grid.lps(index)
    array[((lps >= lps_low) & (lps <= lps_high)).all(axis=-1)] = value
    return Volume(grid=volume.grid, array=array)


def outside_mm(tree: AirwayTree, lumen: Volume, step_mm: float = 0.1) -> float:
    """Length of the centreline outside the lumen, from samples every `step_mm` or closer."""
    begin, end = tree.points_lps[tree.parent_point[1:]], tree.points_lps[1:]
    length = np.linalg.norm(end - begin, axis=1)
    count = int(np.ceil(length.max() / step_mm)) + 1
    t = (np.arange(count) + 0.5) / count
    ijk = np.floor(lumen.grid.ijk(begin[:, None] + t[:, None] * (end - begin)[:, None]) + 0.5).astype(int)
    valid = ((ijk >= 0) & (ijk < lumen.grid.shape)).all(axis=-1)
    ijk[~valid] = 0
    hit = lumen.array[ijk[..., 0], ijk[..., 1], ijk[..., 2]] & valid
    return float((~hit * (length / count)[:, None]).sum())
