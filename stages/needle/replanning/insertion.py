"""Insertion of a needle step by step: what is commanded, where the planner believes it is, where it is.

Every few millimetres the tip and the target are measured, and a `Replanner` makes a new path from there.

What is believed is an extended Kalman filter [Kalman1960] of three errors of the tip's place, three of its
orientation, and one of the logarithm of a factor: the true curvature over the commanded one.  A tracker sees
neither the roll nor the factor; both show in where the tip goes.
"""

import math
from dataclasses import field
from typing import Protocol

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from stages.needle.environment import NeedleEnvironment
from stages.needle.kernels import proof as index
from stages.needle.path import LENGTH, ROLL, ArcPath, Query, arc_transform, blocker_on_path
from stages.needle.replanning.replanner import Failure, Replan, Replanner

DRIFT_RAD = math.radians(0.1)
"""Standard deviation of what the direction drifts in 1 mm beside all that is modelled [assumption]."""
LEAST = 1e-5
"""A measurement is taken to be no better than this, mm or rad, so that exact ones can be weighed as well."""
_TINY = 1e-9
FACTORS = (0.25, 4.0)
"""Factors beyond these are not believed: a needle that goes straight has no curvature to steer by."""
PLACE, TURN, BEND = slice(0, 3), slice(3, 6), 6


@frozen_record
class Unknown:
    """What is not known of a needle, and how exactly it is measured, all as standard deviations.

    Args:
        start ((6, 6) float64): Covariance of the pose at the start, mm, and rad as a rotation vector, LPS;
            the roll is set from outside, so that its part does not count.
        factor, factor_ln: Median of true over commanded curvature, and spread of its logarithm, 0 if known.
        roll_rad: Of the direction of the bevel each time that it is rolled.
        target_mm: Of the target along each axis.
        tip_mm, tip_rad, seen_target_mm: Of a measured tip along each axis and about two, and of a target.
    """

    start: Float = field(default_factory=lambda: np.zeros((6, 6)))
    factor: float = 1.0
    factor_ln: float = 0.0
    roll_rad: float = 0.0
    target_mm: float = 0.0
    tip_mm: float = 0.0
    tip_rad: float = 0.0
    seen_target_mm: float = 0.0


def tilt(angle: float, towards: float) -> Float:
    """Return the rotation (4, 4) that tilts +z by an angle, towards a direction counted from +x."""
    tilted = arc_transform(1.0, towards, angle)
    tilted[:3, 3] = 0.0
    return np.asarray(tilted @ arc_transform(0.0, -towards, 0.0))


