"""The elastic energy of nested tubes in small cells: the reference for equilibria and their stability."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from scipy.linalg import eigvals_banded, solve_banded

from stages.tube.device import Tube


class TubeEnergy:
    """Energy of torsion and bending as a function of the tubes' angles at nodes between plate and tip.

    The tubes share one axis, whose curvature makes the bending energy least.  Angles are linear in a cell,
    and its bending energy is that at its middle: the error of the energy is of second order.  Behind the
    plate a tube is a torsion spring from its base, which is held.  An equilibrium is where the gradient
    is 0; it is stable where the Hessian has no negative eigenvalue.

    Args:
        tubes: n tubes, innermost first.
        base_angles_rad, beta_mm: (n,) float64.
        cells: About how many cells; no landmark of a tube is inside one.
    """

    def __init__(
        self, tubes: Sequence[Tube], base_angles_rad: np.ndarray, beta_mm: np.ndarray, *, cells: int = 240
    ) -> None:
        n = len(tubes)
        ends = np.array([tube.length_mm for tube in tubes]) + beta_mm
        self.nodes_mm = _nodes(tubes, beta_mm, cells)
        """(N,) arc lengths of the nodes, from 0 to the tip."""
        self._cells_mm = np.diff(self.nodes_mm)
        middles = 0.5 * (self.nodes_mm[:-1] + self.nodes_mm[1:])
        self._on = middles[:, None] < ends
        self._twisting = np.array([tube.torsional_stiffness_n_mm2 for tube in tubes])
        bending = np.array([tube.bending_stiffness_n_mm2 for tube in tubes])
        self._weight = self._cells_mm / np.where(self._on, bending, 0.0).sum(axis=1)
        self._rest = np.zeros((len(middles), n), dtype=np.complex128)
        for i, tube in enumerate(tubes):
            for bend in tube.bends:
                there = (middles - beta_mm[i] > bend.from_mm) & (middles - beta_mm[i] < bend.to_mm)
                moment = bending[i] * bend.curvature_per_mm
                self._rest[there, i] = moment * np.exp(1j * bend.direction_rad)
        self._base = np.array(base_angles_rad)
        self._held = np.asarray(beta_mm) == 0.0
        self._springs = np.where(self._held, 0.0, self._twisting / np.where(self._held, 1.0, -beta_mm))
        free = self.nodes_mm[:, None] <= ends + 1e-9
        free[0] &= ~self._held
        self._index = np.where(free, np.cumsum(free).reshape(free.shape) - 1, -1)
        self._count = int(free.sum())

    def free(self, values: np.ndarray) -> np.ndarray:
        """Return of values (N, n) those of the free angles, node after node."""
        found = np.zeros(self._count)
        found[self._index[self._index >= 0]] = values[self._index >= 0]
        return found

    def value(self, angles_rad: np.ndarray) -> float:
        """Return the energy in N mm, up to a constant, of angles (N, n)."""
        turns, pulls = self._cells(angles_rad)
        torsion = 0.5 * self._twisting * turns**2 / self._cells_mm[:, None]
        springs = 0.5 * self._springs * (angles_rad[0] - self._base) ** 2
        shared = 0.5 * self._weight * np.abs(pulls.sum(axis=1)) ** 2
        return float(torsion.sum() + springs.sum() - shared.sum())

    def gradient(self, angles_rad: np.ndarray) -> np.ndarray:
        """Return the derivative of the energy by the free angles, in N mm."""
        turns, pulls = self._cells(angles_rad)
        twist = self._twisting * turns / self._cells_mm[:, None]
        bend = -self._weight[:, None] * (pulls.sum(axis=1)[:, None].conj() * 1j * pulls).real
        whole = np.zeros(angles_rad.shape)
        whole[0] = self._springs * (np.nan_to_num(angles_rad[0]) - self._base)
        whole[:-1] += 0.5 * bend - twist
        whole[1:] += 0.5 * bend + twist
        return self.free(whole)

    def hessian(self, angles_rad: np.ndarray) -> np.ndarray:
        """Return the second derivative, symmetric, as lower bands (2n, free angles)."""
        _, pulls = self._cells(angles_rad)
        n = pulls.shape[1]
        bands = np.zeros((2 * n, self._count))
        first = self._index[0]
        bands[0, first[first >= 0]] = self._springs[first >= 0]
        shared = pulls.sum(axis=1)
        for i, j in itertools.product(range(n), repeat=2):
            bend = -self._weight * (pulls[:, i].conj() * pulls[:, j]).real
            if i == j:
                bend += self._weight * (shared.conj() * pulls[:, i]).real
            twist = np.where(self._on[:, i] & (i == j), self._twisting[i] / self._cells_mm, 0.0)
            for (at, before), (to, after) in itertools.product([(0, -1.0), (1, 1.0)], repeat=2):
                rows = self._index[at : len(self._cells_mm) + at, i]
                columns = self._index[to : len(self._cells_mm) + to, j]
                lower = (rows >= columns) & (columns >= 0)
                entries = (0.25 * bend + before * after * twist)[lower]
                np.add.at(bands, (rows[lower] - columns[lower], columns[lower]), entries)
        return bands

    def negative_eigenvalues(self, angles_rad: np.ndarray) -> int:
        """Return how many eigenvalues of the Hessian are below 0; none where the tubes are stable."""
        return int((eigvals_banded(self.hessian(angles_rad), lower=True) < 0.0).sum())

    def newton_step_rad(self, angles_rad: np.ndarray) -> float:
        """Return the largest change of an angle in the Newton step to the equilibrium of the cells."""
        lower = self.hessian(angles_rad)
        reach = len(lower) - 1
        both = np.zeros((2 * reach + 1, self._count))
        both[reach:] = lower
        for k in range(1, reach + 1):
            both[reach - k, k:] = lower[k, : self._count - k]
        return float(np.abs(solve_banded((reach, reach), both, self.gradient(angles_rad))).max())

    def _cells(self, angles_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return in every cell the turn of each tube, and what it pulls with, as complex numbers."""
        turns = np.where(self._on, np.diff(angles_rad, axis=0), 0.0)
        middle = np.where(self._on, 0.5 * (angles_rad[:-1] + angles_rad[1:]), 0.0)
        return turns, self._rest * np.exp(1j * middle)


def _nodes(tubes: Sequence[Tube], beta_mm: np.ndarray, cells: int) -> np.ndarray:
    """Return nodes about evenly spaced, among them all landmarks."""
    marks = {0.0}
    for tube, base in zip(tubes, beta_mm, strict=True):
        ends = [end for bend in tube.bends for end in (bend.from_mm, bend.to_mm)]
        marks |= {base + end for end in (*ends, tube.length_mm) if base + end > 0.0}
    places = sorted(marks)
    places = [places[0], *(b for a, b in itertools.pairwise(places) if b - a > 1e-9)]
    spacing = places[-1] / cells
    pieces = [
        np.linspace(a, b, max(2, round((b - a) / spacing)) + 1)[:-1] for a, b in itertools.pairwise(places)
    ]
    return np.concatenate([*pieces, places[-1:]])
