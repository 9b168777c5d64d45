"""Which deployments of an atlas are similar."""

import numpy as np

from anatomy.base.typed import Int
from stages.tube import Deployments

CELL_MM = 5.0
"""Size of the cells within which tips of the tubes count as similar: about the reach of a local search."""


def different(entries: Deployments, ordered: Int) -> Int:
    """Return the first of every group of similar deployments, in the order given.

    Similar are those that leave the same branch and end in the same cell of CELL_MM with about the same
    tangent.

    Args:
        ordered ((N,) int64): Which of them, the best first.
    """
    places = np.floor(entries.positions[ordered] / CELL_MM)
    # Tangents are similar if each component, times this, rounds to the same whole number.
    towards = np.rint(entries.tangents[ordered] * 2.0)
    keys = np.column_stack([entries.branch[ordered], places, towards]).astype(np.int64)
    _groups, first = np.unique(keys, axis=0, return_index=True)
    return ordered[np.sort(first)]
