"""Proved bounds, cell by cell, of how a trilinear motion stretches tissue."""

from __future__ import annotations

import numpy as np

from anatomy.base.typed import Float
from anatomy.kernels import motion as kernel


def cell_bounds(nodes: Float, spacing_mm: float) -> Float:
    """Return bounds of the gradient of a trilinear displacement on its cells.

    In a cell the derivative along an axis is a mean of those along its four edges of that axis; so the
    gradient is nowhere farther from the mean one than the edges are.  With G the gradient and S its
    symmetric part, `|v + share G v| >= v'(v + share G v) >= 1 + share v'S v` for unit vectors v: a segment
    that stays in cells is stretched by no less than `1 + share low` (share >= 0) or `1 + share high` (share
    < 0).

    Parameters
    ----------
    nodes : (ni, nj, nk, 3) float64
        Displacements at nodes, mm.
    spacing_mm : float
        Distance of nodes along all axes.

    Returns
    -------
    (ni - 1, nj - 1, nk - 1, 3) float64
        For each cell: low, a lower bound of the eigenvalues of S; high, an upper one; an upper bound of the
        norm of G.
    """
    ni, nj, nk, _ = nodes.shape
    out = np.zeros((ni - 1, nj - 1, nk - 1, 3))
    kernel.fill_cell_bounds(np.ascontiguousarray(nodes), float(spacing_mm), out)
    return out
