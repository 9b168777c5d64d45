"""Scope tips anywhere on the medial axis, also between tree points."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anatomy import poses as frames
from anatomy.airway_tree import AirwayTree
from anatomy.grid import Float

TURN_CHORD_MM = 2.0
MAX_TURN_AT_TIP_RAD = math.radians(45.0)
"""A tip must look where the scope comes from going, within this angle of its last TURN_CHORD_MM."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ScopeTip:
    """The tip of the scope on the medial axis, looking along it.

    Parameters
    ----------
    tree_point : int
        The tree point at the tip or next beyond it.
    back_mm : float
        How far before that point the tip stands, towards the root.
    lps_from_scope_tip : (4, 4) float64
    """

    tree_point: int
    back_mm: float
    lps_from_scope_tip: Float


def step_length_mm(tree: AirwayTree, point: int) -> float:
    """Return the way from a tree point to its parent, 0 at the root."""
    parent = tree.parent_point[point]
    way = tree.distance_from_root_mm
    return 0.0 if parent < 0 else float(way[point] - way[parent])


def tip_at(tree: AirwayTree, point: int, back_mm: float = 0.0) -> ScopeTip:
    """Return the tip that stands `back_mm` before a tree point, at most as far as its parent."""
    step = step_length_mm(tree, point)
    share = min(max(back_mm / step, 0.0), 1.0) if step > 0.0 else 0.0
    parent = max(int(tree.parent_point[point]), 0)
    position = (1.0 - share) * tree.points_lps[point] + share * tree.points_lps[parent]
    tangent = (1.0 - share) * tree.tangents[point] + share * tree.tangents[parent]
    return ScopeTip(
        tree_point=int(point), back_mm=share * step, lps_from_scope_tip=frames.pose(position, tangent)
    )


def looks_ahead(tree: AirwayTree, tip: ScopeTip) -> bool:
    """Tell whether a tip points on along its route, and not sideways just behind a fork."""
    position, forward = tip.lps_from_scope_tip[:3, 3], tip.lps_from_scope_tip[:3, 2]
    point = max(int(tree.parent_point[tip.tree_point]), 0)
    while np.linalg.norm(position - tree.points_lps[point]) < TURN_CHORD_MM and tree.parent_point[point] >= 0:
        point = int(tree.parent_point[point])
    chord = position - tree.points_lps[point]
    length = float(np.linalg.norm(chord))
    return length == 0.0 or float(chord @ forward) >= length * math.cos(MAX_TURN_AT_TIP_RAD)


def walk(tree: AirwayTree, tip: ScopeTip, distance_mm: float, rng: np.random.Generator) -> ScopeTip:
    """Return the tip moved along the airway, back for negative distances; forks are taken at random."""
    point, back = tip.tree_point, tip.back_mm - distance_mm
    while back > step_length_mm(tree, point) and tree.parent_point[point] >= 0:
        back -= step_length_mm(tree, point)
        point = int(tree.parent_point[point])
    while back < 0.0:
        children = np.flatnonzero(tree.parent_point == point)
        if not len(children):
            back = 0.0
            break
        point = int(children[rng.integers(len(children))])
        back += step_length_mm(tree, point)
    return tip_at(tree, point, back)


class MedialAxis:
    """The medial axis where the scope may stand, as one line of segments [Kuntz2015, sec. IV-A].

    Parameters
    ----------
    tree : AirwayTree
    allowed : (N,) bool
        Tree points that may be a site; a segment belongs to its distal point.
    """

    def __init__(self, tree: AirwayTree, allowed: NDArray[np.bool_]) -> None:
        self._tree = tree
        self._points = np.flatnonzero(allowed & (tree.parent_point >= 0))
        lengths = [step_length_mm(tree, int(point)) for point in self._points]
        self._ends = np.cumsum(lengths)

    @property
    def length_mm(self) -> float:
        """Total length."""
        return float(self._ends[-1]) if len(self._ends) else 0.0

    def sample(self, rng: np.random.Generator) -> ScopeTip:
        """Draw a tip uniformly by arc length."""
        y = rng.uniform(0.0, self.length_mm)
        index = min(int(np.searchsorted(self._ends, y, side="right")), len(self._points) - 1)
        return tip_at(self._tree, int(self._points[index]), float(self._ends[index] - y))