class Belief:
    """What is believed of a needle that is inserted: dead reckoning, corrected by each measurement.

    `frame` `(4, 4)` is the most likely pose of the tip, +x towards the bend, `target` `(3,)` that of the
    target, LPS mm; by `lag_rad` the bevel is most likely turned farther than commanded.

    Args:
        query: Pose and target as they are taken to be at the start.
        latency_mm: Insertion between a measurement and its use; what was commanded meanwhile is added to it.
    """

    def __init__(self, query: Query, unknown: Unknown, latency_mm: float = 0.0) -> None:
        self._unknown, self._latency_mm = unknown, latency_mm
        self.frame, self.target, self.lag_rad = np.array(query.lps_from_start), query.target, 0.0
        self._covariance = np.zeros((7, 7))
        self._covariance[:6, :6] = unknown.start
        self._covariance[BEND, BEND] = unknown.factor_ln**2
        self._roll_errs_by(0.0)
        self._target_variance = unknown.target_mm**2
        self._ln = math.log(unknown.factor)
        self._reckoned, self._at_mm = [self.frame], [0.0]

    @property
    def factor(self) -> float:
        """Most likely true curvature over the commanded one."""
        return math.exp(self._ln)

    @property
    def factor_ln(self) -> float:
        """Standard deviation of the logarithm of the factor."""
        return math.sqrt(max(float(self._covariance[BEND, BEND]), 0.0))

    def roll(self, angle: float) -> None:
        """Roll at the base: the bevel then errs anew, whatever it erred by before."""
        if angle == 0.0:
            return
        self._move(arc_transform(0.0, angle - self.lag_rad, 0.0))
        self.lag_rad = 0.0
        self._roll_errs_by(self._unknown.roll_rad)

    def insert(self, length: float, curvature: float) -> None:
        """Insert by an arc of a commanded curvature."""
        bent = self.factor * curvature
        moves, before = np.eye(7), self.frame[:3, 3]
        moves[:6, BEND] = self._bent_more(length, bent)
        self._move(arc_transform(length, 0.0, bent))
        x, y, z = (self.frame[:3, 3] - before).tolist()
        moves[PLACE, TURN] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
        self._covariance = moves @ self._covariance @ moves.T
        self._covariance[TURN, TURN] += DRIFT_RAD**2 * length * np.eye(3)
        # Share of the factor's own uncertainty by which it changes in 1 mm, as tissue differs [assumption].
        self._covariance[BEND, BEND] += (0.05 * self._unknown.factor_ln) ** 2 * length
        self._at_mm[-1] += length

    def correct(self, seen: Float, target: Float | None = None) -> None:
        """Take a measured pose into account, whose roll says nothing, and a target if it is seen."""
        then = max(self._at_mm[-1] - self._latency_mm, 0.0)
        row = int(np.searchsorted(self._at_mm, then + _TINY, side="right")) - 1
        seen = seen @ np.linalg.inv(self._reckoned[row]) @ self._reckoned[-1]
        axes, ahead = self.frame[:3, :2].T, self.frame[:3, 2]
        looks = np.zeros((5, 7))
        looks[:3, PLACE], looks[3:, TURN] = np.eye(3), axes
        across = np.cross(ahead, seen[:3, 2])
        sine = float(np.linalg.norm(across))
        turn = across * (math.atan2(sine, float(ahead @ seen[:3, 2])) / max(sine, _TINY))
        gap = np.concatenate([seen[:3, 3] - self.frame[:3, 3], axes @ turn])
        noise = np.diag(np.maximum([self._unknown.tip_mm] * 3 + [self._unknown.tip_rad] * 2, LEAST) ** 2)
        seen_with = looks @ self._covariance
        gain = np.linalg.solve(seen_with @ looks.T + noise, seen_with).T
        # In this form rounding makes no variance negative, however exact a measurement is.
        left = np.eye(7) - gain @ looks
        self._covariance = left @ self._covariance @ left.T + gain @ noise @ gain.T
        self._step(gain @ gap)
        if target is not None:
            variance = self._target_variance
            share = variance / max(variance + self._unknown.seen_target_mm**2, LEAST**2)
            self.target = self.target + share * (target - self.target)
            self._target_variance *= 1.0 - share

    def _roll_errs_by(self, size: float) -> None:
        """Forget what was believed of the roll, whose error is from now on of another size, rad."""
        about = np.outer(self.frame[:3, 2], self.frame[:3, 2])
        kept = np.eye(7)
        kept[TURN, TURN] -= about
        self._covariance = kept @ self._covariance @ kept.T
        self._covariance[TURN, TURN] += size**2 * about

    def _bent_more(self, length: float, bent: float) -> Float:
        """Return what one unit of the factor's logarithm moves the tip by on an arc, `(6,)`, mm and rad."""
        turn, (side, up, ahead) = bent * length, self.frame[:3, :3].T
        aside, short = 0.5 * turn * length, -turn * turn * length / 3.0
        if abs(turn) > 1e-3:
            aside = length * math.sin(turn) - (1.0 - math.cos(turn)) / bent
            short = length * math.cos(turn) - math.sin(turn) / bent
        return np.concatenate([aside * side + short * ahead, turn * up])

    def _move(self, transform: Float) -> None:
        self.frame = self.frame @ transform
        self._reckoned.append(self._reckoned[-1] @ transform)
        self._at_mm.append(self._at_mm[-1])

    def _step(self, step: Float) -> None:
        """Change what is believed by what a measurement says."""
        angle = float(np.linalg.norm(step[TURN]))
        x, y, z = (step[TURN] / max(angle, _TINY)).tolist()
        across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        turn = np.eye(3) + math.sin(angle) * across + (1.0 - math.cos(angle)) * across @ across
        self.lag_rad += float(step[TURN] @ self.frame[:3, 2])
        frame = np.array(self.frame)
        frame[:3, 3] += step[PLACE]
        frame[:3, :3] = turn @ frame[:3, :3]
        self.frame = frame
        self._ln = min(max(self._ln + float(step[BEND]), math.log(FACTORS[0])), math.log(FACTORS[1]))


class Truth(Protocol):
    """What really happens to needle and target."""

    def roll(self) -> None:
        """Turn the bevel."""

    def bend(self, frame: Float, curvature: float, inserted_mm: float) -> tuple[float, float]:
        """Return direction (rad about +z from +x of a frame) and amount (1/mm) of the true curvature."""

    def measure(self, needle: "TrueNeedle") -> tuple[Float, Float | None] | None:
        """Return the tip as it is measured, and the target if it is seen; None if the measurement is lost."""


