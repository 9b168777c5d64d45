"""What really happens in procedures: the devices with their errors, and what is measured of them."""

import math
from dataclasses import replace

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int
from lungaccess.planning.procedure.kernels.decisions import deviated_planar
from lungaccess.planning.procedure.policy import Chosen
from lungaccess.planning.procedure.spread import as_measured
from lungaccess.plans.plan import Plan
from lungaccess.problem.errors import ErrorModel
from lungaccess.problem.procedures import NeedleSteering
from lungaccess.uncertainty.risk.deviations import Deviations, in_rows, twisted_shapes
from lungaccess.uncertainty.risk.kernels import deviation as kernel
from lungaccess.uncertainty.risk.kernels.chain import TUBE_PIECES
from stages.needle import (
    ArcPath,
    Belief,
    Failure,
    NeedleEnvironment,
    Query,
    Replan,
    Replanner,
    TrueNeedle,
    Unknown,
    steer,
)

ARCS = 12
"""Arcs of a needle that have errors of their own; those of further ones are the same again."""


@frozen_record
class Attempt:
    """The errors of one attempt, one row of `Deviations` with ARCS arcs, and where its target really is."""

    errors: Deviations
    target_lps: Float


def fitted_to(n_arcs: int, errors: Deviations) -> Deviations:
    """Return errors of needles with a number of arcs, from those of needles with ARCS arcs."""
    columns = np.arange(n_arcs) % ARCS
    return replace(errors, roll_rad=errors.roll_rad[:, columns], stop_mm=errors.stop_mm[:, columns])


def rows_of(errors: Deviations, numbers: Int) -> Deviations:
    """Return the errors of some procedures, by their numbers."""
    return Deviations(**{name: values[numbers] for name, values in vars(errors).items() if name != "further"})


def tube_pieces(plan: Plan, chosen: Chosen, errors: Deviations) -> tuple[Float, Float]:
    """Return the arcs `(N, T, 4)` of the tubes as they really go, and how far their ends are overturned."""
    if len(chosen.tubes):
        pieces = np.zeros((errors.count, TUBE_PIECES, kernel.N_PIECE))
        deviated_planar(np.ascontiguousarray(chosen.tubes), in_rows(errors), pieces)
        return pieces, errors.rotation_rad
    made: list[tuple[Float, float]] = []
    for n, tube in enumerate(chosen.deployed):
        one = rows_of(errors, np.array([n]))
        shapes, rolled, which = twisted_shapes(replace(plan, tube=tube), one.insertion_mm, one.relative_rad)
        made.append((shapes[which[0]], float(rolled[which[0]])))
    pieces = np.zeros((len(made), max((len(each) for each, _ in made), default=1), kernel.N_PIECE))
    for n, (shape, _rolled) in enumerate(made):
        pieces[n, :, kernel.RADIUS] = shape[-1, kernel.RADIUS]
        pieces[n, : len(shape)] = shape
    pieces[:, 0, kernel.ROLL] += errors.rotation_rad
    return pieces, errors.rotation_rad + np.array([rolled for _, rolled in made])


def ends_of(frames: Float, pieces: Float) -> Float:
    """Return the poses `(N, 4, 4)` at the ends of chains `(N, P, 4)` from poses."""
    for piece in np.moveaxis(pieces, 1, 0):
        frames = turned_about(frames, piece[:, kernel.ROLL])
        length, curvature = piece[:, kernel.LENGTH], piece[:, kernel.CURVATURE]
        angle = length * curvature
        arc = np.tile(np.eye(4), (len(frames), 1, 1))
        arc[:, 0, 0] = arc[:, 2, 2] = np.cos(angle)
        arc[:, 0, 2], arc[:, 2, 0] = np.sin(angle), -np.sin(angle)
        arc[:, 2, 3] = length * np.sinc(angle / np.pi)
        arc[:, 0, 3] = 0.5 * length * angle * np.sinc(0.5 * angle / np.pi) ** 2
        frames = frames @ arc
    return frames


def turned_about(frames: Float, angles: Float) -> Float:
    """Return poses turned by angles `(N,)` about their +z."""
    turn = np.tile(np.eye(4), (len(frames), 1, 1))
    turn[:, 0, 0] = turn[:, 1, 1] = np.cos(angles)
    turn[:, 0, 1], turn[:, 1, 0] = -np.sin(angles), np.sin(angles)
    return np.asarray(frames @ turn)


def needles_carried_out(arcs: Float, counts: Int, errors: Deviations, longest_mm: float) -> Float:
    """Return the arcs `(N, A, 3)` of needles that carry out paths blindly, each in the frame of its path."""
    numbers = np.arange(arcs.shape[1])
    there = numbers < counts[:, None]
    columns = numbers % ARCS
    ends = np.cumsum(arcs[:, :, 0], axis=1) + errors.stop_mm[:, columns]
    ends = np.where(there, np.clip(ends, 0.0, longest_mm), 0.0)
    ends = np.maximum.accumulate(ends, axis=1)
    angles = np.where(there, np.cumsum(arcs[:, :, 1], axis=1) + errors.roll_rad[:, columns], 0.0)
    rolls = np.where(there, np.diff(angles, prepend=0.0, axis=1), 0.0)
    return np.stack(
        [np.diff(ends, prepend=0.0, axis=1), rolls, errors.factor[:, None] * arcs[:, :, 2]], axis=2
    )


