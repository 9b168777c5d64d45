"""Masks that are no tree of airways: noise, or a leak into the lung, is refused before it costs minutes."""

import itertools

import numpy as np

from anatomy.base.errors import AnatomyError
from anatomy.base.typed import Int

MOST_PIECES = 2000
"""A CT shows some hundred branches; every pair of pieces is looked at, which takes minutes for more."""


def require_at_most(count: int, most: int, what: str) -> None:
    """Raise AnatomyError if a mask has more of something than a tree of airways can have."""
    if count > most:
        raise AnatomyError(
            f"The airway mask is no tree of airways: it has {count} {what}",
            expected=f"at most {most}: a CT shows some hundred branches",
            remedy="Give the mask of the airway lumen alone; noise, or a leak into the lung, looks like this",
        )


def require_few_tunnels(skeleton: Int) -> None:
    """Raise AnatomyError if the lines of a skeleton `(M, 3)` meet again too often for a tree of airways."""
    if len(skeleton):
        # Airways never meet again: a tunnel is a fault of the mask, and a CT shows some hundred branches.
        # Middle lines of airways have some thousand voxels; among so many of noise are tunnels enough.
        require_at_most(tunnels(skeleton[:50_000]), 500, "tunnels, where airways meet again")


def tunnels(voxels: Int) -> int:
    """Return how many tunnels run through a connected set of voxels without cavities.

    One minus the Euler number of the union of the voxels as closed boxes.

    Args:
        voxels ((N, 3) int64): Indices; voxels that share a corner are connected.
    """
    # Of the complex at doubled resolution a cell has as many dimensions as odd coordinates.
    middle = 2 * (voxels - voxels.min(axis=0)) + 1
    sides = middle.max(axis=0) + 2
    euler = 0
    for offset_size, sign in enumerate((-1, 1, -1, 1)):
        offsets = [o for o in itertools.product((-1, 0, 1), repeat=3) if np.abs(o).sum() == offset_size]
        cells = (middle[:, None] + np.array(offsets)).reshape(-1, 3)
        euler += sign * len(np.unique(np.ravel_multi_index(tuple(cells.T), tuple(sides))))
    return 1 - euler
