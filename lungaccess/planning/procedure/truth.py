"""What really happens in one attempt: the devices as they go, and what is measured of them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from anatomy import poses
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from lungaccess.plans.parts import NeedlePath
from lungaccess.plans.plan import Plan
from lungaccess.uncertainty.risk.deviations import Deviations, deviated_pieces
from lungaccess.uncertainty.risk.kernels import deviation as kernel
from stages.needle import ArcPath, arc_transform, tilt

ARCS = 12
"""Arcs of a needle that have errors of their own; those of further ones are the same again."""


@frozen_record
class Attempt:
    """The errors of one attempt: one row of `Deviations` with ARCS arcs, and the true scope tip."""

    errors: Deviations
    start: Float
    target_lps: Float

    def frame(self) -> Float:
        """Return the true pose of the scope's tip, LPS."""
        return poses.pose(self.start[:3], self.start[3:6], self.start[6:])

    def pieces(self, plan: Plan) -> Float:
        """Return the arcs `(P, 4)` of tubes and needle that carry out a plan, see `deviated_pieces`."""
        columns = np.arange(0 if plan.needle is None else len(plan.needle.arcs)) % ARCS
        fitted = replace(
            self.errors, roll_rad=self.errors.roll_rad[:, columns], stop_mm=self.errors.stop_mm[:, columns]
        )
        return np.asarray(deviated_pieces(plan, fitted)[0])

    def roll_rad(self, number: int) -> float:
        """Return the error of the angle of the needle's arc with a number."""
        return float(self.errors.roll_rad[0, number % ARCS])


def end_of(frame: Float, pieces: Float) -> Float:
    """Return the frame `(4, 4)` at the end of arcs `(P, 4)` from a frame."""
    for length, roll, curvature, _radius in pieces:
        frame = frame @ arc_transform(length, roll, curvature)
    return np.asarray(frame)


def as_measured(frame: Float, position_mm: float, direction_deg: float, noise: Float) -> Float:
    """Return a pose as it is measured with errors: `noise` has five standard normal numbers."""
    a, b = math.radians(direction_deg) * noise[:2]
    seen = frame @ tilt(math.hypot(a, b), math.atan2(b, a))
    seen[:3, 3] += position_mm * noise[2:5]
    return np.asarray(seen)


def path_of(needle: NeedlePath) -> ArcPath:
    """Return the needle of a plan as a path."""
    arcs = np.array([(arc.length_mm, arc.roll_rad, arc.curvature_per_mm) for arc in needle.arcs])
    return ArcPath(lps_from_start=np.asarray(needle.lps_from_start), arcs=arcs.reshape(-1, 3))


class SteeredTruth:
    """What really happens to a needle that is steered, under the errors of one attempt.

    Parameters
    ----------
    attempt : Attempt
    target : (3,) float64, LPS mm
        Where the target was found; it is not seen during the insertion.
    position_mm, direction_deg : float
        Errors of the sensor.
    rng : numpy.random.Generator
        Of the sensor's noise.
    """

    def __init__(
        self,
        attempt: Attempt,
        target: Float,
        position_mm: float,
        direction_deg: float,
        rng: np.random.Generator,
    ) -> None:
        self._attempt, self._target, self._rng = attempt, target, rng
        self._noise = position_mm, direction_deg
        self._rolls = 0
        self._lag = 0.0
        self._factor = float(attempt.errors.factor[0])

    def roll(self) -> None:
        """Turn the bevel: it does not end where it should."""
        self._lag = self._attempt.roll_rad(self._rolls)
        self._rolls += 1

    def bend(self, frame: Float, curvature: float, inserted_mm: float) -> tuple[float, float]:
        """Return direction and amount of the true curvature."""
        return self._lag, self._factor * curvature

    def measure(self, frame: Float, inserted_mm: float) -> tuple[Float, Float]:
        """Return the tip as the sensor has it, and the target as it was found."""
        return as_measured(frame, *self._noise, self._rng.standard_normal(5)), self._target


def with_stop(arcs: Float, error_mm: float) -> Float:
    """Return arcs `(A, 3)` whose end comes so much later, or earlier where that is negative."""
    ends = np.cumsum(arcs[:, 0])
    kept = np.minimum(ends, max(ends[-1] + min(error_mm, 0.0), 0.0))
    kept[-1] += max(error_mm, 0.0)
    return np.column_stack([np.diff(kept, prepend=0.0), arcs[:, 1:]])


def needle_pieces(arcs: Float, radius_mm: float) -> Float:
    """Return arcs `(A, 3)` of a needle as the kernel takes them, `(A, 4)`."""
    pieces = np.zeros((len(arcs), kernel.N_PIECE))
    pieces[:, [kernel.LENGTH, kernel.ROLL, kernel.CURVATURE]] = arcs
    pieces[:, kernel.RADIUS] = radius_mm
    return pieces


def carried_out(path: ArcPath, attempt: Attempt) -> Float:
    """Return the arcs `(A, 3)` of a needle that carries out a path blindly, in the path's own frame."""
    count = len(path.arcs)
    numbers = np.arange(count) % ARCS
    ends = np.cumsum(path.arcs[:, 0]) + attempt.errors.stop_mm[0, numbers]
    ends = np.maximum.accumulate(np.maximum(ends, 0.0))
    angles = np.cumsum(path.arcs[:, 1]) + attempt.errors.roll_rad[0, numbers]
    return np.column_stack(
        [np.diff(ends, prepend=0.0), np.diff(angles, prepend=0.0), attempt.errors.factor[0] * path.arcs[:, 2]]
    )