class TrueNeedle:
    """The true needle: where its tip is, and how it came there.

    Attributes:
        frame: (4, 4) float64.
        inserted_mm: Length of needle from its first start to the tip.
        arcs (list of (float, float, float)): Length, roll and curvature of all arcs so far, see `ArcPath`.
    """

    def __init__(self, truth: Truth, lps_from_tip: Float, inserted_mm: float) -> None:
        self._truth, self._turned = truth, 0.0
        self.frame, self.inserted_mm = np.array(lps_from_tip), inserted_mm
        self.arcs: list[tuple[float, float, float]] = []
        self._frames, self._lengths = [self.frame], [inserted_mm]

    def roll(self, angle: float) -> None:
        """Roll at the base."""
        if angle != 0.0:
            self.frame = self.frame @ arc_transform(0.0, angle, 0.0)
            self._frames[-1] = self.frame
            self._turned += angle
            self._truth.roll()

    def insert(self, length: float, curvature: float) -> None:
        """Insert by a step within which the errors are constant."""
        towards, bent = self._truth.bend(self.frame, curvature, self.inserted_mm + 0.5 * length)
        self.frame = self.frame @ arc_transform(length, towards, bent) @ arc_transform(0.0, -towards, 0.0)
        self.arcs.append((length, self._turned + towards, bent))
        self._turned = -towards
        self.inserted_mm += length
        self._frames.append(self.frame)
        self._lengths.append(self.inserted_mm)

    def measure(self) -> tuple[Float, Float | None] | None:
        """Return tip and target as they are measured now, see `Truth`."""
        return self._truth.measure(self)

    def frame_at(self, inserted_mm: float) -> Float:
        """Return where the tip was when it was inserted by a length, or at the last step before."""
        row = int(np.searchsorted(self._lengths, inserted_mm + index.TINY, side="right")) - 1
        return self._frames[max(row, 0)]


class Commands:
    """What the needle is told to do: the arcs of a plan, in small pieces, up to a curvature that can be had.

    A needle that bends more than it is told is told to bend less, as by spinning it for a part of the time;
    one that bends less is told to bend more, as far as it can.
    """

    def __init__(self, plan: ArcPath, most_per_mm: float) -> None:
        self._arcs, self._most_per_mm = plan.arcs, most_per_mm
        self._arc, self._done_mm = 0, 0.0

    @property
    def finished(self) -> bool:
        return self._arc >= len(self._arcs)

    @property
    def left_mm(self) -> float:
        """What is left of the arc."""
        return float(self._arcs[self._arc, LENGTH]) - self._done_mm

    def give(self, belief: Belief, needle: TrueNeedle | None, longest_mm: float) -> None:
        """Go on by a piece of the arc, rolled before a new one; the needle is None where it is a real one."""
        length = min(longest_mm, self.left_mm)
        if self.left_mm - length < index.MIN_ARC_MM:
            length = self.left_mm
        _length, roll, curvature = (float(v) for v in self._arcs[self._arc])
        roll += belief.lag_rad
        told = min(curvature / belief.factor, self._most_per_mm)
        bodies: tuple[TrueNeedle | Belief, ...] = (belief,) if needle is None else (needle, belief)
        for body in bodies:
            if self._done_mm == 0.0:
                body.roll(roll)
            body.insert(length, told)
        self._done_mm += length
        if self.left_mm <= 0.0:
            self._arc, self._done_mm = self._arc + 1, 0.0

    def rest(self, frame: Float) -> ArcPath:
        """Return what is left, from another pose."""
        arcs = np.array(self._arcs[self._arc :])
        if self._done_mm > 0.0:
            arcs[0, LENGTH], arcs[0, ROLL] = self.left_mm, 0.0
        return ArcPath(lps_from_start=frame, arcs=arcs)


def steer(
    environment: NeedleEnvironment,
    needle: TrueNeedle,
    belief: Belief,
    plan: ArcPath,
    replanner: Replanner,
    *,
    branch: int,
    step_mm: float,
    measure_every_mm: float,
    replan_every_mm: float = 0.0,
) -> tuple[tuple[Replan, ...], Failure | None]:
    """Insert a needle by a plan until it is done or stops; return the replans, and why it stopped.

    A measurement, `measure_every_mm` apart (infinite for open loop), is followed by a replan, if the last one
    is at least `replan_every_mm` back, with the curvature that the needle is believed to reach.  If that
    finds no path, the needle goes on by the old one as long as this, moved to where the tip is taken to be,
    is proved clear; otherwise it stops.  Errors are constant within `step_mm` of needle.
    """
    most_per_mm = environment.limits.kappa
    commands = Commands(plan, most_per_mm)
    replans: list[Replan] = []
    longest_mm = environment.limits.max_length_mm
    measure_mm = needle.inserted_mm + measure_every_mm
    replan_mm = needle.inserted_mm + replan_every_mm
    while not commands.finished:
        if needle.inserted_mm >= measure_mm - index.TINY:
            measure_mm += measure_every_mm
            seen = needle.measure()
            if seen is None:
                continue
            belief.correct(*seen)
            if needle.inserted_mm < replan_mm - index.TINY:
                continue
            replan_mm = needle.inserted_mm + replan_every_mm
            replanner.curvature_share = min(belief.factor, 1.0)
            replans.append(replanner.replan(belief.frame, belief.target, needle.inserted_mm))
            path = replans[-1].path
            if path is not None:
                commands = Commands(path, most_per_mm)
                continue
            if blocker_on_path(environment, commands.rest(belief.frame), branch, needle.inserted_mm):
                return tuple(replans), replans[-1].failure
        if needle.inserted_mm >= longest_mm - index.MIN_ARC_MM:
            return tuple(replans), Failure.OUT_OF_LENGTH
        commands.give(belief, needle, min(step_mm, min(measure_mm, longest_mm) - needle.inserted_mm))
    return tuple(replans), None
