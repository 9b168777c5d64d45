"""A smooth displacement from pairs of landmarks, and how well half of the pairs predicts the other half."""

from collections.abc import Callable

import numpy as np

from anatomy.base.errors import AnatomyError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float

SMOOTHINGS = (1e2, 1e3, 1e4, 1e5)
"""From a spline that passes its pairs by a tenth of a mm to one that is nearly affine over a lung."""
LEAST_PAIRS = 20
"""In a lung: twice as many as a quadratic field has coefficients, so that either half determines one."""


@frozen_record
class Fitted:
    """A displacement field of one lung: `(N, 3)` LPS mm to `(N, 3)` mm, and its residuals in mm.

    `residual_mm` `(N,)` is that of the pairs themselves, `left_out_mm` `(N,)` that of each half of the pairs
    as the other half predicts it.
    """

    at: Callable[[Float], Float]
    residual_mm: Float
    left_out_mm: Float


def fit_landmarks(points: Float, vectors: Float, lung: str) -> Fitted:
    """Fit a thin-plate spline with the smoothness by which each half of the pairs predicts the other.

    Args:
        points ((N, 3) float64, LPS mm): Places in the masks.
        vectors ((N, 3) float64): Displacements, mm.
        lung: Whose they are, for messages.

    Raises:
        AnatomyError: If there are too few pairs, or they lie in a plane.
    """
    if len(points) < LEAST_PAIRS:
        raise AnatomyError(
            f"There are {len(points)} pairs of landmarks in the {lung} lung",
            expected=f"at least {LEAST_PAIRS} in each lung, spread over it",
            remedy="Mark more pairs; check that their coordinates are mm of the masks in the frame stated",
        )
    try:
        return _fitted(points, vectors)
    except np.linalg.LinAlgError as error:
        raise AnatomyError(
            f"The landmarks of the {lung} lung determine no field ({error})",
            expected="different points that do not all lie in one plane",
            remedy="Spread the landmarks over the lung, and state each once",
        ) from error


def _fitted(points: Float, vectors: Float) -> Fitted:
    halves = np.arange(len(points)) % 2 == 0
    errors = [_left_out(points, vectors, halves, smoothing) for smoothing in SMOOTHINGS]
    means = np.array([error.mean() for error in errors])
    # The smoothest spline is taken whose prediction is worse than the best by no more than this factor.
    chosen = int(np.flatnonzero(means <= 1.1 * means.min())[-1])
    at = _spline(points, vectors, SMOOTHINGS[chosen])
    residual = np.linalg.norm(at(points) - vectors, axis=1)
    return Fitted(at=at, residual_mm=residual, left_out_mm=errors[chosen])


def _left_out(points: Float, vectors: Float, half: Bool, smoothing: float) -> Float:
    """Return the errors `(N,)` of each half as the other predicts it."""
    out = np.zeros(len(points))
    for known in (half, ~half):
        predicted = _spline(points[known], vectors[known], smoothing)(points[~known])
        out[~known] = np.linalg.norm(predicted - vectors[~known], axis=1)
    return out


def _spline(points: Float, vectors: Float, smoothing: float) -> Callable[[Float], Float]:
    from scipy.interpolate import RBFInterpolator

    fitted = RBFInterpolator(points, vectors, kernel="thin_plate_spline", smoothing=smoothing, degree=1)
    return lambda at: np.asarray(fitted(at))
