"""Insertion of a needle that does not follow its plan exactly, with and without replanning on the way.

Every few millimetres a tracker tells where the tip and the target seem to be.  In closed loop the planner
then makes a new path from there; in open loop the first plan is carried out blindly.
"""

from __future__ import annotations

import math
from enum import StrEnum

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.grid import read_only
from anatomy.kernels.field import bounds_at, exact_at
from lungaccess.planning.procedure.insertion.tracking import DelayedBelief, SimulatedTracker, TrackedTruth
from lungaccess.planning.procedure.insertion.truth import Errors, Truth
from stages.needle import (
    DEFAULT_SETTINGS,
    GAIN,
    ITERATIONS,
    SHORTEST,
    ArcPath,
    Failure,
    NeedleEnvironment,
    Objective,
    Query,
    Replan,
    Replanner,
    ReplanSettings,
    TrueNeedle,
    bend_direction,
    blocker_on_arc,
    pose_at,
    steer,
    structure_name,
    with_limits,
)

STEP_MM = 0.25
TOLERANCE_MM = 2.0

WIDEST_CLEARANCE_MM = 200.0


class Outcome(StrEnum):
    """How an insertion ended."""

    REACHED = "reached"
    MISSED = "missed"
    HIT = "hit an obstacle"
    NO_PATH = "no path left"
    OUT_OF_LENGTH = "out of length"


@frozen_record
class Insertion:
    """What happened to one needle.

    Parameters
    ----------
    lps_from_tip : (N, 4, 4) float64
        Where the tip really was, the start first.
    inserted_mm : (N,) float64
        Length of needle at each of these poses, counted from its first start.
    outcome : Outcome
    label : int
        Label of the voxel that was hit, 0 if none.
    target_lps : (3,) float64, LPS mm
        Where the target really is in the end.
    tip_error_mm : float
        Distance from the tip to it, wherever the insertion ended.
    clearance_mm : float
        Smallest distance from the needle's surface to an obstacle at these poses; after a hit about 0 or
        negative.  The wall of the pierced branch does not count as long as it is exempt.
    replans : tuple of Replan
    """

    lps_from_tip: Float
    inserted_mm: Float
    outcome: Outcome
    label: int
    target_lps: Float
    tip_error_mm: float
    clearance_mm: float
    replans: tuple[Replan, ...]

    @property
    def structure(self) -> str:
        """Name of what was hit, '' if nothing was."""
        return structure_name(self.label) if self.label else ""


class _Needle(TrueNeedle):
    """The true needle, and whether its surface has hit something."""

    def __init__(self, environment: NeedleEnvironment, query: Query, truth: Truth) -> None:
        super().__init__(truth, query.lps_from_start, query.inserted_mm)
        self._environment = with_limits(environment, required_mm=environment.needle.radius_mm)
        self._branch = query.branch
        self.frames, self.lengths = [self.frame], [self.inserted_mm]

    def roll(self, angle: float) -> None:
        """Roll at the base: the tip stays where it is."""
        super().roll(angle)
        self.frames[-1] = self.frame

    def insert(self, length: float, curvature: float) -> None:
        """Insert by a small step."""
        super().insert(length, curvature)
        self.frames.append(self.frame)
        self.lengths.append(self.inserted_mm)

    def touched(self, towards: float, curvature: float, length: float) -> int:
        """Return the label of what the next arc hits, exactly."""
        bend = (curvature, *(float(v) for v in bend_direction(self.frame, towards)))
        return int(
            blocker_on_arc(
                self._environment.obstacles, self._environment.limits, pose_at(self.frame), bend, length,
                self.inserted_mm, self._branch,
            )
        )  # fmt: skip


