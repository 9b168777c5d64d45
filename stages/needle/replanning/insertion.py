"""Insertion of a needle step by step: what is commanded, where the planner believes it is, where it is.

Every few millimetres the tip and the target are measured, and a `Replanner` makes a new path from there.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from anatomy.base.typed import Float
from stages.needle.environment import NeedleEnvironment
from stages.needle.kernels import limits as index
from stages.needle.kernels.proof import blocker_on_arc
from stages.needle.path import LENGTH, ROLL, ArcPath, arc_transform, bend_direction
from stages.needle.query import Query
from stages.needle.replanning.reaiming import pose_at
from stages.needle.replanning.replanner import Failure, Replan, Replanner

GAIN = 0.3
"""Share of a measurement that is believed: over the few millimetres between two of them, dead reckoning
is more exact than a tracker."""


class Truth(Protocol):
    """What really happens to needle and target."""

    def roll(self) -> None:
        """Turn the bevel."""

    def bend(self, frame: Float, curvature: float, inserted_mm: float) -> tuple[float, float]:
        """Return direction (rad about +z from +x of a frame) and amount (1/mm) of the true curvature."""

    def measure(self, frame: Float, inserted_mm: float) -> tuple[Float, Float] | None:
        """Return tip frame and target as they are measured; None if the measurement is lost."""


def tilt(angle: float, towards: float) -> Float:
    """Return the rotation (4, 4) that tilts +z by an angle, towards a direction counted from +x."""
    tilted = arc_transform(1.0, towards, angle)
    tilted[:3, 3] = 0.0
    return np.asarray(tilted @ arc_transform(0.0, -towards, 0.0))


class TrueNeedle:
    """The true needle: where its tip is, and how it came there.

    Attributes
    ----------
    frame : (4, 4) float64
    inserted_mm : float
        Length of needle from its first start to the tip.
    label : int
        Label of what it has hit, 0 for nothing; it is for heirs to look.
    arcs : list of (float, float, float)
        Length, roll and curvature of all arcs so far, as those of an `ArcPath`.
    """

    def __init__(self, truth: Truth, lps_from_tip: Float, inserted_mm: float) -> None:
        self._truth = truth
        self._turned = 0.0
        self.frame = np.array(lps_from_tip)
        self.inserted_mm = inserted_mm
        self.label = 0
        self.arcs: list[tuple[float, float, float]] = []

    def roll(self, angle: float) -> None:
        """Roll at the base."""
        if angle != 0.0:
            self.frame = self.frame @ arc_transform(0.0, angle, 0.0)
            self._turned += angle
            self._truth.roll()

    def insert(self, length: float, curvature: float) -> None:
        """Insert by a step within which the errors are constant."""
        towards, bent = self._truth.bend(self.frame, curvature, self.inserted_mm + 0.5 * length)
        self.label = self.touched(towards, bent, length)
        self.frame = self.frame @ arc_transform(length, towards, bent) @ arc_transform(0.0, -towards, 0.0)
        self.arcs.append((length, self._turned + towards, bent))
        self._turned = -towards
        self.inserted_mm += length

    def touched(self, towards: float, curvature: float, length: float) -> int:
        """Return the label of what the next arc hits."""
        return 0


class Belief:
    """Where the planner takes tip and target to be: dead reckoning, corrected by each measurement."""

    def __init__(self, query: Query, gain: float) -> None:
        self._gain = gain
        self.frame = np.array(query.lps_from_start)
        self.target = query.target

    def roll(self, angle: float) -> None:
        """Roll as commanded."""
        self.frame = self.frame @ arc_transform(0.0, angle, 0.0)

    def insert(self, length: float, curvature: float) -> None:
        """Insert as commanded."""
        self.frame = self.frame @ arc_transform(length, 0.0, curvature)

    def correct(self, seen: Float, target: Float) -> None:
        """Take a measurement into account; it says nothing about the roll."""
        x, y, z = (float(v) for v in self.frame[:3, :3].T @ seen[:3, 2])
        moved = self.frame[:3, 3] + self._gain * (seen[:3, 3] - self.frame[:3, 3])
        self.frame = self.frame @ tilt(self._gain * math.atan2(math.hypot(x, y), z), math.atan2(y, x))
        self.frame[:3, 3] = moved
        self.target = self.target + self._gain * (target - self.target)


class Commands:
    """What the needle is told to do: the arcs of a plan, in small pieces."""

    def __init__(self, plan: ArcPath) -> None:
        self._arcs = plan.arcs
        self._arc = 0
        self._done_mm = 0.0

    @property
    def finished(self) -> bool:
        return self._arc >= len(self._arcs)

    @property
    def left_mm(self) -> float:
        """What is left of the arc."""
        return float(self._arcs[self._arc, LENGTH]) - self._done_mm

    def give(self, needle: TrueNeedle, belief: Belief, longest_mm: float) -> None:
        """Let the needle do a piece of the arc, and roll before a new one."""
        length = min(longest_mm, self.left_mm)
        if self.left_mm - length < index.MIN_ARC_MM:
            length = self.left_mm
        _length, roll, curvature = (float(v) for v in self._arcs[self._arc])
        for body in (needle, belief):
            if self._done_mm == 0.0:
                body.roll(roll)
            body.insert(length, curvature)
        self._done_mm += length
        if self.left_mm <= 0.0:
            self._arc += 1
            self._done_mm = 0.0

    def rest(self, frame: Float) -> ArcPath:
        """Return what is left, from another pose."""
        arcs = np.array(self._arcs[self._arc :])
        if self._done_mm > 0.0:
            arcs[0, LENGTH], arcs[0, ROLL] = self.left_mm, 0.0
        return ArcPath(lps_from_start=frame, arcs=arcs)


def steer(
    environment: NeedleEnvironment,
    truth: Truth,
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
    """Insert a needle by a plan until it is done, stops or hits something; return the replans, and why.

    A measurement is followed by a replan, if the last one is far enough back.  If that finds no path, the
    needle goes on by the old one as long as this, moved to where the tip is taken to be, is proved clear;
    otherwise it stops.

    Parameters
    ----------
    branch : int
        Pierced branch, see `Query`.
    step_mm : float
        Piece of needle within which the errors are constant.
    measure_every_mm : float
        Insertion between two measurements; infinite for open loop.
    replan_every_mm : float
        Least insertion between two replans.
    """
    commands = Commands(plan)
    replans: list[Replan] = []
    longest_mm = environment.limits.max_length_mm
    measure_mm = needle.inserted_mm + measure_every_mm
    replan_mm = needle.inserted_mm + replan_every_mm
    while not (commands.finished or needle.label):
        if needle.inserted_mm >= measure_mm - index.TINY:
            measure_mm += measure_every_mm
            seen = truth.measure(needle.frame, needle.inserted_mm)
            if seen is None:
                continue
            belief.correct(*seen)
            if needle.inserted_mm < replan_mm - index.TINY:
                continue
            replan_mm = needle.inserted_mm + replan_every_mm
            replans.append(replanner.replan(belief.frame, belief.target, needle.inserted_mm))
            path = replans[-1].path
            if path is not None:
                commands = Commands(path)
                continue
            if not _is_clear(environment, commands.rest(belief.frame), needle.inserted_mm, branch):
                return tuple(replans), replans[-1].failure
        if needle.inserted_mm >= longest_mm - index.MIN_ARC_MM:
            return tuple(replans), Failure.OUT_OF_LENGTH
        left_mm = min(measure_mm, longest_mm) - needle.inserted_mm
        commands.give(needle, belief, min(step_mm, left_mm))
    return tuple(replans), None


def _is_clear(environment: NeedleEnvironment, path: ArcPath, inserted_mm: float, branch: int) -> bool:
    for frame, (length, roll, curvature) in zip(path.frames(), path.arcs, strict=False):
        bend = (float(curvature), *(float(v) for v in bend_direction(frame, roll)))
        pose = pose_at(frame)
        if blocker_on_arc(
            environment.obstacles, environment.limits, pose, bend, float(length), inserted_mm, branch
        ):
            return False
        inserted_mm += float(length)
    return True
