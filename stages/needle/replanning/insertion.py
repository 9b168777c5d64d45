"""Insertion of a needle step by step: what is commanded, where the planner believes it is, where it is.

Every few millimetres the tip and the target are measured, and a `Replanner` makes a new path from there.
"""

from typing import Protocol

import numpy as np

from anatomy.base.typed import Float
from stages.needle.environment import NeedleEnvironment
from stages.needle.kernels import proof as index
from stages.needle.kernels.proof import blocker_on_arc
from stages.needle.path import LENGTH, ROLL, ArcPath, arc_transform, bend_direction
from stages.needle.replanning.belief import Belief
from stages.needle.replanning.reaiming import pose_at
from stages.needle.replanning.replanner import Failure, Replan, Replanner


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
        arcs (list of (float, float, float)): Length, roll and curvature of all arcs so far, as those of an
            `ArcPath`.
    """

    def __init__(self, truth: Truth, lps_from_tip: Float, inserted_mm: float) -> None:
        self._truth = truth
        self._turned = 0.0
        self.frame = np.array(lps_from_tip)
        self.inserted_mm = inserted_mm
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
    """What the needle is told to do: the arcs of a plan, in small pieces.

    A needle that bends more than it is told is told to bend less, as by spinning it for a part of the time;
    one that bends less is told to bend more, as far as it can.

    Args:
        most_per_mm: Greatest curvature that can be commanded.
    """

    def __init__(self, plan: ArcPath, most_per_mm: float) -> None:
        self._arcs, self._most_per_mm = plan.arcs, most_per_mm
        self._arc = 0
        self._done_mm = 0.0

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

    A measurement is followed by a replan, if the last one is far enough back, with the curvature that the
    needle is believed to reach.  If that finds no path, the needle goes on by the old one as long as this,
    moved to where the tip is taken to be, is proved clear; otherwise it stops.

    Args:
        branch: Pierced branch, see `Query`.
        step_mm: Piece of needle within which the errors are constant.
        measure_every_mm: Insertion between two measurements; infinite for open loop.
        replan_every_mm: Least insertion between two replans.
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
            if not _is_clear(environment, commands.rest(belief.frame), needle.inserted_mm, branch):
                return tuple(replans), replans[-1].failure
        if needle.inserted_mm >= longest_mm - index.MIN_ARC_MM:
            return tuple(replans), Failure.OUT_OF_LENGTH
        left_mm = min(measure_mm, longest_mm) - needle.inserted_mm
        commands.give(belief, needle, min(step_mm, left_mm))
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