def simulate(
    environment: NeedleEnvironment,
    query: Query,
    plan: ArcPath,
    errors: Errors,
    *,
    closed_loop: bool,
    seed: int,
    step_mm: float = STEP_MM,
    tolerance_mm: float = TOLERANCE_MM,
    gain: float = GAIN,
    objective: Objective = SHORTEST,
    replanning: ReplanSettings = DEFAULT_SETTINGS,
    iterations: int = ITERATIONS,
) -> Insertion:
    """Insert a needle by a plan that it does not follow exactly.

    In closed loop every measurement is followed by a replan.  If that finds no path, the needle goes on by
    the old one as long as this, moved to where the tip is taken to be, is proved clear; otherwise it stops.
    An obstacle is hit where the needle's surface comes nearer than 0.005 mm to it on its true path; there
    the insertion ends.

    Parameters
    ----------
    environment : NeedleEnvironment
        With all of the needle's curvature.  The planner keeps the required clearance, the judge the radius.
    query : Query
        What the plan was made for.
    plan : ArcPath
    errors : Errors
    closed_loop : bool
        Whether to measure and replan on the way.
    seed : int
        The same seed is the same needle and the same motion of the target, open loop or closed.
    step_mm : float
        Piece of needle within which the errors are constant.
    tolerance_mm : float
        A tip that ends no farther from the target has reached it.
    gain : float
        Share of a measurement by which dead reckoning is corrected; 1 trusts the tracker alone.
    objective, replanning, iterations
        See `Replanner`.

    Raises
    ------
    SettingsError
        If the step is not above 0, the tolerance negative, or the gain not above 0 or above 1.
    """
    if not (0.0 < step_mm < math.inf and 0.0 <= tolerance_mm < math.inf and 0.0 < gain <= 1.0):
        raise SettingsError(
            f"A simulation has a step of {step_mm} mm, a tolerance of {tolerance_mm} mm and a gain of {gain}",
            expected="a finite step above 0, a finite tolerance of at least 0, a gain above 0 and at most 1",
        )
    longest_mm = environment.limits.max_length_mm
    truth = Truth(errors, query, longest_mm - query.inserted_mm, seed)
    needle = _Needle(environment, query, truth)
    tracker = SimulatedTracker(truth, needle, errors.latency_mm)
    belief = DelayedBelief(query, gain, errors.latency_mm)
    replanner = Replanner(
        environment, query, plan, objective=objective, settings=replanning, iterations=iterations, seed=seed
    )
    replans, stopped = steer(
        environment,
        TrackedTruth(truth, tracker),
        needle,
        belief,
        plan,
        replanner,
        branch=query.branch,
        step_mm=step_mm,
        measure_every_mm=errors.measure_every_mm if closed_loop else math.inf,
        replan_every_mm=errors.replan_every_mm,
    )
    return _insertion(environment, query, needle, truth, stopped, tolerance_mm, replans)


def _insertion(
    environment: NeedleEnvironment,
    query: Query,
    needle: _Needle,
    truth: Truth,
    stopped: Failure | None,
    tolerance_mm: float,
    replans: tuple[Replan, ...],
) -> Insertion:
    target = truth.target(needle.inserted_mm)
    error = float(np.linalg.norm(needle.frame[:3, 3] - target))
    if needle.label:
        outcome = Outcome.HIT
    elif error <= tolerance_mm:
        outcome = Outcome.REACHED
    elif stopped is Failure.OUT_OF_LENGTH:
        outcome = Outcome.OUT_OF_LENGTH
    else:
        outcome = Outcome.MISSED if stopped is None else Outcome.NO_PATH
    frames, lengths = np.stack(needle.frames), np.array(needle.lengths)
    return Insertion(
        lps_from_tip=read_only(frames),
        inserted_mm=read_only(lengths),
        outcome=outcome,
        label=needle.label,
        target_lps=read_only(target),
        tip_error_mm=error,
        clearance_mm=_smallest_clearance(environment, query.branch, frames[:, :3, 3], lengths),
        replans=replans,
    )


def _smallest_clearance(environment: NeedleEnvironment, branch: int, points: Float, lengths: Float) -> float:
    """Return the exact smallest distance from the needle's surface to an obstacle at points `(N, 3)`."""
    field, labels, geometry, bits = environment.obstacles
    bounds = np.zeros(len(points))
    bounds_at(field, geometry, np.ascontiguousarray(points), bounds)
    in_exit = (lengths < environment.limits.exempt_mm) if branch >= 0 else np.zeros(len(points), bool)
    cap = float(bounds.min()) + 1.0
    while True:
        least = cap
        for spared, chosen in ((branch, in_exit), (-1, ~in_exit)):
            # The bound is never above the distance, so the points left out are farther away than the cap.
            near = np.ascontiguousarray(points[chosen & (bounds < cap)])
            distances = np.full(len(near), cap)
            exact_at(labels, geometry, near, bits, spared, cap, distances)
            least = min(least, float(distances.min(initial=cap)))
        if least < cap or cap > WIDEST_CLEARANCE_MM:
            return least - environment.needle.radius_mm
        cap *= 2.0
