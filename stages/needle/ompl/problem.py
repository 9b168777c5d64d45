"""The needle problem as OMPL takes it, made once and asked many times; the needle moves in it step by step.

Its bounds are the workspace's, and each step is proved clear.
"""

import itertools
import math
from collections.abc import Callable, Mapping
from functools import partial
from itertools import count
from typing import Any

import numpy as np
from ompl import base, control, util

from anatomy.base.errors import SettingsError
from anatomy.kernels.field import MIN_GAP_MM
from stages.needle.costs import map_integral
from stages.needle.environment import NeedleEnvironment
from stages.needle.kernels import states
from stages.needle.kernels.proof import Limits
from stages.needle.objective import SHORTEST, Objective
from stages.needle.ompl.planner import (
    NO_LIMIT,
    NeedleGoal,
    NeedlePlanner,
    Question,
    numbers_of,
    path_of,
    put_numbers,
)
from stages.needle.path import ArcPath, Query, direct_path, violation
from stages.needle.planner_names import OMPL_PLANNERS
from stages.needle.search import planners
from stages.needle.search.base import Search

ARC_STEPS = 20
"""A control of duration 1 is an arc; OMPL propagates it in so many steps."""

util.setLogLevel(util.LogLevel.LOG_ERROR)

SearchFactory = Callable[[NeedleEnvironment, Query, int], Search]
"""Makes a search of an environment, a query and a seed."""
Allocator = Callable[[Any], Any]
"""Makes an OMPL planner of a `control.SpaceInformation`."""
BESIDE_TARGET_MM = 5.0
"""So near to the target `plan` lets a planner of OMPL end, which steers by chance: one arc leads on from
there, and it comes there within hundreds of iterations, to 1 mm within many thousands."""


