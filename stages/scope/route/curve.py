"""A cubic B-spline in space: interpolation and sampling."""

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.grid import read_only
from stages.scope.route.kernels import spline as kernel

DEGREE = 3
"""Cubic splines, as in [Li2021]: their curvature is continuous."""


@frozen_record
class Curve:
    """A clamped cubic B-spline; n control points, M = n - 3 spans, twice continuously differentiable.

    Args:
        control_mm: (n, 3) float64, LPS mm.
        knots ((n + 4,) float64): About arc length in mm; four equal ones at each end, simple ones between.

    Raises:
        SettingsError: If the arrays do not make such a spline.
    """

    control_mm: Float
    knots: Float

    def __post_init__(self) -> None:
        control = np.array(self.control_mm, dtype=np.float64)
        knots = np.array(self.knots, dtype=np.float64)
        clamped = (
            control.ndim == 2
            and control.shape[1] == 3
            and len(control) > DEGREE
            and knots.shape == (len(control) + 4,)
            and np.isfinite(control).all()
            and (knots[:4] == knots[0]).all()
            and (knots[-4:] == knots[-1]).all()
            and (np.diff(knots[3:-3]) > 0).all()
        )
        if not clamped:
            raise SettingsError(
                f"A curve has {control.shape} control points and {knots.shape} knots",
                expected="(n, 3) finite control points, n > 3, and n + 4 knots, clamped and rising inside",
            )
        object.__setattr__(self, "control_mm", read_only(control))
        object.__setattr__(self, "knots", read_only(knots))

    @property
    def n_spans(self) -> int:
        """Number of polynomial pieces, M."""
        return len(self.control_mm) - DEGREE

    @property
    def breaks(self) -> Float:
        """Ends of the spans in the parameter, `(M + 1,)`."""
        return np.asarray(self.knots[DEGREE:-DEGREE])

    def at(self, parameters: ArrayLike) -> Float:
        """Return points and first and second derivatives, `(3, S, 3)`, at rising parameters `(S,)`."""
        values = np.ascontiguousarray(np.asarray(parameters, dtype=np.float64).reshape(-1))
        out = np.zeros((3, len(values), 3))
        kernel.evaluate(self.control_mm, self.knots, values, out)
        return out

    def parameters(self, per_span: int) -> Float:
        """Return parameters that divide each span evenly, `(per_span * M + 1,)`, with all its ends."""
        begin, width = self.breaks[:-1], np.diff(self.breaks)
        inner = begin[:, None] + width[:, None] * (np.arange(per_span) / per_span)
        return np.append(inner.ravel(), self.breaks[-1])

    def sampled(self, per_span: int = 16) -> Float:
        """Return points of the curve, `(per_span * M + 1, 3)` mm, both ends included."""
        return np.asarray(self.at(self.parameters(per_span))[0])

    def curvature_per_mm(self, parameters: ArrayLike) -> Float:
        """Return the curvature in 1/mm at rising parameters, `(S,)`: `|c' x c''| / |c'|^3`."""
        _point, first, second = self.at(parameters)
        bent = np.linalg.norm(np.cross(first, second), axis=1)
        return np.asarray(bent / np.linalg.norm(first, axis=1) ** 3)

    def length_mm(self, per_span: int = 16) -> float:
        """Return the length, as the sum of `per_span` chords a span."""
        return float(np.linalg.norm(np.diff(self.sampled(per_span), axis=0), axis=1).sum())


def interpolate(points_mm: ArrayLike) -> Curve:
    """Return the cubic spline through points `(n, 3)`, with the length of the polyline as its parameter.

    Points closer than 1e-6 mm to the one before are left out, and midpoints are added to fewer than four.

    Raises:
        SettingsError: If fewer than two different points are given.
    """
    from scipy.interpolate import make_interp_spline

    points = np.asarray(points_mm, dtype=np.float64)
    points = points[np.append(True, np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-6)]
    if len(points) < 2:
        raise SettingsError(
            "A route needs two different points",
            expected="start and goal apart",
            remedy="Choose another goal or start",
        )
    while len(points) <= DEGREE:
        middle = 0.5 * (points[:-1] + points[1:])
        points = np.vstack((np.stack((points[:-1], middle), axis=1).reshape(-1, 3), points[-1]))
    along = np.concatenate(((0.0,), np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))))
    spline = make_interp_spline(along, points, k=DEGREE)
    return Curve(control_mm=spline.c, knots=spline.t)
