"""The deployments of an atlas in the order in which a search looks at them."""

from __future__ import annotations

import numpy as np

from anatomy.typed import Float, Int
from lungaccess.coupled.kernels import direct_arcs
from lungaccess.coupled.search.local_search import Needle
from stages.tube import Deployments

CELL_MM = 5.0
DIRECTIONS = 2.0
"""Tangents differ if a component, times this, rounds to another whole number."""


def different(entries: Deployments, ordered: Int) -> Int:
    """Return the first of every group of similar deployments, in the order given.

    Similar are those that leave the same branch and end in the same cell of CELL_MM with about the same
    tangent.

    Parameters
    ----------
    entries : Deployments
    ordered : (N,) int64
        Which of them, the best first.
    """
    places = np.floor(entries.positions[ordered] / CELL_MM)
    towards = np.rint(entries.tangents[ordered] * DIRECTIONS)
    keys = np.column_stack([entries.branch[ordered], places, towards]).astype(np.int64)
    _groups, first = np.unique(keys, axis=0, return_index=True)
    return ordered[np.sort(first)]


def cost_bounds(needle: Needle, entries: Deployments, chosen: Int, lengths: Float, target: Float) -> Float:
    """Return lower bounds `(N,)` of the cost of any path from deployments to the target.

    Parameters
    ----------
    needle : tuple
        See `lungaccess.coupled.kernels.candidate`.
    entries : Deployments
    chosen : (N,) int64
    lengths : (N,) float64
        Of the shortest path in free space, mm.
    target : (3,) float64, LPS mm
    """
    x, y, z = target.tolist()
    bounds = np.zeros(len(chosen))
    positions = np.ascontiguousarray(entries.positions[chosen])
    direct_arcs.cost_bounds(needle, positions, np.array(lengths), (x, y, z), bounds)
    return bounds
