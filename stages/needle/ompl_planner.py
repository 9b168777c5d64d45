"""The needle problem in OMPL: an SE(3) control problem, and planners whose search is a compiled kernel.

The only module that imports OMPL; docs/ompl.md tells how it is used and which traps it avoids.  What
OMPL's own planners propagate is proved clear step by step; what they find is proved once more as arcs.
"""

from __future__ import annotations

import itertools
import math
import resource
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from ompl import base, control, tools, util

from anatomy import poses
from anatomy.errors import FileError, SettingsError
from anatomy.grid import Float
from anatomy.io.files import atomic_write, require_writable_folder
from anatomy.kernels.field import MIN_GAP_MM
from stages.needle.kernels import limits as index
from stages.needle.kernels import states, tree
from stages.needle.objections import SAME_MM, objection
from stages.needle.path import ArcPath, arc_transform
from stages.needle.planners import PLANNERS
from stages.needle.runs import Outcome, PlannerRuns, log_with_outcomes, summary
from stages.needle.searches import Query, Search, TreeSearch
from stages.needle.space import NeedleSpace

util.setLogLevel(util.LogLevel.LOG_ERROR)

SearchFactory = Callable[[NeedleSpace, Query, int], Search]
"""Makes a search of a space, a query and a seed."""
Allocator = Callable[[Any], Any]
"""Makes an OMPL planner of a `control.SpaceInformation`."""

