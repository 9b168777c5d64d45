"""Replanning on the way: a new path from wherever the needle's tip really is [Patil2014]."""

import math
from collections.abc import Iterator
from dataclasses import replace
from enum import StrEnum
from typing import Annotated

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.settings import quantity, settings
from anatomy.base.typed import Float
from anatomy.kernels.arcs import arc_to_point, pose_on_arc
from anatomy.kernels.field import EXACT_REACH_MM, MIN_GAP_MM, exact_distance
from anatomy.structures import BITS, LUMEN
from stages.needle.environment import NeedleEnvironment
from stages.needle.kernels import proof as index
from stages.needle.kernels import tree
from stages.needle.kernels.connections import nearest_turn, seen_from
from stages.needle.kernels.cost import ObjectiveArrays
from stages.needle.kernels.goal_ball import least_length_from
from stages.needle.kernels.proof import blocker_on_arc
from stages.needle.objective import SHORTEST, Objective
from stages.needle.path import CURVATURE, ArcPath, Query, as_point, bend_direction, pose_at
from stages.needle.replanning.reaiming import (
    Attempts,
    Bend,
    Root,
    Source,
    Waypoints,
    plan_ahead,
    root_after,
    waypoints_ahead,
)
from stages.needle.search.base import root_of

ROLLS = 8
STEP_MM = 0.25
"""Lengths of the arcs that are tried differ by this: half a voxel."""


def _structure_name(label: int) -> str:
    """Return the name of the first obstacle that a voxel label stands for."""
    return next((name for name, bit in BITS.items() if label & bit), "nothing")


def _with_limits(environment: NeedleEnvironment, **limits: float) -> NeedleEnvironment:
    """Return an environment with other limits, by the names of `stages.needle.kernels.proof.Limits`."""
    return replace(environment, limits=environment.limits._replace(**limits))


def _blocker_at(
    environment: NeedleEnvironment, pose: tuple[float, ...], inserted_mm: float, branch: int
) -> int:
    """Return the label that the needle's point at the length `inserted_mm` is too near to, 0 if clear."""
    obstacles, limits, straight = environment.obstacles, environment.limits, (0.0, 1.0, 0.0, 0.0)
    return int(blocker_on_arc(obstacles, limits, pose, straight, 0.0, inserted_mm, branch))


def _tip_clearance(environment: NeedleEnvironment, query: Query) -> tuple[float, int]:
    """Return the distance (mm) of a query's start from what it keeps clear of, if near, and its label."""
    _clearance, labels, geometry, bits = environment.obstacles
    reach = environment.required_clearance_mm + EXACT_REACH_MM
    point = as_point(query.lps_from_start[:3, 3])
    in_exit = query.branch >= 0 and query.inserted_mm < environment.limits.exempt_mm
    distance, label = exact_distance(labels, geometry, *point, bits, query.branch if in_exit else -1, reach)
    if in_exit:
        lumen, lumen_label = exact_distance(labels, geometry, *point, LUMEN, -1, reach)
        if lumen < min(distance, environment.needle.radius_mm):
            distance, label = lumen, lumen_label
    return float(distance), int(label)


def _roots_of_tip(
    environment: NeedleEnvironment, objective: ObjectiveArrays, query: Query, longest_mm: float
) -> tuple[list[Root], float]:
    """Return where to plan from, the nearest first, and the clearance proved on the way there.

    That is the tip itself, where `query` starts.  Where the tip has lost the required clearance, it is the
    ends of arcs of at most `longest_mm` that lead back to it; on them the axis comes no nearer to an obstacle
    than the tip is, but for a little slack, and never nearer than the needle's radius.
    """
    required = environment.required_clearance_mm
    pose = pose_at(query.lps_from_start)
    if not _blocker_at(environment, pose, query.inserted_mm, query.branch):
        return [Root(query=query)], required
    clearance, _label = _tip_clearance(environment, query)
    # An arc that leads away from an obstacle may come nearer by 0.1 mm first: bending takes a while.
    relaxed = min(max(environment.needle.radius_mm, clearance - 0.1), required)
    near = _with_limits(environment, required_mm=relaxed)
    roots = []
    for bend in _bends(environment, query):
        length = _length_to_clearance(environment, query, pose, bend, longest_mm)
        attempts = Attempts(near, objective, Root(query=query))
        if length > 0.0:
            attempts.by_arc(bend, length, Source.REJOIN)
        if attempts.path is not None:
            roots.append(root_after(query, attempts.path, attempts.cost))
    return sorted(roots, key=lambda root: root.away_mm), relaxed


