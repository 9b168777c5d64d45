"""One lung as the check sees it, with what follows from the lung alone kept for the next plan."""

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from anatomy.base.typed import Float, Int
from lungaccess.judging.checking.boxes import Boxes
from lungaccess.judging.checking.space import Select
from lungaccess.judging.checking.tiles import Tiles

if TYPE_CHECKING:
    from anatomy.lung import Lung


class Environment:
    """A lung, its structures as solid boxes, and the points of its airway tree.

    The arrays of the lung must not change while this is used.
    """

    def __init__(self, lung: "Lung") -> None:
        self.lung = lung
        self._tiles = Tiles(lung)

    def boxes(self, select: Select, reach_mm: float) -> Boxes:
        """Return a structure as solid boxes; what lies beyond the reach counts as so far."""
        return Boxes(self._tiles, select, reach_mm)

    @cached_property
    def _tree_points(self) -> cKDTree:
        return cKDTree(self.lung.tree.points_lps)

    def nearest_tree_points(self, point_lps: Float, count: int) -> Int:
        """Return the indices of the tree points nearest to a point `(3,)`, the nearest first."""
        count = min(count, self.lung.tree.n_points)
        found = self._tree_points.query(point_lps, k=np.arange(1, count + 1))[1]
        return np.asarray(found, dtype=np.int64)