ARC_STEPS = 20
"""A control of duration 1 is an arc; OMPL propagates it in so many steps."""
ROUNDING_MM = 1e-6
"""What every goal tolerance is larger for OMPL, whose states are rounded."""
SLICE_ITERATIONS = 200
NO_LIMIT = 2**62
LONGEST_STEP_MM = 1.0
"""Longest step of a propagation."""


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
    """The tip is at the target; its orientation is free.

    Parameters
    ----------
    si : control.SpaceInformation
    target : (3,) float64, LPS mm
    tolerance_mm : float
        How far from the target a path may end.
    """

    def __init__(self, si: Any, target: Float, tolerance_mm: float = 0.0) -> None:
        super().__init__(si)
        self._si = si
        self._sampler: Any = None
        self.target = tuple(float(v) for v in target)
        self.setThreshold(tolerance_mm + ROUNDING_MM)

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

    `solve` runs the search in slices until it is finished, the termination condition holds, or the
    iterations are spent; without `anytime` it stops at the first path.  Each better path replaces the one
    before in the problem definition, which would rank by the number of arcs, not by cost.

    Parameters
    ----------
    si : control.SpaceInformation
    make_search : callable
        Makes a search of a query and a seed.
    question : Question
        Where the query stands when `solve` is called.
    name : str
    """

    def __init__(
        self,
        si: Any,
        make_search: Callable[[Query, int], Search],
        question: Question,
        name: str = "rrt",
    ) -> None:
        super().__init__(si, name)
        self._si = si
        self._make_search = make_search
        self._question = question
        self.seed = 1
        self.iterations = NO_LIMIT
        """Most iterations to spend."""
        self.anytime = False
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
        status = base.PlannerStatus.TIMEOUT
        while not (termination() or search.finished):
            portion = min(SLICE_ITERATIONS, self.iterations - self.iterations_used)
            self.iterations_used += portion
            if search.advance(portion) and search.path is not None:
                self.path = search.path
                status = self._hand_over(search.path)
                if not self.anytime:
                    break
            if self.iterations_used >= self.iterations:
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
        _write(state, states.rolled(states.state_of(frame), -roll))
        return state

    def search_tree(self) -> Any:
        """Return the last search's tree as `base.PlannerData`; an edge weighs its length in mm.

        Holds what the search holds now, and the best path if that is not part of it: some searches drop
        a tree that has succeeded, some grow none.
        """
        vertices = [] if self.search is None or self.query is None else _vertices(self.search, self.query)
        data = base.PlannerData(self._si)
        kept = []
        for n, vertex in enumerate(vertices):
            state = self._si.allocState()
            write_state(state, vertex.frame)
            kept.append(state)
            add = data.addGoalVertex if vertex.ends_path else data.addVertex
            (data.addStartVertex if n == 0 else add)(base.PlannerDataVertex(state))
        for n, vertex in enumerate(vertices[1:], start=1):
            data.addEdge(vertex.parent, n, base.PlannerDataEdge(), base.Cost(vertex.length_mm))
        # Until here the vertices point to the states in `kept`; now they get their own.
        data.decoupleFromPlanner()
        return data

    def save_search_tree(self, file: str | Path) -> None:
        """Write the tree as text where the name ends in .graphml, else as OMPL's binary file.

        Raises
        ------
        FileError
            If the file cannot be written.
        """
        data = self.search_tree()
        with atomic_write(file) as temporary:
            if temporary.suffix == ".graphml":
                temporary.write_text(data.printGraphML(), encoding="utf-8")
            elif not base.PlannerDataStorage().store(data, str(temporary)):
                raise _not_written(file)


@dataclass(frozen=True)
class _Vertex:
    frame: Float
    parent: int = 0
    length_mm: float = 0.0
    ends_path: bool = False


def _vertices(search: Search, query: Query) -> list[_Vertex]:
    """List the start, the nodes of the tree and, unless it is among them, the best path."""
    vertices = [_Vertex(query.lps_from_start)]
    path = search.path
    end = np.full(3, np.nan) if path is None else path.frames()[-1][:3, 3]
    if isinstance(search, TreeSearch):
        for row, parent in zip(search.nodes[1 : search.count], search.parents[1 : search.count], strict=True):
            ends_path = float(np.abs(row[:3] - end).max()) < SAME_MM
            frame = poses.pose(row[:3], row[3:6])
            vertices.append(_Vertex(frame, int(parent), float(row[tree.ARC_LENGTH]), ends_path))
    if path is not None and not any(vertex.ends_path for vertex in vertices):
        parent = 0
        for n, frame in enumerate(path.frames()[1:]):
            vertices.append(_Vertex(frame, parent, float(path.arcs[n, 0]), n == len(path.arcs) - 1))
            parent = len(vertices) - 1
    return vertices


def write_state(state: Any, frame: Float) -> None:
    """Set an OMPL SE(3) state to a frame."""
    _write(state, states.state_of(frame))


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


def _write(state: Any, numbers: Sequence[float]) -> None:
    q = state.rotation()
    x, y, z, q.x, q.y, q.z, q.w = numbers
    state.setX(x)
    state.setY(y)
    state.setZ(z)


def path_of(solution: Any) -> ArcPath:
    """Return a `control.PathControl` as arcs, one for each run of controls that bend alike.

    Nothing is proved here: see `NeedleProblem.objection`.
    """
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


class NeedleProblem:
    """Plans needle paths among obstacles with OMPL; made once, asked many times.

    Parameters
    ----------
    space : NeedleSpace
    searches : mapping of names to callables, optional
        Each makes a search of a space, a query and a seed.  The first is the default; without any,
        all of `stages.needle.planners`.

    Attributes
    ----------
    setup : control.SimpleSetup
        The question of `pose`, for OMPL's own tools.
    planner : NeedlePlanner
        The planner installed in `setup`: the default search, which may also be `anytime`.
    """

    def __init__(self, space: NeedleSpace, searches: Mapping[str, SearchFactory] | None = None) -> None:
        self.space = space
        self._searches = dict(searches or PLANNERS)
        self._question = Question()
        self._own: dict[str, NeedlePlanner] = {}
        self._tolerance_mm = 0.0
        position = base.SE3StateSpace()
        position.setBounds(_bounds_of(space))
        controls = control.RealVectorControlSpace(position, 3)
        controls.setBounds(_control_bounds(space))
        self.setup = control.SimpleSetup(controls)
        self.si = self.setup.getSpaceInformation()
        self.si.setPropagationStepSize(1.0 / ARC_STEPS)
        self.si.setMinMaxControlDuration(1, ARC_STEPS)
        self.setup.setStatePropagator(_propagator(space, self._question))
        self.setup.setStateValidityChecker(_validity(space, self._question))
        self.planner = self.planners()[self.default](self.si)
        self.setup.setPlanner(self.planner)

    @property
    def default(self) -> str:
        """Name of the search that is used unless another is named."""
        return next(iter(self._searches))

    def planners(self) -> dict[str, Allocator]:
        """Return what makes each planner: our searches by their names, and OMPL's own.

        For `setup.setPlanner(allocator(problem.si))` or `setup.setPlannerAllocator(allocator)`.
        """
        # The allocators may be kept by `setup`, so they must not refer to it: it would never be freed.
        space, question = self.space, self._question

        def ours(name: str, make: SearchFactory) -> Allocator:
            def search(query: Query, seed: int) -> Search:
                return make(space, query, seed)

            return lambda si: NeedlePlanner(si, search, question, name)

        found = {name: ours(name, make) for name, make in self._searches.items()}
        return found | {
            "control.RRT": control.RRT,
            "control.EST": control.EST,
            "control.KPIECE1": control.KPIECE1,
        }

    def own(self, method: str | None = None) -> NeedlePlanner:
        """Return the planner that `plan` uses, made once for each search.

        Raises
        ------
        SettingsError
            If there is no such search.
        """
        name = self.default if method is None else method
        if name not in self._searches:
            raise SettingsError(f"There is no needle search {name!r}", expected=", ".join(self._searches))
        if name not in self._own:
            self._own[name] = self.planners()[name](self.si)
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
    ) -> ArcPath | None:
        """Search a path of arcs.

        Parameters
        ----------
        query : Query
        seed, iterations : int
            The same pair gives the same path, if the time does not run out first.
        time_s : float
            Stop after this time.
        method : str, optional
            Name of the search.
        anytime : bool
            Go on to better paths until time, iterations or search are at their end.

        Returns
        -------
        ArcPath or None
            A path proved clear and within all limits; None if none was found.
        """
        planner = self.own(method)
        planner.seed, planner.iterations, planner.anytime = seed, iterations, anytime
        definition = base.ProblemDefinition(self.si)
        definition.setGoal(self._ask(query, 0.0))
        definition.addStartState(self._start())
        planner.clear()
        planner.setProblemDefinition(definition)
        # Not through SimpleSetup.solve, which sets everything up again for each query.
        planner.solve(_termination(time_s))
        return planner.path

    def pose(self, query: Query, *, goal_tolerance_mm: float = 0.0) -> None:
        """Put a query to `setup`, whose planner, start and goal then wait for `setup.solve`.

        `plan` asks its own query; pose again before `setup` is used after it.

        Parameters
        ----------
        query : Query
        goal_tolerance_mm : float
            How far from the target a path may end, where the space's own tolerance is smaller.  OMPL's
            planners steer by chance and need about 1 mm; ours aim at what the space allows.
        """
        self.setup.clear()
        self.setup.setGoal(self._ask(query, goal_tolerance_mm))
        self.setup.setStartState(self._start())

    def solution(self) -> ArcPath | None:
        """Return the path that `setup` found, proved; None if there is none or it is refused."""
        path = self._found()
        return None if path is None or self.objection(path) else path

    def objection(self, path: ArcPath) -> str:
        """Tell why a path is no answer to the query posed last; "" if it is one.

        OMPL's states do not know how long the needle is or how much it has turned: see
        `stages.needle.objections`.
        """
        query = self._question.query
        if query is None:
            return "no query was posed"
        return objection(self.space, query, path, goal_tolerance_mm=self._tolerance_mm)

    def _found(self) -> ArcPath | None:
        return path_of(self.setup.getSolutionPath()) if self.setup.haveExactSolutionPath() else None

    def _ask(self, query: Query, goal_tolerance_mm: float) -> NeedleGoal:
        self._question.ask(query)
        self._tolerance_mm = max(goal_tolerance_mm, self.space.goal_tolerance_mm)
        return NeedleGoal(self.si, query.target, self._tolerance_mm)

    def _start(self) -> Any:
        state = self.si.allocState()
        _write(state, self._question.start)
        return state


_seeds: list[int] = []
"""What OMPL was seeded with in this process."""


def seed_ompl(seed: int) -> None:
    """Make OMPL's own planners repeatable; call it before anything else is made with OMPL.

    Raises
    ------
    SettingsError
        If OMPL has been seeded or has drawn random numbers in this process already, or the seed is less
        than 1.
    """
    level = util.getLogLevel()
    util.setLogLevel(util.LogLevel.LOG_NONE)
    util.RNG.setSeed(seed)
    util.setLogLevel(level)
    refused = _seeds or seed < 1 or util.RNG.getSeed() != seed
    _seeds.append(seed)
    if refused:
        raise SettingsError(
            f"OMPL cannot begin with the seed {seed}",
            expected="a number of 1 or more, before OMPL has drawn its first",
            remedy="Call it first in a new process",
        )


def _termination(time_s: float) -> Any:
    if math.isinf(time_s):
        return base.plannerNonTerminatingCondition()
    return base.timedPlannerTerminationCondition(time_s)


def _bounds_of(space: NeedleSpace) -> Any:
    grid = space.grid
    corners = grid.lps(list(itertools.product(*[(-0.5, n - 0.5) for n in grid.shape])))
    bounds = base.RealVectorBounds(3)
    for axis in range(3):
        bounds.setLow(axis, float(corners[:, axis].min()))
        bounds.setHigh(axis, float(corners[:, axis].max()))
    return bounds


def _control_bounds(space: NeedleSpace) -> Any:
    """Bound length, roll and curvature of an arc, so that a step is at most 1 mm long."""
    bounds = base.RealVectorBounds(3)
    highs = (ARC_STEPS * LONGEST_STEP_MM, math.pi, space.needle.max_curvature_per_mm)
    for n, (low, high) in enumerate(zip((0.0, -math.pi, 0.0), highs, strict=True)):
        bounds.setLow(n, low)
        bounds.setHigh(n, high)
    return bounds


def _limits_of_steps(space: NeedleSpace) -> Float:
    """Return the limits by which steps are proved, so that whatever is proved as an arc passes.

    The proof refuses points that have less than MIN_GAP_MM to spare.  Between its points half of that is
    left at least; so arcs that passed, cut anywhere, pass again with so much less required clearance, and
    what passes this way still has all of it.
    """
    limits = np.array(space.limits)
    limits[index.REQUIRED] = max(limits[index.REQUIRED] - 0.5 * MIN_GAP_MM, 0.0)
    return limits


def _propagator(space: NeedleSpace, question: Question) -> Callable[[Any, Any, float, Any], None]:
    limits = _limits_of_steps(space)

    def propagate(state: Any, u: Any, duration: float, result: Any) -> None:
        """Advance along a share `duration` of an arc that bends towards `u[1]`, if that is proved clear."""
        moved = states.proved_step(
            space.arrays,
            limits,
            numbers_of(state),
            u[1],
            u[2],
            duration * u[0],
            question.origin,
            question.branch,
        )
        _write(result, moved)

    return propagate


def _validity(space: NeedleSpace, question: Question) -> Callable[[Any], bool]:
    limits = _limits_of_steps(space)

    def is_valid(state: Any) -> bool:
        # A numpy.bool_ would raise std::bad_cast.
        return bool(
            states.is_allowed(space.arrays, limits, numbers_of(state), question.origin, question.branch)
        )

    return is_valid


def benchmark(
    problem: NeedleProblem,
    query: Query,
    *,
    time_s: float,
    runs: int,
    planners: Sequence[str] | None = None,
    goal_tolerance_mm: float = 1.0,
    memory_mb: float = 1024.0,
    seed: int = 1,
    file: str | Path | None = None,
) -> dict[str, PlannerRuns]:
    """Run planners on one query with OMPL's `tools.Benchmark`.

    Parameters
    ----------
    problem : NeedleProblem
    query : Query
    time_s : float
        Time limit of a run.  Our planners end with their first path.
    runs : int
        Runs of each planner.
    planners : sequence of str, optional
        Names of `NeedleProblem.planners`; by default all.
    goal_tolerance_mm : float
        How far from the target a path of OMPL's planners may end.
    memory_mb : float
        Stop a run when the process uses so much more memory than at the start.
    seed : int
        Seed of the first run of our planners; each further run takes the next.
    file : path, optional
        Where to write OMPL's log, with two more properties for each run: whether its path is proved, and
        the length in mm (OMPL's own counts durations).

    Returns
    -------
    dict of PlannerRuns by name

    Raises
    ------
    SettingsError
        If there is no such planner, or nothing to run.
    FileError
        If the log cannot be written.
    """
    allocators = problem.planners()
    names = list(allocators) if planners is None else list(planners)
    unknown = [name for name in names if name not in allocators]
    if unknown or not names or runs < 1:
        raise SettingsError(
            f"Nothing to run {runs} times, or unknown planners: {unknown}",
            expected=f"at least one run, and planners out of {', '.join(allocators)}",
        )
    if file is not None:
        # Where it cannot write, OMPL writes elsewhere.
        require_writable_folder(Path(file).parent)
    problem.pose(query, goal_tolerance_mm=goal_tolerance_mm)
    outcomes: list[Outcome] = []

    def before(planner: Any) -> None:
        if isinstance(planner, NeedlePlanner):
            planner.seed = seed + len(outcomes) % runs

    def after(_planner: Any, _properties: Any) -> None:
        # The properties are a copy: what is set there is lost.
        path = problem._found()
        outcomes.append(Outcome(path=path, objection="" if path is None else problem.objection(path)))

    bench = tools.Benchmark(problem.setup, "needle")
    for name in names:
        bench.addPlanner(allocators[name](problem.si))
    bench.setPreRunEvent(before)
    bench.setPostRunEvent(after)
    bench.benchmark(
        tools.Request(
            maxTime=time_s,
            maxMem=_peak_memory_mb() + memory_mb,
            runCount=runs,
            displayProgress=False,
            saveConsoleOutput=False,
            simplify=False,
        )
    )
    by_planner = [outcomes[n * runs : (n + 1) * runs] for n in range(len(names))]
    if file is not None:
        with atomic_write(file) as temporary:
            if not bench.saveResultsToFile(str(temporary)):
                raise _not_written(file)
            log = temporary.read_text(encoding="utf-8")
            temporary.write_text(log_with_outcomes(log, by_planner), encoding="utf-8")
    records = bench.getRecordedExperimentData().planners
    return {
        name: summary(name, [float(run["time REAL"]) for run in record.runs], results)
        for name, record, results in zip(names, records, by_planner, strict=True)
    }


def _peak_memory_mb() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


def _not_written(file: str | Path) -> FileError:
    return FileError(f"{file} was not written by OMPL", expected="a folder that may be written to")
