"""Continues a displacement from the nodes of a lung to all others, so that nothing slides at the pleura."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from anatomy.base.typed import Float, Mask
from anatomy.motion.stretch import cell_bounds

RELAXATIONS = 60
"""Steps that even out what the continuation begins with, over the width of some ten cells."""

STEEP = 0.5
"""Tissue that would be squeezed or sheared by half within one cell: a field slides there, or is noise."""
ROUNDS = 3
"""Each takes away the nodes of one more layer of such cells."""


def continued_unfolded(values: Float, inside: Mask, spacing_mm: float) -> tuple[Float, float]:
    """Return a continuation that mends a field where it slides or folds, and the share of nodes it mends.

    A field of both lungs jumps from one to the other where they touch, and at the pleura; the nodes of cells
    in which it does are continued over, too.

    Parameters
    ----------
    values : (ni, nj, nk, 3) float64
        Displacements at nodes, mm.
    inside : (ni, nj, nk) bool
        The nodes in a lung.
    spacing_mm : float
        Distance of nodes.
    """
    known = inside.copy()
    for _ in range(ROUNDS):
        out = continued(values, known)
        bounds = cell_bounds(out, spacing_mm)
        steep = np.pad(np.maximum(-bounds[..., 0], bounds[..., 1]) > STEEP, 1)
        wrong = known & ndimage.maximum_filter(steep, 2)[1:, 1:, 1:]
        if not wrong.any() or wrong.sum() > 0.5 * known.sum():
            break
        known &= ~wrong
    return out, float(1.0 - known.sum() / max(inside.sum(), 1))


def continued(values: Float, known: Mask) -> Float:
    """Return values `(ni, nj, nk, 3)` that equal the given ones at known nodes, and are smooth elsewhere.

    Elsewhere they begin with the value of the nearest known node, and become the mean of their six
    neighbours step by step.
    """
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    out = values[tuple(nearest)]
    for _ in range(RELAXATIONS):
        mean = np.zeros_like(out)
        for axis in range(3):
            for beside in (_shifted(out, axis, 1), _shifted(out, axis, -1)):
                mean += beside
        out = np.where(known[..., None], values, mean / 6.0)
    return np.asarray(out)


def _shifted(values: Float, axis: int, by: int) -> Float:
    """Return the neighbours of all nodes along an axis, those of the border being themselves."""
    index = np.clip(np.arange(values.shape[axis]) + by, 0, values.shape[axis] - 1)
    return np.asarray(np.take(values, index, axis=axis))
