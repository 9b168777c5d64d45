"""Proved bounds, cell by cell, of how a trilinear motion stretches tissue."""

from __future__ import annotations

import numpy as np

from anatomy.typed import Float

ROUNDING = 1e-9
"""Eigenvalues of matrices of size 1 in double precision are right to far less."""


def cell_bounds(nodes: Float, spacing_mm: float) -> Float:
    """Return bounds of the gradient of a trilinear displacement on its cells.

    In a cell the derivative along an axis is a mean of those along its four edges of that axis; so the
    gradient is nowhere farther from the mean one than the edges are.  With G the gradient and its symmetric
    part S, `|v + share G v| >= v'(v + share G v) >= 1 + share v'S v` for unit vectors v: a segment that
    stays in cells is stretched by no less than `1 + share low` (share >= 0) or `1 + share high` (share < 0).

    Parameters
    ----------
    nodes : (..., ni, nj, nk, 3) float64
        Displacements at nodes, mm.
    spacing_mm : float
        Distance of nodes along all axes.

    Returns
    -------
    (..., ni - 1, nj - 1, nk - 1, 3) float64
        For each cell: low, a lower bound of the eigenvalues of S; high, an upper one; an upper bound of the
        spectral norm of G.
    """
    means, radius_squared = [], 0.0
    for axis in range(-4, -1):
        edges = np.diff(nodes, axis=axis) / spacing_mm
        for other in {-4, -3, -2} - {axis}:
            edges = np.stack([_part(edges, other, 0), _part(edges, other, 1)])
        edges = edges.reshape(4, *edges.shape[2:])
        mean = edges.mean(axis=0)
        radius_squared = radius_squared + ((edges - mean) ** 2).sum(axis=-1).max(axis=0)
        means.append(mean)
    gradient = np.stack(means, axis=-1)
    spread = np.sqrt(radius_squared) + ROUNDING
    symmetric = np.linalg.eigvalsh(0.5 * (gradient + np.swapaxes(gradient, -1, -2)))
    squared = np.linalg.eigvalsh(np.swapaxes(gradient, -1, -2) @ gradient)[..., -1]
    norm = np.sqrt(np.maximum(squared, 0.0)) + spread
    return np.stack([symmetric[..., 0] - spread, symmetric[..., -1] + spread, norm], axis=-1)


def _part(values: Float, axis: int, begin: int) -> Float:
    """Return all but the last (begin 0) or the first (begin 1) of an axis counted from the end."""
    cut = [slice(None)] * values.ndim
    cut[axis] = slice(begin, values.shape[axis] - 1 + begin)
    return values[tuple(cut)]