class _SteeredTruth:
    """What really happens to a needle that is steered, under the errors of one attempt, and what is measured.

    Args:
        rng: Of the tracker's noise.
    """

    def __init__(self, attempt: Attempt, steering: NeedleSteering, rng: np.random.Generator) -> None:
        self._attempt, self._steering, self._rng = attempt, steering, rng
        self._rolls, self._lag = 0, 0.0
        self._factor = float(attempt.errors.factor[0])

    def roll(self) -> None:
        """Turn the bevel: it does not end where it should."""
        self._lag = float(self._attempt.errors.roll_rad[0, self._rolls % ARCS])
        self._rolls += 1

    def bend(self, frame: Float, curvature: float, inserted_mm: float) -> tuple[float, float]:
        """Return direction and amount of the true curvature."""
        return self._lag, self._factor * curvature

    def measure(self, needle: TrueNeedle) -> tuple[Float, Float | None] | None:
        """Return the tip as the tracker had it a while ago, and the target if it sees that; None if lost."""
        tracker = self._steering
        if self._rng.random() < tracker.lost_share:
            return None
        noise = self._rng.standard_normal(8)
        true = needle.frame_at(needle.inserted_mm - tracker.latency_mm)
        seen = as_measured(true, tracker.position_mm, tracker.direction_deg, noise[:5])
        if tracker.target_mm is None:
            return seen, None
        return seen, self._attempt.target_lps + tracker.target_mm * noise[5:]


def unknown_of(errors: ErrorModel, steering: NeedleSteering, start: Float) -> Unknown:
    """Return what is not known of a needle under an error model, watched by a tracker.

    Args:
        start ((6, 6) float64): Covariance of the pose in which it begins, see `Unknown`.
    """
    factor = errors.needle_curvature
    return Unknown(
        start=start, factor=factor.median, factor_ln=factor.size,
        roll_rad=math.radians(errors.needle_roll.rms), target_mm=errors.target_position.rms,
        tip_mm=steering.position_mm, tip_rad=math.radians(steering.direction_deg),
        seen_target_mm=steering.target_mm or 0.0,
    )  # fmt: skip


@frozen_record
class Steered:
    """What came of one needle that was measured and planned again on its way.

    Its true arcs `(A, 3)` begin at the true tip of the tubes; `factor` is what is believed in the end of the
    true curvature over the commanded one.
    """

    arcs: Float
    replans: tuple[Replan, ...]
    stopped: Failure | None
    factor: float


def insert_needle(
    environment: NeedleEnvironment,
    query: Query,
    path: ArcPath,
    replanner: Replanner,
    attempt: Attempt,
    true_tip: Float,
    steering: NeedleSteering,
    unknown: Unknown,
    rng: np.random.Generator,
) -> Steered:
    """Insert a needle from a true tip of the tubes, watched by a tracker and planned again on its way.

    It is planned for `query`, from where the tip is taken to be, and follows `path` first; in the environment
    it goes on without a new path as long as the old one is clear.  For the rest see `_SteeredTruth` and
    `Belief`.
    """
    needle = TrueNeedle(_SteeredTruth(attempt, steering, rng), true_tip, 0.0)
    belief = Belief(query, unknown, steering.latency_mm)
    replans, stopped = steer(
        environment, needle, belief, path, replanner, branch=query.branch, step_mm=steering.measure_every_mm,
        measure_every_mm=steering.measure_every_mm, replan_every_mm=steering.replan_every_mm,
    )  # fmt: skip
    arcs = np.array(needle.arcs).reshape(-1, 3)
    ends = with_stop(arcs, float(attempt.errors.stop_mm[0, 0])) if len(arcs) else arcs
    return Steered(arcs=ends, replans=replans, stopped=stopped, factor=belief.factor)


def with_stop(arcs: Float, error_mm: float) -> Float:
    """Return arcs `(A, 3)` whose end comes so much later, or earlier where that is negative."""
    ends = np.cumsum(arcs[:, 0])
    kept = np.minimum(ends, max(ends[-1] + min(error_mm, 0.0), 0.0))
    kept[-1] += max(error_mm, 0.0)
    return np.column_stack([np.diff(kept, prepend=0.0), arcs[:, 1:]])


def as_pieces(arcs: Float, radius_mm: float) -> Float:
    """Return arcs `(N, A, 3)` of needles as the kernel takes them, `(N, A, 4)`."""
    return np.concatenate([arcs, np.full((*arcs.shape[:2], 1), radius_mm)], axis=2)
