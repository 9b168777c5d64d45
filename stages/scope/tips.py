"""Scope tips anywhere on the medial axis, also between tree points, along it or turned aside."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from anatomy import poses as frames
from anatomy.airway_tree import AirwayTree
from anatomy.records import frozen_record
from anatomy.typed import Bool, Float
from stages.scope.tip_region import MAX_TURN_AT_TIP_RAD


@frozen_record
class ScopeTip:
    """The tip of the scope on the medial axis, looking along it or turned aside.

    Parameters
    ----------
    tree_point : int
        The tree point at the tip or next beyond it.
    back_mm : float
        Distance of the tip before that point, towards the root.
    lps_from_scope_tip : (4, 4) float64
    turned : bool
        Whether it looks elsewhere than along the medial axis.
    """

    tree_point: int
    back_mm: float
    lps_from_scope_tip: Float
    turned: bool = False


def step_length_mm(tree: AirwayTree, point: int) -> float:
    """Return the distance from a tree point to its parent, 0 at the root."""
    parent = tree.parent_point[point]
    depth_mm = tree.distance_from_root_mm
    return 0.0 if parent < 0 else float(depth_mm[point] - depth_mm[parent])


def tip_at(tree: AirwayTree, point: int, back_mm: float = 0.0) -> ScopeTip:
    """Return the tip `back_mm` before a tree point, at most as far as its parent, looking along the axis."""
    step = step_length_mm(tree, point)
    share = min(max(back_mm / step, 0.0), 1.0) if step > 0.0 else 0.0
    parent = max(int(tree.parent_point[point]), 0)
    position = (1.0 - share) * tree.points_lps[point] + share * tree.points_lps[parent]
    tangent = (1.0 - share) * tree.tangents[point] + share * tree.tangents[parent]
    return ScopeTip(
        tree_point=int(point), back_mm=share * step, lps_from_scope_tip=frames.pose(position, tangent)
    )


LEAVING_MM = 15.0
"""A turned scope leaves the medial axis so far behind the tip: the length of a bending section."""


def leaving_point(tree: AirwayTree, tip: ScopeTip) -> int:
    """Return the last tree point of the route that a scope with a turned tip still passes."""
    depth_mm = tree.distance_from_root_mm
    most = float(depth_mm[tip.tree_point]) - tip.back_mm - LEAVING_MM
    point = tip.tree_point
    while depth_mm[point] > most and tree.parent_point[point] >= 0:
        point = int(tree.parent_point[point])
    return point


STRAIGHT_END_MM = 1.0
"""So much of a scope whose tip is turned aside lies straight behind the tip."""
BENDING_RADIUS_MM = 10.0
"""Radius with which such a scope bends; thin bronchoscopes bend at least so tightly."""
MAX_BEND_RAD = math.radians(75.0)
"""Largest bend of a turned scope where it leaves the axis: no more than scopes with a tool in them bend."""
ARC_PIECE_RAD = math.radians(4.0)
"""Angle of a piece of the arc: its polyline lies within BENDING_RADIUS_MM (1 - cos 2 degrees) < 0.01 mm."""
TINY_MM = 1e-9
TINY_RAD = 1e-6
"""Lengths and angles below these are 0 but for rounding."""


def approach(tree: AirwayTree, tip: ScopeTip) -> Float | None:
    """Return the polyline `(K, 3)` by which a turned tip leaves the medial axis, the tip last, LPS mm.

    It is straight, an arc of BENDING_RADIUS_MM, and straight again; None if the bend is more than
    MAX_BEND_RAD or does not fit between them.  The polyline is nearer than 0.01 mm to the arc.
    """
    position, forward = tip.lps_from_scope_tip[:3, 3], tip.lps_from_scope_tip[:3, 2]
    begin = tree.points_lps[leaving_point(tree, tip)]
    end = position - STRAIGHT_END_MM * forward
    behind = float((end - begin) @ forward)
    aside = begin - end + behind * forward
    beside = float(np.linalg.norm(aside))
    # Backwards from the end: an arc towards the place where the axis is left, and its tangent to there.
    straight2 = (beside - BENDING_RADIUS_MM) ** 2 + behind**2 - BENDING_RADIUS_MM**2
    if straight2 <= 0.0 or behind <= 0.0:
        return None
    bend = math.atan2(behind, BENDING_RADIUS_MM - beside) - math.atan2(
        math.sqrt(straight2), BENDING_RADIUS_MM
    )
    if bend > MAX_BEND_RAD:
        return None
    aside /= max(beside, TINY_MM)
    pieces = math.ceil(bend / ARC_PIECE_RAD) if bend > TINY_RAD else 0
    angles = np.linspace(bend, 0.0, pieces + 1)[:, None]
    arc = end + BENDING_RADIUS_MM * ((1.0 - np.cos(angles)) * aside - np.sin(angles) * forward)
    return np.concatenate([_straight(begin, arc[0]), arc[1:], _straight(arc[-1], position)[1:]])


MAX_PIECE_MM = 2.5
"""Longest piece of the straight parts of an approach."""


def _straight(begin: Float, end: Float) -> Float:
    """Return points from one to the other, at most MAX_PIECE_MM apart."""
    count = max(1, math.ceil(float(np.linalg.norm(end - begin)) / MAX_PIECE_MM - 1e-9))
    return np.asarray(begin + (np.arange(count + 1) / count)[:, None] * (end - begin))


def turned_aside(tree: AirwayTree, tip: ScopeTip, polar_rad: float, azimuth_rad: float) -> ScopeTip:
    """Return a tip turned by `polar_rad` from the chord between where it leaves the axis and its place."""
    position = tip.lps_from_scope_tip[:3, 3]
    chord = position - tree.points_lps[leaving_point(tree, tip)]
    if not np.any(chord):
        chord = tree.tangents[tip.tree_point]
    frame = frames.pose(position, chord)
    aside = frames.bending_directions(frame, azimuth_rad)[0]
    forward = math.cos(polar_rad) * frame[:3, 2] + math.sin(polar_rad) * aside
    return replace(tip, lps_from_scope_tip=frames.pose(position, forward), turned=True)


TURN_CHORD_MM = 2.0
"""The direction from which a scope comes is that of its last few points, about two voxels of the lumen."""


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
    """Return the tip moved along the airway, back for negative distances; forks are taken at random.

    A turned tip stays turned by the same angles from its chord.
    """
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
    moved = tip_at(tree, point, back)
    if not tip.turned:
        return moved
    straight = turned_aside(tree, tip, 0.0, 0.0).lps_from_scope_tip
    seen = straight[:3, :3].T @ tip.lps_from_scope_tip[:3, 2]
    polar = math.atan2(math.hypot(seen[0], seen[1]), seen[2])
    return turned_aside(tree, moved, polar, math.atan2(seen[1], seen[0]))


class MedialAxis:
    """The medial axis where the scope tip may be, as one line of segments [Kuntz2015, sec. IV-A].

    Parameters
    ----------
    allowed : (N,) bool
        Tree points that may be a site; a segment belongs to its distal point.
    """

    def __init__(self, tree: AirwayTree, allowed: Bool) -> None:
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