def _bends(environment: NeedleEnvironment, query: Query) -> Iterator[Bend]:
    """Yield straight on, and the tightest arcs to all sides."""
    for n in range(ROLLS):
        side = as_point(bend_direction(query.lps_from_start, 2.0 * math.pi * n / ROLLS))
        if n == 0:
            yield 0.0, *side
        yield environment.limits.kappa, *side


def _length_to_clearance(
    environment: NeedleEnvironment, query: Query, pose: tuple[float, ...], bend: Bend, longest_mm: float
) -> float:
    """Return the length of an arc after which the required clearance is regained, 0 if never."""
    for n in range(1, int(longest_mm / STEP_MM) + 1):
        s = n * STEP_MM
        if not _blocker_at(environment, pose_on_arc(pose, bend, s), query.inserted_mm + s, query.branch):
            return s
    return 0.0


ITERATIONS = 1500
"""Iterations of the search in a replan; see docs/explanation/replanning.md for what they take."""


class Failure(StrEnum):
    """Why there is no path."""

    TOUCHES = "the needle touches an obstacle"
    STUCK = "no way back to the required clearance"
    TARGET_BLOCKED = "the target is too near to an obstacle"
    OUT_OF_LENGTH = "out of length"
    OUT_OF_REACH = "out of reach"
    NOT_FOUND = "no clear path found"


@settings
class ReplanSettings:
    """What a replan may do.

    The reserve of curvature is spent only where there is no path without it.  A tip that has lost the
    required clearance must regain it within `relaxed_mm`.  A target that cannot be met may be missed.
    """

    curvature_reserve: Annotated[
        float, quantity("share of the largest curvature that is kept back", at_least=0.0, at_most=0.9)
    ] = 0.0
    relaxed_mm: Annotated[
        float, quantity("length within which a lost clearance must be regained", at_least=0.0, at_most=20.0)
    ] = 5.0
    largest_miss_mm: Annotated[
        float, quantity("distance by which the target may be missed", at_least=0.0, at_most=10.0)
    ] = 1.0


DEFAULT_SETTINGS = ReplanSettings()


@frozen_record
class Replan:
    """What came of replanning from one pose.

    Args:
        path: From the pose to the target, proved clear and within all limits counted from the needle's first
            start; without arcs if the tip is there already.
        cost: Cost of the path under the objective, as estimated within the searches; infinite without a path.
        source: What the path was made of.
        why: The failure in a sentence, with numbers.
        reserve_spent: Whether an arc bends more than the reserve leaves.
        miss_mm: Distance from the end of the path to the target.
        relaxed_mm, relaxed_clearance_mm: Length of path for which only this clearance of the axis is proved,
            because the tip had lost the required one; both 0 otherwise.
    """

    path: ArcPath | None
    cost: float = math.inf
    source: Source | None = None
    failure: Failure | None = None
    why: str = ""
    reserve_spent: bool = False
    miss_mm: float = math.inf
    relaxed_mm: float = 0.0
    relaxed_clearance_mm: float = 0.0


def with_reserve(environment: NeedleEnvironment, reserve: float) -> NeedleEnvironment:
    """Return an environment whose needle bends less by a share, 0 to below 1, of its largest curvature.

    Raises SettingsError if the share is outside its range.
    """
    if not 0.0 <= reserve < 1.0:
        raise SettingsError(f"The curvature reserve is {reserve}", expected="a share of at least 0, below 1")
    curvature = environment.needle.max_curvature_per_mm * (1.0 - reserve)
    needle = replace(environment.needle, max_curvature_per_mm=curvature)
    return replace(_with_limits(environment, kappa=curvature), needle=needle)


def _arrived(query: Query, miss_mm: float) -> Replan:
    path = ArcPath(lps_from_start=query.lps_from_start, arcs=np.zeros((0, 3)))
    return Replan(path=path, cost=0.0, source=Source.ARRIVED, miss_mm=miss_mm)


