"""What the reference mode collides with: surface meshes under FCL, and the voxels for what lies inside."""

import math
from collections.abc import Callable
from functools import cached_property

import numpy as np

from anatomy.base.typed import Bool, Float, Int, Int32, Labels
from anatomy.lung import Lung
from anatomy.meshes import MeshDistance, box_surface
from anatomy.structures import AIRWAY, BRANCH_SHIFT, FISSURE, LUMEN, OUTSIDE, VESSEL

SAGITTA_MM = 0.01
LONGEST_CHORD_MM = 2.0
"""Curves are tested as chords of at most this length, padded by at most this sagitta, well below a voxel."""


def chord_mm(curvature_per_mm: float) -> float:
    """Return a length of chord that stays within SAGITTA_MM of an arc."""
    if curvature_per_mm * LONGEST_CHORD_MM**2 <= 8.0 * SAGITTA_MM:
        return LONGEST_CHORD_MM
    return math.sqrt(8.0 * SAGITTA_MM / curvature_per_mm)


class Solid:
    """Some voxels of a lung as solid boxes.

    Args:
        holds: Tells from labels `(...,)` uint16 which voxels belong to it.
        low, high ((3,) int64): Window of voxels; the solid is known in it only.  By default the whole grid,
            and OUTSIDE beyond it.
    """

    def __init__(
        self, lung: Lung, holds: Callable[[Labels], Bool], low: Int | None = None, high: Int | None = None
    ) -> None:
        self._lung = lung
        self._holds = holds
        grid, labels, beyond = lung.grid, lung.labels, bool(holds(np.array([OUTSIDE], np.uint16))[0])
        if low is not None and high is not None:
            grid = grid.crop(low, high)
            labels = labels[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
        self._surface = MeshDistance(box_surface(holds(labels), grid, beyond=beyond))

    def is_near(self, line_lps: Float, distance_mm: float) -> bool:
        """Tell whether a polyline comes as near as `distance_mm` to the solid, or lies inside it.

        A line that does not touch the surface lies on one side of it.

        Args:
            line_lps: (N, 3) float64, LPS mm.
        """
        if self._holds(self._lung.grid.values_at(self._lung.labels, line_lps, OUTSIDE)).any():
            return True
        return self._surface.polyline_distance_mm(line_lps) <= distance_mm

    def distance_mm(self, point_lps: Float) -> float:
        """Return the distance of a point `(3,)` from the solid, 0 inside it."""
        if self._holds(self._lung.grid.values_at(self._lung.labels, point_lps, OUTSIDE)):
            return 0.0
        return self._surface.polyline_distance_mm(point_lps)

    def depth_mm(self, point_lps: Float) -> float:
        """Return how far inside the solid a point `(3,)` lies, 0 outside it."""
        if not self._holds(self._lung.grid.values_at(self._lung.labels, point_lps, OUTSIDE)):
            return 0.0
        return self._surface.polyline_distance_mm(point_lps)


class Obstacles:
    """The solids of one lung, each made when it is first asked for.

    Args:
        reach_mm: `other_airways` is exact within this distance of the pierced branch.
    """

    def __init__(self, lung: Lung, *, with_fissures: bool, reach_mm: float) -> None:
        self.lung = lung
        self.forbidden = VESSEL | OUTSIDE | (FISSURE if with_fissures else 0)
        self._reach_mm = reach_mm
        self._other_airways: dict[int, Solid] = {}

    def prepare(self) -> None:
        """Make the meshes of the whole lung; those of single branches are made when they are pierced."""
        for solid in (self.tissue, self.airways, self.lumen):
            solid.is_near(self.lung.tree.points_lps[:1], 0.0)

    @cached_property
    def tissue(self) -> Solid:
        """Vessels, all that is outside the lung, and fissures if they are obstacles."""
        return Solid(self.lung, lambda labels: (labels & self.forbidden) != 0)

    @cached_property
    def airways(self) -> Solid:
        """All airways with their walls."""
        return Solid(self.lung, lambda labels: (labels & AIRWAY) != 0)

    @cached_property
    def lumen(self) -> Solid:
        """The open space of all airways."""
        return Solid(self.lung, lambda labels: (labels & LUMEN) != 0)

    @cached_property
    def _boxes(self) -> list[tuple[slice, ...]]:
        """The bounding box of every branch."""
        from scipy.ndimage import find_objects

        return list(find_objects(branch_of(self.lung.labels) + 1))

    def other_airways(self, branch: int) -> Solid:
        """Return the airways but for one branch, known within the reach of that branch."""
        if branch not in self._other_airways:
            box = self._boxes[branch]
            reach = np.ceil(self._reach_mm / self.lung.grid.spacing_mm).astype(np.int64) + 1
            low = np.maximum(np.array([along.start for along in box]) - reach, 0)
            high = np.minimum(np.array([along.stop for along in box]) + reach, self.lung.labels.shape)
            self._other_airways[branch] = Solid(
                self.lung, lambda labels: ((labels & AIRWAY) != 0) & (branch_of(labels) != branch), low, high
            )
        return self._other_airways[branch]


def branch_of(labels: Labels) -> Int32:
    """Return the airway branch of labels, -1 where they are not airway."""
    return np.asarray(labels >> BRANCH_SHIFT, dtype=np.int32) - np.int32(1)
