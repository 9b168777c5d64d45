"""Pieces of the medial axis from which deployments start, with the directions that tips may have there."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from anatomy import poses as frames
from anatomy.airway_tree import AirwayTree
from anatomy.lung import Lung
from anatomy.records import frozen_record
from anatomy.typed import Float, Mask
from lungaccess.problem.system import System
from stages.scope import LEAVING_MM, MAX_TURN_AT_TIP_RAD, find_sites

KNOT_MM = 0.5
"""Greatest distance of knots on the medial axis: about a voxel, below which clearances hardly change."""
KNOTS_A_PIECE = 16
"""A piece of 8 mm turns so little that one cone holds the directions of its tips."""
SPARE_RAD = 1e-6
"""More than the rounding of any angle here, so that no direction is lost by it."""


@frozen_record
class AxisPiece:
    """A piece of the medial axis where the scope tip may be: N knots in LPS mm, `(N, 3)`.

    For a tip between two knots, `cones` `(N - 1, 4)` hold the middle of the directions that it may have, and
    the greatest angle from it in rad.  The rows of `frame` `(3, 3)` are the axes of a frame whose +z is the
    mean direction of the tips; `wide` is the greatest angle in rad between that +z and such a direction.
    """

    knots: Float
    cones: Float
    frame: Float
    wide: float


def axis_pieces(lung: Lung, system: System, leaving: Mask, reach_mm: float) -> Iterator[AxisPiece]:
    """Yield the pieces of the medial axis to which the scope fits and from which an exit is within reach."""
    from scipy.spatial import cKDTree

    tree = lung.tree
    exits = np.argwhere(leaving)
    if not len(exits):
        return
    nearest = cKDTree(lung.grid.lps(exits))
    reach_mm += float(np.linalg.norm(lung.grid.spacing_mm))
    passable = find_sites(lung, system.scope, reach_mm=reach_mm).passable
    knots: list[Float] = []
    cones: list[Float] = []
    last = -1
    for point in np.flatnonzero(passable & (tree.parent_point >= 0)):
        parent = int(tree.parent_point[point])
        if last != parent:
            yield from _finished(knots, cones, nearest, reach_mm)
            knots, cones = [tree.points_lps[parent]], []
        begin, end = tree.points_lps[parent], tree.points_lps[point]
        count = max(1, math.ceil(float(np.linalg.norm(end - begin)) / KNOT_MM))
        for m in range(count):
            if len(cones) == KNOTS_A_PIECE:
                yield from _finished(knots, cones, nearest, reach_mm)
                knots, cones = [knots[-1]], []
            shares = np.array([m / count, (m + 1) / count])
            cones.append(_cone(tree, int(point), shares))
            knots.append(begin + shares[1] * (end - begin))
        last = int(point)
    yield from _finished(knots, cones, nearest, reach_mm)


def _finished(
    knots: list[Float], cones: list[Float], nearest: object, reach_mm: float
) -> Iterator[AxisPiece]:
    if not cones or nearest.query(np.array(knots))[0].min() > reach_mm:  # type: ignore[attr-defined]
        return
    table = np.array(cones)
    axis = table[:, :3].sum(axis=0)
    axis /= np.linalg.norm(axis)
    frame = frames.pose(knots[0], axis)[:3, :3].T
    from_axis = np.arccos(np.clip(table[:, :3] @ axis, -1.0, 1.0))
    wide = float((from_axis + table[:, 3]).max()) + SPARE_RAD
    yield AxisPiece(knots=np.array(knots), cones=table, frame=np.ascontiguousarray(frame), wide=wide)


def _cone(tree: AirwayTree, point: int, shares: Float) -> Float:
    """Return the mean direction of tips on a part of the edge to a tree point, and the angle around it.

    A tip looks along the medial axis, or is turned from the chord between where the scope leaves the axis
    and its place; see `stages.scope.tips`.
    """
    parent = int(tree.parent_point[point])
    begin, end = tree.points_lps[parent], tree.points_lps[point]
    inserted_mm = tree.distance_from_root_mm
    tips_mm = inserted_mm[parent] + shares * (inserted_mm[point] - inserted_mm[parent])
    places = [begin + share * (end - begin) for share in shares]
    tangents = [(1.0 - share) * tree.tangents[parent] + share * tree.tangents[point] for share in shares]
    chords: list[Float] = []
    left = point
    while inserted_mm[left] > tips_mm[1] - LEAVING_MM and tree.parent_point[left] >= 0:
        left = int(tree.parent_point[left])
    while True:
        chords += [place - tree.points_lps[left] for place in places]
        if inserted_mm[left] <= tips_mm[0] - LEAVING_MM or tree.parent_point[left] < 0:
            break
        left = int(tree.parent_point[left])
    seen = np.array([_unit(chord if np.any(chord) else tree.tangents[point]) for chord in chords])
    middle = _unit(seen.sum(axis=0))
    turned = MAX_TURN_AT_TIP_RAD + float(np.arccos(np.clip(seen @ middle, -1.0, 1.0)).max())
    straight = max(math.acos(min(max(float(_unit(t) @ middle), -1.0), 1.0)) for t in tangents)
    return np.append(middle, max(turned, straight) + SPARE_RAD)


def _unit(vector: Float) -> Float:
    return np.asarray(vector / np.linalg.norm(vector))