class NeedleProblem:
    """Plans needle paths among obstacles with OMPL; made once, asked many times.

    `setup` holds the question of `pose`, for OMPL's own tools, and `planner` is installed in it: the default
    search, which may also be `anytime`.

    Args:
        searches (mapping of names to callables): Each makes a search of an environment, a query and a seed.
            The first is the default; without any, all of `stages.needle.search.planners`.
        objective: What those make small, the patient's cost map included; the planners of OMPL look at no
            objective, but enter no voxel of infinite cost.
    """

    def __init__(
        self,
        environment: NeedleEnvironment,
        searches: Mapping[str, SearchFactory] | None = None,
        objective: Objective = SHORTEST,
    ) -> None:
        self.environment = environment
        ours = {name: partial(make, objective=objective) for name, make in planners.searches().items()}
        self._searches: dict[str, SearchFactory] = dict(searches or ours)
        self._question = Question()
        self._own: dict[str, Any] = {}
        self._tolerance_mm = 0.0
        position = base.SE3StateSpace()
        position.setBounds(_position_bounds(environment))
        controls = control.RealVectorControlSpace(position, 3)
        controls.setBounds(_control_bounds(environment))
        self.setup = control.SimpleSetup(controls)
        self.si = self.setup.getSpaceInformation()
        self.si.setPropagationStepSize(1.0 / ARC_STEPS)
        self.si.setMinMaxControlDuration(1, ARC_STEPS)
        self.setup.setStatePropagator(_propagator(environment, self._question))
        self.setup.setStateValidityChecker(validity(environment, self._question))
        self.planner = self.planners()[self.default](self.si)
        self.setup.setPlanner(self.planner)

    @property
    def default(self) -> str:
        """Name of the search that is used unless another is named."""
        return next(iter(self._searches))

    def planners(self) -> dict[str, Allocator]:
        """Return allocators for `setup.setPlannerAllocator` by name: our searches and OMPL's planners."""
        # The allocators may be kept by `setup`, so they must not refer to it: it would never be freed.
        environment, question = self.environment, self._question

        def ours(name: str, make: SearchFactory) -> Allocator:
            def search(query: Query, seed: int) -> Search:
                return make(environment, query, seed)

            return lambda si: NeedlePlanner(si, search, question, name)

        found = {name: ours(name, make) for name, make in self._searches.items()}
        return found | {name: getattr(control, name.removeprefix("control.")) for name in OMPL_PLANNERS}

    def own(self, method: str | None = None) -> Any:
        """Return the planner that `plan` uses, made once for each name; SettingsError if there is none."""
        name = self.default if method is None else method
        if name not in self._own:
            known = self.planners()
            if name not in known:
                raise SettingsError(f"There is no needle planner {name!r}", expected=", ".join(known))
            self._own[name] = known[name](self.si)
        return self._own[name]

    def plan(
        self,
        query: Query,
        *,
        seed: int,
        iterations: int,
        time_s: float = math.inf,
        method: str | None = None,
        anytime: bool = False,
        cost_limit: float = math.inf,
    ) -> ArcPath | None:
        """Return a path of arcs that is proved clear and within all limits; None if none was found.

        A planner of OMPL ends with its first path, within BESIDE_TARGET_MM of the target; one arc in place of
        its last ones then brings the path to the target itself, with as few arcs in all as are proved.

        Args:
            seed, iterations: The same pair gives the same path, if the time does not run out first.  The
                planners of OMPL take their random numbers from `seed_ompl` instead.
            method: Name of the planner, one of `planners`.
            anytime: Go on to better paths until time, iterations or search are at their end.
            cost_limit: What a path of our searches must cost less than, under the objective.
        """
        planner = self.own(method)
        ours = isinstance(planner, NeedlePlanner)
        definition = base.ProblemDefinition(self.si)
        definition.setGoal(self._ask(query, 0.0 if ours else BESIDE_TARGET_MM))
        definition.addStartState(self._start())
        planner.clear()
        planner.setProblemDefinition(definition)
        # Not through SimpleSetup.solve, which sets everything up again for each query.
        if ours:
            planner.seed, planner.iterations, planner.anytime = seed, iterations, anytime
            planner.cost_limit = cost_limit
            planner.solve(_termination(time_s))
            return planner.path  # type: ignore[no-any-return]
        self.si.setup()
        planner.setup()
        planner.solve(_termination(time_s, iterations))
        return self._brought_to_target(query, definition) if definition.hasExactSolution() else None

    def _brought_to_target(self, query: Query, definition: Any) -> ArcPath | None:
        """Return a path that ends beside the target with one arc to it in place of its last ones, proved."""
        path = path_of(definition.getSolutionPath())
        frames = path.frames()
        for kept in range(len(path.arcs)):
            last = direct_path(frames[kept], query.target)
            arcs = np.vstack([path.arcs[:kept], last.arcs])
            whole = ArcPath(lps_from_start=query.lps_from_start, arcs=arcs)
            allowed = math.isfinite(map_integral(self.environment.cost_map, whole))
            if allowed and not violation(self.environment, query, whole):
                return whole
        return None

    def pose(self, query: Query, *, goal_tolerance_mm: float = 0.0) -> None:
        """Put a query to `setup`, whose planner, start and goal then wait for `setup.solve`.

        `plan` asks its own query; pose again before `setup` is used after it.  A larger `goal_tolerance_mm`
        than the environment's own helps OMPL's planners, which steer by chance and need about 1 mm; ours aim
        at what the environment allows.
        """
        self.setup.clear()
        self.setup.setGoal(self._ask(query, goal_tolerance_mm))
        self.setup.setStartState(self._start())

    def solution(self) -> ArcPath | None:
        """Return the path that `setup` found, proved; None if there is none or it is refused."""
        path = self.unproved_solution()
        return None if path is None or self.violation(path) else path

    def violation(self, path: ArcPath) -> str:
        """Tell why a path is no answer to the query posed last; "" if it is one.

        OMPL's states do not know how long the needle is or how much it has turned: see
        `stages.needle.path`.
        """
        query = self._question.query
        if query is None:
            return "no query was posed"
        return violation(self.environment, query, path, goal_tolerance_mm=self._tolerance_mm)

    def unproved_solution(self) -> ArcPath | None:
        """Return the path that `setup` found, whether or not it is an answer; None if there is none."""
        return path_of(self.setup.getSolutionPath()) if self.setup.haveExactSolutionPath() else None

    def _ask(self, query: Query, goal_tolerance_mm: float) -> NeedleGoal:
        self._question.ask(query)
        self._tolerance_mm = max(goal_tolerance_mm, self.environment.goal_tolerance_mm)
        return NeedleGoal(self.si, query.target, self._tolerance_mm)

    def _start(self) -> Any:
        state = self.si.allocState()
        put_numbers(state, self._question.start)
        return state


