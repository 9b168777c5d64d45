"""A needle search as a planner of OMPL, its goal, and the question that both are asked."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from ompl import base, control

from anatomy.base.typed import Float
from stages.needle.kernels import states
from stages.needle.path import ArcPath, Query, arc_transform
from stages.needle.search.base import Search, in_slices

NO_LIMIT = 2**62


class Question:
    """The query that is asked at the moment, as planners, propagation and validity checker share it."""

    def __init__(self) -> None:
        self.query: Query | None = None
        self.start = self.origin = (math.nan,) * 7
        self.branch = -1

    def ask(self, query: Query) -> None:
        """Set start, direction, inserted length and branch, see `stages.needle.kernels.states`."""
        frame = query.lps_from_start
        forward = frame[:3, 2] if query.reference is None else query.reference
        self.query = query
        self.start = states.state_of(frame)
        self.origin = (*self.start[:3], *forward.tolist(), query.inserted_mm)
        self.branch = query.branch

    def begins_at(self, state: Any) -> bool:
        """Tell whether a state of OMPL is the start of the query."""
        return max(abs(a - b) for a, b in zip(numbers_of(state), self.start, strict=True)) < 1e-9


class NeedleGoal(base.GoalSampleableRegion):
    """The tip is within a tolerance of the target `(3,)`, LPS mm; its orientation is free."""

    def __init__(self, si: Any, target: Float, tolerance_mm: float = 0.0) -> None:
        super().__init__(si)
        self._si = si
        self._sampler: Any = None
        self.target = tuple(float(v) for v in target)
        # Every goal tolerance is larger by this for OMPL, whose states are rounded.
        self.setThreshold(tolerance_mm + 1e-6)

    def distanceGoal(self, state: Any) -> float:  # noqa: N802
        """Return the distance in mm."""
        return math.dist((state.getX(), state.getY(), state.getZ()), self.target)

    def sampleGoal(self, state: Any) -> None:  # noqa: N802
        """Put a state of any orientation at the target."""
        if self._sampler is None:
            self._sampler = self._si.allocStateSampler()
        self._sampler.sampleUniform(state)
        for put, value in zip((state.setX, state.setY, state.setZ), self.target, strict=True):
            put(value)

    def maxSampleCount(self) -> int:  # noqa: N802
        """Return a number without meaning: samples never run out."""
        return 2**31 - 1


class NeedlePlanner(base.Planner):
    """A needle search as an OMPL planner.

    `solve` runs the search in slices until it is finished, the termination condition holds, or the iterations
    are spent; without `anytime` it stops at the first path.  Each better path replaces the one before in the
    problem definition, which would rank by the number of arcs, not by cost.
    """

    def __init__(
        self, si: Any, make_search: Callable[[Query, int], Search], question: Question, name: str = "rrt"
    ) -> None:
        super().__init__(si, name)
        self._si = si
        self._make_search = make_search
        self._question = question
        self.seed = 1
        self.iterations = NO_LIMIT
        """Most iterations to spend."""
        self.anytime = False
        self.cost_limit = math.inf
        """What a path must cost less than."""
        self.query: Query | None = None
        self.path: ArcPath | None = None
        self.search: Search | None = None
        """What the last `solve` was asked, found, and found it with."""
        self.iterations_used = 0

    def solve(self, termination: Any) -> Any:
        """Search from the start; hand paths to the problem definition as arcs of duration 1."""
        self.path, self.search, self.iterations_used = None, None, 0
        self.query = query = self._question.query
        start = self.getPlannerInputStates().nextStart()
        if query is None or start is None or not self._question.begins_at(start):
            return base.PlannerStatus(base.PlannerStatus.INVALID_START)
        self.search = search = self._make_search(query, self.seed)
        search.cost = self.cost_limit
        status = base.PlannerStatus.TIMEOUT
        for used, better in in_slices(search, self.iterations, termination):
            self.iterations_used = used
            if better is not None:
                self.path = better
                status = self._hand_over(better)
                if not self.anytime:
                    break
        return base.PlannerStatus(status)

    def _hand_over(self, path: ArcPath) -> Any:
        """Make the path the problem's only solution; return the status that it earns."""
        solution = control.PathControl(self._si)
        longest = self._si.getControlSpace().getBounds().high[0]
        # OMPL propagates equal controls in steps, so here the roll is counted from the start.
        roll = 0.0
        frames = path.frames()
        for frame, (length, turned, curvature) in zip(frames, path.arcs.tolist(), strict=False):
            begin = self._state(frame, roll)
            roll = math.remainder(roll + turned, 2.0 * math.pi)
            pieces = max(1, math.ceil(length / longest))
            for piece in range(pieces):
                if piece > 0:
                    cut = arc_transform(length * piece / pieces, turned, curvature)
                    begin = self._state(frame @ cut, roll)
                u = self._si.allocControl()
                u[0], u[1], u[2] = length / pieces, roll, curvature
                solution.append(begin, u, 1.0)
        last = self._state(frames[-1], roll)
        solution.append(last)
        definition = self.getProblemDefinition()
        met, distance = definition.getGoal().isSatisfiedWithDistance(last)
        definition.clearSolutionPaths()
        definition.addSolutionPath(solution, not met, distance, self.getName())
        return base.PlannerStatus.EXACT_SOLUTION if met else base.PlannerStatus.APPROXIMATE_SOLUTION

    def _state(self, frame: Float, roll: float) -> Any:
        state = self._si.allocState()
        put_numbers(state, states.rolled(states.state_of(frame), -roll))
        return state


def write_state(state: Any, frame: Float) -> None:
    """Set an OMPL SE(3) state to a frame."""
    put_numbers(state, states.state_of(frame))


def read_state(state: Any) -> Float:
    """Return the frame of an OMPL SE(3) state."""
    numbers = numbers_of(state)
    frame = np.eye(4)
    frame[:3, :3] = np.array(states.axes(numbers)).T
    frame[:3, 3] = numbers[:3]
    return frame


def numbers_of(state: Any) -> tuple[float, ...]:
    """Return position (mm) and unit quaternion x, y, z, w of an OMPL SE(3) state."""
    q = state.rotation()
    return state.getX(), state.getY(), state.getZ(), q.x, q.y, q.z, q.w


def put_numbers(state: Any, numbers: Sequence[float]) -> None:
    """Set an OMPL SE(3) state to position (mm) and unit quaternion x, y, z, w."""
    q = state.rotation()
    x, y, z, q.x, q.y, q.z, q.w = numbers
    state.setX(x)
    state.setY(y)
    state.setZ(z)


def path_of(solution: Any) -> ArcPath:
    """Return a `control.PathControl` as unproved arcs, one for each run of controls that bend alike."""
    arcs: list[list[float]] = []
    before: tuple[float, float] | None = None
    for n in range(solution.getControlCount()):
        u = solution.getControl(n)
        length, bend = u[0] * solution.getControlDuration(n), (u[1], u[2])
        if bend == before:
            arcs[-1][0] += length
        else:
            turned = bend[0] - (0.0 if before is None else before[0])
            arcs.append([length, math.remainder(turned, 2.0 * math.pi), bend[1]])
        before = bend
    return ArcPath(lps_from_start=read_state(solution.getState(0)), arcs=np.array(arcs))
