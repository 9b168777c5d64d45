"""The tips that the states of a scope are turned to: for each place along the airway one of every kind."""

from __future__ import annotations

import math

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.typed import Bool, Float, Int
from stages.scope.growth import StateTree, rings
from stages.scope.kernels import turning
from stages.scope.kernels.body import Walls
from stages.scope.kernels.growth import Device
from stages.scope.kernels.turning import Places
from stages.scope.tip_region import MAX_OFF_AXIS_MM, MAX_TURN_AT_TIP_RAD

TURNED_COARSER = 2.0
"""Turned tips are so much farther apart: each place has many directions, and nearer ones give about the same
poses."""
TURN_RINGS_PER_MM = (0.004, 0.008, 0.014, 0.022, 0.032, 0.045, 0.06)
"""Curvatures beside that of a state: they turn the tip of a section of 15 mm by 3 to 50 degrees."""
TURN_SPOKES = 12
KINDS = (math.floor(MAX_TURN_AT_TIP_RAD / turning.POLAR_RAD + 0.5) + 1) * turning.AZIMUTHS * turning.SIDES
"""Kinds of tips at a place, by angle from the axis, direction and side."""
ROUNDING = 1e-9
"""Tips keep the limits of their region by this much, so that who computes them otherwise agrees."""


def find_tips(
    walls: Walls,
    tree: AirwayTree,
    wanted: Bool,
    states: StateTree,
    device: Device,
    *,
    max_curvature_per_mm: float,
    spacing_mm: float,
) -> tuple[Float, Int, int]:
    """Return tips that are proved reachable in place from states, their tree points, and how many look ahead.

    Parameters
    ----------
    wanted : (N,) bool
        Tree points at which tips are wanted.

    Returns
    -------
    tips : (S, 15) float64
        See `stages.scope.kernels.turning`; those that look ahead on the axis come first.
    tree_point : (S,) int64
    ahead : int
    """
    places, ahead, count = _places(tree, wanted, spacing_mm)
    from_states = states.states[states.turned_from]
    offsets = rings(TURN_RINGS_PER_MM, TURN_SPOKES)[1:]
    best = np.full((count, turning.TRIES), -1, dtype=np.int64)
    costs = np.full((count, turning.TRIES), np.inf)
    turning.sort_tips(device, max_curvature_per_mm, from_states, offsets, places, best, costs)
    some = np.flatnonzero(best[:, 0] >= 0)
    tips, near = np.zeros((len(some), turning.TIP_COLUMNS)), np.zeros(len(some), dtype=np.int64)
    turning.first_free(
        walls, device, max_curvature_per_mm, from_states, offsets, best[some], tips, near, places
    )
    kept = near >= 0
    tips[:, turning.SOURCE] = states.turned_from[tips[:, turning.SOURCE].astype(np.int64)]
    return tips[kept], near[kept], int((some[kept] < ahead).sum())


def _places(tree: AirwayTree, wanted: Bool, spacing_mm: float) -> tuple[Places, int, int]:
    """Return where tips may be, how many groups there are of tips that look ahead, and how many in all."""
    ahead = _slots(tree, spacing_mm)
    aside = _slots(tree, TURNED_COARSER * spacing_mm)
    groups = int(ahead.max()) + 1
    helper = np.eye(3)[np.argmin(np.abs(tree.tangents), axis=1)]
    first = np.cross(tree.tangents, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    low, size = tree.points_lps.min(axis=0), MAX_OFF_AXIS_MM * (1.0 - ROUNDING)
    begins, order = _cells(np.floor((tree.points_lps - low) / size).astype(np.int64))
    places = Places(
        points=tree.points_lps,
        tangents=tree.tangents,
        first=first,
        second=np.cross(tree.tangents, first),
        wanted=wanted,
        slots=np.stack([ahead, groups + KINDS * aside]),
        low=low,
        begins=begins,
        order=order,
        off_axis_mm=size,
        least_cosine=math.cos(MAX_TURN_AT_TIP_RAD) + ROUNDING,
    )
    return places, groups, groups + KINDS * (int(aside.max()) + 1)


def _cells(cell: Int) -> tuple[Int, Int]:
    """Return where the points of a cell begin, for one cell more a row, and the points sorted by cells."""
    shape = cell.max(axis=0) + 1
    number = np.ravel_multi_index((cell[:, 0], cell[:, 1], cell[:, 2]), shape)
    order = np.argsort(number, kind="stable")
    bounds = np.searchsorted(number[order], np.arange(shape.prod() + 1))
    begins, ends = bounds[:-1].reshape(shape), bounds[1:].reshape(shape)
    return np.ascontiguousarray(np.concatenate([begins, ends[:, :, -1:]], axis=2)), order


def _slots(tree: AirwayTree, spacing_mm: float) -> Int:
    """Return for each tree point the number of its stretch `spacing_mm` long, counted along the branches."""
    along = np.floor(tree.distance_from_root_mm / spacing_mm).astype(np.int64)
    pairs = np.stack([tree.branch_of_point, along], axis=1)
    return np.asarray(np.unique(pairs, axis=0, return_inverse=True)[1].reshape(-1), dtype=np.int64)