class Replanner:
    """Holds the plan that is being followed, and makes a new one from any pose the needle is in.

    A replan is made from, in this order: what is left of the plan, steered exactly through its own points;
    the single arc; ways back to the plan; the shortest path in free space; the RRT, with a given number of
    iterations, for what is cheaper.  Nothing depends on a clock: the same seed and the same sequence of calls
    give the same replans.

    Limits count from the needle's first start: length and turn behind the tip, the exemption at the exit,
    and the angle, measured from the first direction.  Raises SettingsError if `iterations` is negative.

    Args:
        query: What the plan was made for.
        plan: From the query's start.
        iterations: Of the search, for each replan.
        seed: The same seed and the same sequence of calls give the same replans.
    """

    def __init__(
        self,
        environment: NeedleEnvironment,
        query: Query,
        plan: ArcPath,
        *,
        objective: Objective = SHORTEST,
        settings: ReplanSettings = DEFAULT_SETTINGS,
        iterations: int = ITERATIONS,
        seed: int = 1,
    ) -> None:
        if iterations < 0:
            raise SettingsError(f"A replan has {iterations} iterations", expected="0 or more")
        self.plan = plan
        """The plan that is being followed; the last replan, if there is one."""
        self.curvature_share = 1.0
        """Share of the needle's largest curvature that it reaches in this tissue: replans keep to it."""
        self._environment, self._query, self._settings = environment, query, settings
        self._objective, self._objective_arrays = objective, environment.objective_arrays(objective)
        self._iterations, self._seed, self._replans = iterations, seed, 0
        self._begin_mm, self._turned_rad = query.inserted_mm, query.turned_rad
        exact = _with_limits(environment, goal_tolerance_mm=0.0)
        self._variants = [exact]
        if settings.curvature_reserve > 0.0:
            self._variants.insert(0, with_reserve(exact, settings.curvature_reserve))
        if environment.goal_tolerance_mm > 0.0:
            self._variants.append(environment)

    def replan(
        self, lps_from_tip: Float, target: Float, inserted_mm: float, *, turned_rad: float | None = None
    ) -> Replan:
        """Plan from the pose that the tip is in; a path that is found becomes the plan.

        The pose `(4, 4)` looks along +z, the direction of insertion; the target is `(3,)`, LPS mm.  Length
        of needle and turn count from its first start; the turn is by default what the plans so far say.

        Raises:
            FrameError: If pose or target are not finite numbers or the pose is not rigid.
            SettingsError: If length or turn are negative or not finite.
        """
        turned, corners, meetings = plan_ahead(self.plan, inserted_mm - self._begin_mm)
        reference = self._query.reference
        query = Query(
            lps_from_start=lps_from_tip,
            target=target,
            branch=self._query.branch,
            inserted_mm=inserted_mm,
            turned_rad=self._turned_rad + turned if turned_rad is None else turned_rad,
            reference=self._query.lps_from_start[:3, 2] if reference is None else reference,
        )
        self._replans += 1
        found = self._find(query, list(waypoints_ahead(corners, meetings)))
        if found.path is not None:
            self.plan, self._begin_mm, self._turned_rad = found.path, inserted_mm, query.turned_rad
        return found

    def _find(self, query: Query, candidates: list[Waypoints]) -> Replan:
        away = float(np.linalg.norm(query.target - query.lps_from_start[:3, 3]))
        if away <= max(self._environment.goal_tolerance_mm, index.MIN_ARC_MM):
            return _arrived(query, away)
        unreached = 1.0 - self.curvature_share
        bending = with_reserve(self._environment, unreached) if unreached else self._environment
        roots, relaxed = _roots_of_tip(bending, self._objective_arrays, query, self._settings.relaxed_mm)
        if not roots:
            return self._stuck(query)
        failure, why = self._out_of_reach(bending, query)
        if failure is None:
            left = self._iterations
            for n, each in enumerate(self._variants):
                variant = with_reserve(each, unreached) if unreached else each
                best, spent = self._try(variant, roots, candidates, left // (len(self._variants) - n))
                if best is not None:
                    return self._found(best, query, relaxed)
                left -= spent
            failure = Failure.NOT_FOUND
            why = f"No clear path to the target was found in {self._iterations} iterations"
        missed = self._near_miss(bending, query, roots, relaxed, away)
        return missed or Replan(path=None, failure=failure, why=why)

    def _try(
        self, environment: NeedleEnvironment, roots: list[Root], candidates: list[Waypoints], iterations: int
    ) -> tuple[Attempts | None, int]:
        """Try all waypoints from all roots, then search; return the best, and the iterations spent."""
        tried = []
        most = max(len(points) for points, _source in candidates)
        for root in roots:
            attempts = Attempts(environment, self._objective_arrays, root, most)
            for points, source in candidates:
                attempts.through(points, source)
            attempts.by_legs()
            tried.append(attempts)
        tried.sort(key=lambda attempts: attempts.total)
        # From three at most of the arcs that lead away a path is searched.
        to_search = tried[:1] if tried[0].path is not None else tried[:3]
        spent = 0
        for n, attempts in enumerate(to_search):
            share = (iterations - spent) // (len(to_search) - n)
            spent += attempts.search(share, self._seed + self._replans, self._objective)
        best = min(tried, key=lambda attempts: attempts.total)
        return (None if best.path is None else best), spent

    def _found(self, attempts: Attempts, query: Query, relaxed: float) -> Replan:
        root, path = attempts.root, attempts.path
        arcs = root.arcs if path is None else np.concatenate([root.arcs, path.arcs])
        whole = ArcPath(lps_from_start=query.lps_from_start, arcs=arcs)
        left = (1.0 - self._settings.curvature_reserve) * self._environment.limits.kappa
        return Replan(
            path=whole,
            cost=attempts.total,
            source=attempts.source,
            reserve_spent=bool((arcs[:, CURVATURE] > left * (1.0 + index.TINY)).any()),
            miss_mm=float(np.linalg.norm(whole.frames()[-1][:3, 3] - query.target)),
            relaxed_mm=root.away_mm,
            relaxed_clearance_mm=relaxed if len(root.arcs) else 0.0,
        )

    def _near_miss(
        self, environment: NeedleEnvironment, query: Query, roots: list[Root], relaxed: float, away: float
    ) -> Replan | None:
        """Return the tightest arc towards the target if it passes near enough, or stay if the tip is."""
        best: Attempts | None = None
        least = min(away, self._settings.largest_miss_mm)
        kappa = environment.limits.kappa
        for root in roots:
            attempts = Attempts(environment, self._objective_arrays, root)
            pose, target = pose_at(root.query.lps_from_start), query.goal
            turn, miss = nearest_turn(*seen_from(pose, target), kappa)
            if turn > index.MIN_ARC_MM * kappa and miss < least:
                _length, bend, _turn = arc_to_point(pose, target)
                attempts.by_arc((kappa, *bend[1:]), turn / kappa, Source.NEAREST)
                if attempts.path is not None:
                    best, least = attempts, miss
        if best is not None:
            return self._found(best, query, relaxed)
        return _arrived(query, away) if away <= self._settings.largest_miss_mm else None

    def _out_of_reach(self, environment: NeedleEnvironment, query: Query) -> tuple[Failure | None, str]:
        """Tell why no path leads to the target even in free space."""
        limits = environment.limits
        left = limits.max_length_mm - query.inserted_mm
        if left <= index.MIN_ARC_MM:
            return Failure.OUT_OF_LENGTH, f"All of the needle ({limits.max_length_mm:g} mm) is inserted"
        if self._environment.goal_tolerance_mm == 0.0:
            label = _blocker_at(self._environment, (*query.goal, 0.0, 0.0, 1.0), math.inf, -1)
            if label:
                required, name = self._environment.required_clearance_mm, _structure_name(label)
                return Failure.TARGET_BLOCKED, f"The target is nearer than {required:.2f} mm to {name}"
        pose, reference = pose_at(query.lps_from_start), tree.reference_of(root_of(query))
        angle = math.acos(float(np.clip(np.dot(pose[3:], reference), -1.0, 1.0)))
        turn_left = limits.max_turn_rad - query.turned_rad
        length = least_length_from(pose, query.goal, limits, reference, turn_left)
        if not length < math.inf:
            return Failure.OUT_OF_REACH, (
                f"The target cannot be reached from a tip turned by {math.degrees(angle):.1f} degrees from "
                f"the start, with {math.degrees(max(turn_left, 0.0)):.1f} degrees of turning left"
            )
        if length > left:
            return Failure.OUT_OF_LENGTH, f"The target is {length:.1f} mm ahead, {left:.1f} mm are left"
        return None, ""

    def _stuck(self, query: Query) -> Replan:
        clearance, label = _tip_clearance(self._environment, query)
        radius = self._environment.needle.radius_mm
        where = f"The axis at the tip is {clearance:.2f} mm from {_structure_name(label)}"
        if clearance < radius + MIN_GAP_MM:
            why = f"{where}, the needle's radius is {radius:g} mm"
            return Replan(path=None, failure=Failure.TOUCHES, why=why)
        required, longest = self._environment.required_clearance_mm, self._settings.relaxed_mm
        why = f"{where}, and no arc of up to {longest:g} mm leads back to {required:.2f} mm"
        return Replan(path=None, failure=Failure.STUCK, why=why)
