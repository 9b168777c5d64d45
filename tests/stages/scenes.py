"""Lungs made by hand, voxel by voxel, and distances to their voxels without any of the kernels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from anatomy.airway_tree import AirwayTree
from anatomy.fields import DistanceField, corner_geometry, distance_corners
from anatomy.grid import Grid, Volume
from anatomy.lung import Lung
from anatomy.structures import AIRWAY, BRANCH_SHIFT, FIELD_BITS, FISSURE, LUMEN, OUTSIDE


@dataclass
class Canvas:
    """A label volume to draw on, and the position of every voxel centre."""

    grid: Grid
    labels: np.ndarray
    points: np.ndarray

    @classmethod
    def empty(cls, low: Any, high: Any, spacing_mm: Any) -> Canvas:
        """Return free lung tissue whose outer faces lie at `low` and about at `high`, LPS mm."""
        spacing = np.broadcast_to(np.asarray(spacing_mm, dtype=float), 3)
        shape = tuple(int(n) for n in np.rint((np.asarray(high) - np.asarray(low)) / spacing))
        grid = Grid.from_spacing(shape, spacing, np.asarray(low) + 0.5 * spacing)
        points = grid.lps(np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1))
        return cls(grid, np.zeros(shape, dtype=np.uint16, order="F"), points)

    def add(self, where: np.ndarray, bits: int) -> None:
        """Set bits."""
        self.labels[where] |= bits

    def airway(self, lumen: np.ndarray, wall: np.ndarray, branch: int) -> None:
        """Draw an airway with its wall; what lay there before goes."""
        code = AIRWAY | ((branch + 1) << BRANCH_SHIFT)
        self.labels[wall & ((self.labels & LUMEN) == 0)] = code
        self.labels[lumen] = code | LUMEN

    def ball(self, centre: Any, radius_mm: float) -> np.ndarray:
        """Tell which voxel centres lie in a ball."""
        return np.linalg.norm(self.points - np.asarray(centre), axis=-1) <= radius_mm

    def capsule(self, a: Any, b: Any, radius_mm: float) -> np.ndarray:
        """Tell which voxel centres lie within `radius_mm` of a segment."""
        a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
        t = np.clip(((self.points - a) @ (b - a)) / ((b - a) @ (b - a)), 0.0, 1.0)
        return np.linalg.norm(self.points - a - t[..., None] * (b - a), axis=-1) <= radius_mm

    def lung(self, tree: AirwayTree | None = None, **more: Any) -> Lung:
        """Make a `Lung` of what was drawn."""
        return lung_of(self.labels, self.grid, tree or line_tree([0, 0, 0], [0, 0, -1], 1.0), **more)


def lung_of(labels: np.ndarray, grid: Grid, tree: AirwayTree, **more: Any) -> Lung:
    """Make a `Lung` of a label volume; its outermost voxels become OUTSIDE, as in every lung."""
    labels = np.array(labels, dtype=np.uint16, order="F")
    inner = labels[1:-1, 1:-1, 1:-1].copy()
    labels[:] = OUTSIDE
    labels[1:-1, 1:-1, 1:-1] = inner
    has_fissures = bool((labels & FISSURE).any())
    fields = {
        name: _field(name, (labels & bits) != 0, grid)
        for name, bits in FIELD_BITS.items()
        if has_fissures or "fissure" not in name
    }
    values: dict[str, Any] = {
        "name": "scene", "kind": "scene", "key": "scene", "nodules": None, "cost": None, "starts": (),
        "targets_lps": (), "breath_hold": None, "sources": {}, "warnings": (),
    }  # fmt: skip
    return Lung(
        grid=grid,
        labels=labels,
        fields=fields,
        lumen_depth=_field("lumen_depth", (labels & LUMEN) == 0, grid),
        tree=tree,
        **{**values, **more},
    )


def _field(name: str, mask: np.ndarray, grid: Grid) -> DistanceField:
    corners = _corners(mask.tobytes(order="F"), mask.shape, tuple(grid.spacing_mm))
    return DistanceField(name=name, corners=corners, geometry=corner_geometry(grid))


@lru_cache(maxsize=64)
def _corners(mask: bytes, shape: tuple[int, ...], spacing_mm: tuple[float, ...]) -> np.ndarray:
    """Return the distances of a mask: many tests draw the same scene, and several structures are the same."""
    return distance_corners(np.frombuffer(mask, dtype=bool).reshape(shape, order="F"), spacing_mm)


def line_tree(a: Any, b: Any, radius_mm: float, step_mm: float = 0.5) -> AirwayTree:
    """Return a tree of one straight branch."""
    return forked_tree([(a, b, radius_mm, -1)], step_mm)


def forked_tree(lines: list[tuple[Any, Any, float, int]], step_mm: float = 0.5) -> AirwayTree:
    """Return a tree of straight branches (from, to, radius, parent branch), each from its parent's end."""
    points: list[np.ndarray] = []
    tangents, parents, branches, radii, start = [], [], [], [], [0]
    generation: list[int] = []
    for branch, (a, b, radius, parent) in enumerate(lines):
        begin, way = np.asarray(a, dtype=float), np.asarray(b, dtype=float) - np.asarray(a, dtype=float)
        count = max(1, round(float(np.linalg.norm(way)) / step_mm))
        share = np.arange(0 if parent < 0 else 1, count + 1) / count
        points.append(begin + share[:, None] * way)
        parents += [-1 if parent < 0 else start[parent + 1] - 1]
        parents += list(range(start[-1], start[-1] + len(share) - 1))
        branches += [branch] * len(share)
        tangents.append(np.tile(way / np.linalg.norm(way), (len(share), 1)))
        radii += [radius] * len(share)
        start.append(start[-1] + len(share))
        generation.append(0 if parent < 0 else generation[parent] + 1)
    place = np.concatenate(points)
    distance = np.zeros(len(place))
    for n, parent in enumerate(parents):
        if parent >= 0:
            distance[n] = distance[parent] + np.linalg.norm(place[n] - place[parent])
    return AirwayTree(
        points_lps=place,
        radius_mm=np.array(radii),
        parent_point=np.array(parents),
        branch_of_point=np.array(branches),
        branch_start=np.array(start),
        branch_parent=np.array([line[3] for line in lines]),
        generation=np.array(generation),
        distance_from_root_mm=distance,
        tangents=np.concatenate(tangents),
    )


