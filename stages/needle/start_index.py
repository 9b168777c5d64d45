"""An index of many start poses: which of them have a target in their workspace, without a look at each."""

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.typed import Float, Int
from stages.needle.environment import NeedleEnvironment
from stages.needle.kernels import start_index as kernel

CELL_MM = 5.0
"""Poses of one bundle lie in one such cube."""
DIRECTION_CELLS = 8
"""Cells along an edge of a cube on whose faces directions are sorted."""


class StartIndex:
    """Start poses, sorted into bundles that are alike in place and direction.

    It does not depend on the needle, so one index serves all of them.

    Parameters
    ----------
    positions, tangents : (E, 3) float64
        Points, LPS mm, and unit tangents.
    """

    def __init__(self, positions: ArrayLike, tangents: ArrayLike) -> None:
        places = np.asarray(positions, dtype=np.float64).reshape(-1, 3)
        directions = np.asarray(tangents, dtype=np.float64).reshape(-1, 3)
        keys = _keys(places, directions)
        order = np.argsort(keys, kind="stable")
        changes = np.flatnonzero(np.diff(keys[order])) + 1
        self._order: Int = order
        self._begins = np.concatenate([[0], changes, [len(keys)]]).astype(np.int64)
        self._positions = np.ascontiguousarray(places[order])
        self._tangents = np.ascontiguousarray(directions[order])
        bundles = len(self._begins) - 1 if len(keys) else 0
        self._bounds = np.zeros((bundles, kernel.N_BOUNDS))
        kernel.bound_bundles(
            self._positions, self._tangents, np.arange(len(order)), self._begins, self._bounds
        )

    @property
    def count(self) -> int:
        """Number of poses, E."""
        return len(self._order)

    def holding(self, environment: NeedleEnvironment, target: ArrayLike) -> tuple[Int, Float]:
        """Return the poses with a target in their workspace, the nearest first, and path lengths in mm.

        The same as finite entries of `stages.needle.environment.workspace_lengths`; poses at the same length
        come in their own order.

        Parameters
        ----------
        environment : NeedleEnvironment
            The needle.
        target : (3,) float64, LPS mm
        """
        found = np.zeros(self.count, dtype=np.int64)
        lengths = np.zeros(self.count)
        count = kernel.workspace_query(
            self._bounds,
            self._begins,
            self._order,
            self._positions,
            self._tangents,
            np.asarray(target, dtype=np.float64),
            environment.limits,
            found,
            lengths,
        )
        nearest = np.lexsort((found[:count], lengths[:count]))
        return found[:count][nearest], lengths[:count][nearest]


def _keys(positions: Float, directions: Float) -> Int:
    """Return the number of each pose's cell, in place and on the cube of directions."""
    cell = np.floor((positions - positions.min(axis=0, initial=0.0)) / CELL_MM).astype(np.int64)
    key = np.zeros(len(cell), dtype=np.int64)
    for axis in range(3):
        key = key * (cell[:, axis].max(initial=0) + 1) + cell[:, axis]
    axis = np.argmax(np.abs(directions), axis=1)
    rows = np.arange(len(axis))
    top = directions[rows, axis]
    key = key * 6 + axis + 3 * (top < 0.0)
    for other in (1, 2):
        share = 0.5 * (directions[rows, (axis + other) % 3] / np.abs(top) + 1.0)
        key = key * DIRECTION_CELLS + np.clip(
            (share * DIRECTION_CELLS).astype(np.int64), 0, DIRECTION_CELLS - 1
        )
    return np.asarray(key, dtype=np.int64)