_seeds: list[int] = []
"""OMPL was seeded with these in this process."""


def seed_ompl(seed: int) -> None:
    """Make OMPL's own planners repeatable; call it before anything else is made with OMPL.

    Raises SettingsError if OMPL has been seeded or has drawn random numbers in this process already, or the
    seed is less than 1.
    """
    level = util.getLogLevel()
    util.setLogLevel(util.LogLevel.LOG_NONE)
    util.RNG.setSeed(seed)
    util.setLogLevel(level)
    refused = _seeds or seed < 1 or util.RNG.getSeed() != seed
    _seeds.append(seed)
    if refused:
        raise SettingsError(
            f"OMPL cannot begin with the seed {seed}: it can be seeded once in a process",
            expected="a number of 1 or more, before OMPL has drawn its first",
            remedy="Start a new process for each call with a planner of OMPL: each command is one",
        )


def _termination(time_s: float, iterations: int = NO_LIMIT) -> Any:
    """Return what ends a planner: the time, or so many looks at it, one an iteration of OMPL's planners."""
    timed = base.plannerNonTerminatingCondition()
    if math.isfinite(time_s):
        timed = base.timedPlannerTerminationCondition(time_s)
    if iterations >= NO_LIMIT:
        return timed
    looks = count()
    counted = base.PlannerTerminationCondition(lambda: next(looks) >= iterations)
    return base.plannerOrTerminationCondition(timed, counted)


def _position_bounds(environment: NeedleEnvironment) -> Any:
    """Bound positions by the box of the grid."""
    grid = environment.grid
    corners = grid.lps(list(itertools.product(*[(-0.5, n - 0.5) for n in grid.shape])))
    bounds = base.RealVectorBounds(3)
    for axis in range(3):
        bounds.setLow(axis, float(corners[:, axis].min()))
        bounds.setHigh(axis, float(corners[:, axis].max()))
    return bounds


def _control_bounds(environment: NeedleEnvironment) -> Any:
    """Bound length, roll and curvature of an arc, so that a step is at most 1 mm long."""
    bounds = base.RealVectorBounds(3)
    # Longest step of a propagation.
    highs = (ARC_STEPS * 1.0, math.pi, environment.needle.max_curvature_per_mm)
    for n, (low, high) in enumerate(zip((0.0, -math.pi, 0.0), highs, strict=True)):
        bounds.setLow(n, low)
        bounds.setHigh(n, high)
    return bounds


def _limits_of_steps(environment: NeedleEnvironment) -> Limits:
    """Return the limits by which steps are proved, so that whatever is proved as an arc passes.

    The proof refuses points that have less than MIN_GAP_MM to spare.  Between its points half of that is
    left at least; so arcs that passed, cut anywhere, pass again with so much less required clearance, and
    what passes this way still has all of it.
    """
    limits = environment.limits
    return limits._replace(required_mm=max(limits.required_mm - 0.5 * MIN_GAP_MM, 0.0))


def _propagator(environment: NeedleEnvironment, question: Question) -> Callable[[Any, Any, float, Any], None]:
    """Return how OMPL moves a state by a control."""
    limits, obstacles = _limits_of_steps(environment), environment.obstacles
    costs = environment.cost_map
    forbidden = None if costs is None or np.isfinite(costs.array).all() else costs.array

    def propagate(state: Any, u: Any, duration: float, result: Any) -> None:
        """Advance along a share `duration` of an arc that bends towards `u[1]`, if that is proved clear."""
        begin, arc = numbers_of(state), (u[1], u[2], duration * u[0])
        moved = states.proved_step(obstacles, limits, begin, *arc, question.origin, question.branch)
        if forbidden is not None and states.is_forbidden(forbidden, obstacles.geometry, begin, *arc):
            moved = (math.nan, math.nan, math.nan, *begin[3:])
        put_numbers(result, moved)

    return propagate


def validity(environment: NeedleEnvironment, question: Question) -> Callable[[Any], bool]:
    """Return how OMPL tells whether a state is allowed."""
    limits, obstacles = _limits_of_steps(environment), environment.obstacles

    def is_valid(state: Any) -> bool:
        # A numpy.bool_ would raise std::bad_cast.
        numbers = numbers_of(state)
        return bool(states.is_allowed(obstacles, limits, numbers, question.origin, question.branch))

    return is_valid
