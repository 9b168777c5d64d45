"""Figures of the true centrelines of a phantom."""

import numpy as np

from anatomy.base.typed import Float, Int
from anatomy.phantom import Centerlines


def diameters_mm(lines: Centerlines) -> Float:
    """Return the mean lumen diameter of every branch, `(B,)` mm."""
    sums = np.add.reduceat(lines.radius_mm, lines.branch_start[:-1])
    return np.asarray(2 * sums / np.diff(lines.branch_start))


def lengths_mm(lines: Centerlines) -> Float:
    """Return the arc length of every branch, `(B,)` mm."""
    parts = np.split(lines.points_lps, lines.branch_start[1:-1])
    return np.array([np.linalg.norm(np.diff(part, axis=0), axis=1).sum() for part in parts])


def edges_of(lines: Centerlines) -> Int:
    """Return index pairs `(M, 2)` of joined points within branches."""
    ends = np.delete(np.arange(len(lines.points_lps)), lines.branch_start[1:] - 1)
    return np.stack([ends, ends + 1], axis=1)
