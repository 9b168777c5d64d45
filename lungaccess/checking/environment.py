"""One lung as the check sees it, with what follows from the lung alone kept for the next plan."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from anatomy.typed import Float, Int
from lungaccess.checking.boxes import Boxes
from lungaccess.checking.space import Select
from lungaccess.checking.tiles import Tiles

if TYPE_CHECKING:
    from anatomy.airway_tree import AirwayTree
    from anatomy.lung import Lung


class Environment:
    """A lung, its structures as solid boxes, and its airway tree as lines.

    The arrays of the lung must not change while this is used.
    """

    def __init__(self, lung: Lung) -> None:
        self.lung = lung
        self._tiles = Tiles(lung)

    def boxes(self, select: Select, reach_mm: float) -> Boxes:
        """Return a structure as solid boxes; what lies beyond the reach counts as so far."""
        return Boxes(self._tiles, select, reach_mm)

    @cached_property
    def axis(self) -> AirwayAxis:
        """The medial axis of the airways."""
        return AirwayAxis(self.lung.tree)


class AirwayAxis:
    """The points and edges of the airway tree, for distances to it."""

    def __init__(self, tree: AirwayTree) -> None:
        child = np.flatnonzero(tree.parent_point >= 0)
        parent = tree.parent_point[child]
        self.tree = tree
        self._ends: tuple[Int, Int] = (parent, child)
        self._begin = tree.points_lps[parent]
        self._step = tree.points_lps[child] - self._begin
        self._square = np.maximum((self._step**2).sum(axis=1), 1e-300)
        self._longest = float(np.sqrt(self._square.max()))
        self._middles = cKDTree(self._begin + 0.5 * self._step)
        self._points = cKDTree(tree.points_lps)

    def nearest_points(self, points_lps: Float, count: int) -> Int:
        """Return the indices `(N, count)` of the nearest tree points, or as many as there are."""
        count = min(count, self.tree.n_points)
        found = self._points.query(points_lps, k=np.arange(1, count + 1))[1]
        return np.asarray(found, dtype=np.int64)

    def distance_mm(self, points_lps: Float) -> Float:
        """Return the `(N,)` distances from points to the nearest edge of the tree.

        The nearest edge has its middle within the distance of the nearest middle and half an edge.
        """
        points = np.asarray(points_lps, dtype=np.float64).reshape(-1, 3)
        gaps = np.asarray(self._middles.query(points)[0], dtype=np.float64)
        near = self._middles.query_ball_point(points, gaps + 0.5 * self._longest + 1e-9)
        counts = np.array([len(each) for each in near])
        edge = np.concatenate([np.asarray(each, dtype=np.int64) for each in near])
        away = np.repeat(points, counts, axis=0) - self._begin[edge]
        share = np.clip((away * self._step[edge]).sum(axis=1) / self._square[edge], 0.0, 1.0)
        lines = np.linalg.norm(away - share[:, None] * self._step[edge], axis=1)
        return np.minimum(gaps, np.minimum.reduceat(lines, np.cumsum(counts) - counts))

    def tangent_at(self, point: Float) -> Float:
        """Return the direction of the airway at a point on an edge of the tree, linear along the edge."""
        share = np.clip(((point - self._begin) * self._step).sum(axis=1) / self._square, 0.0, 1.0)[:, None]
        edge = int(np.linalg.norm(self._begin + share * self._step - point, axis=1).argmin())
        parent, child = self._ends[0][edge], self._ends[1][edge]
        return np.asarray(
            (1.0 - share[edge]) * self.tree.tangents[parent] + share[edge] * self.tree.tangents[child]
        )