def brute_clearance(
    labels: np.ndarray, grid: Grid, points: np.ndarray, bits: int, cap_mm: float, exempt_branch: int = -1
) -> np.ndarray:
    """Return the distances `(N,)` to the nearest solid voxel box with any of `bits`, at most `cap_mm`.

    Voxels of `exempt_branch` that are airway alone (of the structures in `bits`) are passed over.  Beyond
    the grid all is OUTSIDE.
    """
    if not len(points):
        return np.zeros(0)
    spacing = grid.spacing_mm
    local = grid.ijk(points) * spacing
    first = np.floor(grid.ijk(points).min(axis=0) - cap_mm / spacing).astype(int)
    last = np.ceil(grid.ijk(points).max(axis=0) + cap_mm / spacing).astype(int)
    first, last = np.maximum(first, 0), np.maximum(last + 1, 0)
    window = labels[tuple(slice(low, high) for low, high in zip(first, last, strict=True))]
    hit = window & bits
    chosen = hit != 0
    if exempt_branch >= 0:
        chosen &= ~((hit == AIRWAY) & ((window >> BRANCH_SHIFT).astype(int) - 1 == exempt_branch))
    centres = (np.argwhere(chosen) + first) * spacing
    out = np.minimum(box_distance(local, centres, spacing), cap_mm)
    if bits & OUTSIDE:
        faces = np.concatenate(
            [local + 0.5 * spacing, (np.array(grid.shape) - 0.5) * spacing - local], axis=1
        )
        out = np.minimum(out, np.maximum(faces.min(axis=1), 0.0))
    return out


def box_distance(points: np.ndarray, centres: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """Return distances to boxes: of the nearest centres so many that no other box can be nearer."""
    out = np.full(len(points), np.inf)
    left, wanted = np.arange(len(points)), min(8, len(centres))
    tree = cKDTree(centres, balanced_tree=False, compact_nodes=False)
    while len(left) and len(centres):
        away, index = tree.query(points[left], k=[*range(1, wanted + 1)])
        gap = np.maximum(np.abs(points[left][:, None] - centres[index]) - 0.5 * spacing, 0.0)
        out[left] = np.sqrt((gap**2).sum(axis=-1)).min(axis=1)
        unsure = away[:, -1] - 0.5 * float(np.linalg.norm(spacing)) < out[left]
        left = left[unsure & (wanted < len(centres))]
        wanted = min(6 * wanted, len(centres))
    return out


def nodules_of(canvas: Canvas, where: np.ndarray) -> Volume:
    """Return a nodule mask."""
    return Volume(grid=canvas.grid, array=where)
