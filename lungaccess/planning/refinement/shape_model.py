"""Tubes near a shape: polynomials of second order in their joints, from the mechanics."""

import itertools
import math
from functools import cache

import numpy as np

from anatomy.base.typed import Float
from lungaccess.planning.refinement.layout import CURVE_DEGREE, N_FEATURES
from stages.needle import arc_transform
from stages.tube import (
    DesignArrays,
    TubeShape,
    deployed,
    pieces_of_arcs,
    points_on_arcs,
    shape_of_arrays,
    with_any_sweep,
)

INSERTED_MM = 4.0
TURNED_RAD = math.radians(25.0)
"""The program moves joints at most so far: there the polynomials are off by a few hundredths of a
millimetre, which the slack of its constraints covers."""
PLACES = 4 * CURVE_DEGREE
"""Points to which the polynomial of a curve is fitted, so many that it does not swing between them."""


class ShapeModel:
    """The features of a design's shapes near one of them.

    Features are the Chebyshev coefficients of the curve by its share of the length, point, direction and +x
    of the tip, all in the frame of the scope tip, and what has to be free beside the tubes.

    Args:
        shape: The one about which the polynomials are made.
        most_mm: No tube is inserted farther.
        constant: Whether only that shape is asked for.

    Attributes:
        centre, lower, upper ((m,) float64): The joints of the shape and how far they may be moved: all
            insertions, the outermost tube first, in mm, then the rotations of the tubes whose turn changes
            the shape, in rad.
        matrix ((N_FEATURES, 1 + m + m (m + 1) / 2) float64): Of the terms of `terms`.
    """

    def __init__(
        self, design: DesignArrays, shape: TubeShape, most_mm: float, *, constant: bool = False
    ) -> None:
        self._design, self._shape, self._most_mm = design, shape, most_mm
        self.centre = joints_of(design, shape)
        self._steps = np.where(np.arange(len(self.centre)) < len(design.radii), INSERTED_MM, TURNED_RAD)
        self.lower, self.upper = self.centre - self._steps, self.centre + self._steps
        count = len(self.centre)
        self.matrix = np.zeros((N_FEATURES, 1 + count + count * (count + 1) // 2))
        self.matrix[:, 0] = _features(shape)
        if not constant:
            self._fit()

    def shape_at(self, joints: Float) -> TubeShape | None:
        """Return the shape of joints, put in order; None if a limit of the design is not kept."""
        return self._shape_at(self._design, joints)

    def _fit(self) -> None:
        loose = with_any_sweep(self._design)
        unit, count = np.eye(len(self.centre)), len(self.centre)
        moves = [size * unit[m] for m in range(count) for size in (1.0, -1.0, 0.5, -0.5)]
        for one, other in itertools.combinations(range(count), 2):
            moves += [a * unit[one] + b * unit[other] for a in (0.6, -0.6) for b in (0.6, -0.6)]
        rows, values = [], []
        for move in moves:
            made = self._shape_at(loose, self.centre + move * self._steps)
            if made is not None:
                rows.append(terms(joints_of(self._design, made) - self.centre)[1:])
                values.append(_features(made) - self.matrix[:, 0])
        if rows:
            scale = terms(self._steps)[1:]
            fitted = np.linalg.lstsq(np.array(rows) / scale, np.array(values), rcond=1e-9)[0]
            self.matrix[:, 1:] = fitted.T / scale

    def _shape_at(self, design: DesignArrays, joints: Float) -> TubeShape | None:
        n = len(design.radii)
        inserted, turned = np.clip(joints[:n], 0.0, self._most_mm), np.array(self._shape.rotations_rad)
        # A shape nearby is at least so long.
        inserted = np.minimum.accumulate(np.maximum(inserted, 0.5 * (np.arange(n) == n - 1))[::-1])
        turned[design.turned] = joints[n:]
        made = deployed(design, inserted, turned)
        return None if made is None else shape_of_arrays(made)


def terms(moved: Float) -> Float:
    """Return 1, the moves of the joints `(m,)`, and their products in pairs."""
    pairs = itertools.combinations_with_replacement(range(len(moved)), 2)
    return np.array([1.0, *moved, *(moved[a] * moved[b] for a, b in pairs)])


def joints_of(design: DesignArrays, shape: TubeShape) -> Float:
    """Return the joints of a shape as a `ShapeModel` has them."""
    return np.concatenate([shape.insertions_mm[::-1], shape.rotations_rad[design.turned]])


def _features(shape: TubeShape) -> Float:
    length = float(shape.arcs[:, 0].sum())
    shares, inverse = _curve_fit()
    points = points_on_arcs(shape.arcs, np.eye(4), 0.0, length * shares)
    frame = np.eye(4)
    for part, roll, curvature in pieces_of_arcs(shape.arcs, 0.0).tolist():
        frame = frame @ arc_transform(part, roll, curvature)
    frame = frame @ arc_transform(0.0, -float(shape.arcs[-1, 1]), 0.0)
    tip = [frame[:3, 3], frame[:3, 2], frame[:3, 0], [shape.required_beside_mm]]
    return np.concatenate([(inverse @ points).ravel(), *tip])


@cache
def _curve_fit() -> tuple[Float, Float]:
    """Return shares of the length, and what maps points there to Chebyshev coefficients."""
    at = np.cos(math.pi * (np.arange(PLACES) + 0.5) / PLACES)
    inverse = np.linalg.pinv(np.polynomial.chebyshev.chebvander(at, CURVE_DEGREE))
    return 0.5 * (at + 1.0), np.asarray(inverse, dtype=np.float64)
