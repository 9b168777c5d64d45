"""The states that paths can have on one plane between start and target."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from anatomy.base.typed import Float, Int, UInt64
from stages.needle.infeasibility.kernels import bitmaps


@dataclass(frozen=True)
class Plane:
    """States on one plane: bits (V, U, Y, W) and the cell numbers (v, u, y, x) of their first cell."""

    bits: UInt64
    window: Int

    def trimmed(self) -> Plane:
        """Return the same without empty rows and columns at the edges."""
        box = np.zeros(8, dtype=np.int64)
        bitmaps.extent(self.bits, box)
        v0, v1, u0, u1, y0, y1, w0, w1 = (int(n) for n in box)
        bits = self.bits[v0 : v1 + 1, u0 : u1 + 1, y0 : y1 + 1, w0 : w1 + 1]
        return Plane(np.ascontiguousarray(bits), self.window + np.array([v0, u0, y0, 64 * w0]))

    @property
    def ends(self) -> Int:
        """Cell numbers of the last cell."""
        nv, nu, rows, words = self.bits.shape
        last: Int = self.window + np.array([nv, nu, rows, 64 * words]) - 1
        return last

    def refined(self, *, directions: bool, require: Callable[[int], None]) -> Plane:
        """Return the same states in cells of half the side.

        Parameters
        ----------
        directions : bool
            Whether to halve the cells of directions too.
        require : callable
            Called with the number of bytes that this takes, before it does.
        """
        halved = np.array([directions, directions, True, True])
        shape = np.where(halved, 2 * np.array(self.bits.shape) + 1, self.bits.shape)
        require(8 * math.prod(int(n) for n in shape))
        bits = np.zeros(tuple(shape), dtype=np.uint64)
        bitmaps.refine(self.bits, directions, bits)
        return Plane(bits, np.where(halved, 2 * self.window - 1, self.window))

    @property
    def places(self) -> Int:
        """Cells (N, 2) of position, numbers (y, x), in which the plane has a state of any direction."""
        words = np.ascontiguousarray(np.bitwise_or.reduce(self.bits, axis=(0, 1))).astype("<u8")
        cells = np.unpackbits(words.view(np.uint8), axis=1, bitorder="little")
        return np.asarray(np.argwhere(cells) + self.window[2:], dtype=np.int64)

    def probed_cells(self, moves: Float) -> tuple[Int, Int]:
        """Return which cells of position the tangents of the states can meet at some depths.

        Parameters
        ----------
        moves : (D,) float64
            Cells of position by which a tangent moves up to each depth, for each cell of direction.

        Returns
        -------
        corners, shape : (D, 2) int64
            Numbers (y, x) of the first cells, and how many there are.
        """
        low, high = self.window, self.ends
        corners = np.zeros((len(moves), 2), dtype=np.int64)
        shape = np.zeros((len(moves), 2), dtype=np.int64)
        for axis in (0, 1):
            ends = np.stack([moves * low[axis], moves * high[axis]])
            corners[:, axis] = low[axis + 2] + np.floor(ends.min(axis=0)) - 1
            shape[:, axis] = high[axis + 2] + np.ceil(ends.max(axis=0)) + 2 - corners[:, axis]
        return corners, shape
