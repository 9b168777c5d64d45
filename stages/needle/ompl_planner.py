"""The needle problem in OMPL: an SE(3) control problem, and a planner whose search is a compiled kernel.

The only module that imports OMPL.  Its traps, each with a test: start states are taken through
`getPlannerInputStates().nextStart()` (`getStartState` hands over ownership); the path that a caller gets
is made from the kernel's numbers (OMPL's states die with `clear`); validity functions return a real
`bool`; the planner refers to no SimpleSetup (it would never be freed), and one problem is reused for
many queries.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from ompl import base, control, util
from scipy.spatial.transform import Rotation

from anatomy.grid import Float
from anatomy.kernels.field import label_at
from anatomy.structures import OUTSIDE
from stages.needle.path import ArcPath, arc_transform
from stages.needle.searches import Query, RestartingRRT, Search
from stages.needle.space import NeedleSpace

util.setLogLevel(util.LogLevel.LOG_ERROR)

PROPAGATION_STEP = 0.05
"""Each arc has duration 1, so OMPL propagates it again in 20 steps when it checks a path."""

GOAL_TOLERANCE_MM = 1e-6
SLICE_ITERATIONS = 200


class NeedleGoal(base.GoalRegion):
    """The tip is at the target; its orientation is free."""

    def __init__(self, si: Any, target: Float) -> None:
        super().__init__(si)
        self.target = np.array(target, dtype=np.float64)
        self.setThreshold(GOAL_TOLERANCE_MM)

    def distanceGoal(self, state: Any) -> float:  # noqa: N802
        """Return the distance in mm."""
        tip = np.array([state.getX(), state.getY(), state.getZ()])
        return float(np.linalg.norm(tip - self.target))


class NeedlePlanner(base.Planner):
    """A needle search as an OMPL planner.

    `solve` runs `make_search(query)` in slices until it is finished, the termination condition holds, or
    the iterations are spent; without `anytime` it stops at the first path.  Each better path is handed to
    the problem definition at once.
    """

    def __init__(self, si: Any, make_search: Callable[[Query], Search], name: str = "NeedleRRT") -> None:
        super().__init__(si, name)
        self._si = si
        self._make_search = make_search
        self.query: Query | None = None
        self.iterations = 0
        """Most iterations to spend."""
        self.anytime = False
        self.path: ArcPath | None = None
        self.iterations_used = 0

    def solve(self, termination: Any) -> Any:
        """Search; hand paths to the problem definition as arcs of duration 1."""
        self.path = None
        self.iterations_used = 0
        query = self.query
        start = self.getPlannerInputStates().nextStart()
        if query is None or start is None:
            return base.PlannerStatus(base.PlannerStatus.INVALID_START)
        search = self._make_search(query)
        left = self.iterations
        while not (termination() or search.finished):
            portion = min(SLICE_ITERATIONS, left)
            if search.advance(portion):
                self.path = search.path
                self._hand_over()
                if not self.anytime:
                    break
            left -= portion
            if left <= 0:
                break
        self.iterations_used = self.iterations - max(left, 0)
        found = base.PlannerStatus.TIMEOUT if self.path is None else base.PlannerStatus.EXACT_SOLUTION
        return base.PlannerStatus(found)

    def _hand_over(self) -> None:
        if self.path is None:
            return
        path = control.PathControl(self._si)
        # OMPL splits an arc in steps of equal controls, so here the roll is counted from the start.
        roll = 0.0
        for frame, (length, turned, curvature) in zip(self.path.frames(), self.path.arcs, strict=False):
            u = self._si.allocControl()
            start = frame @ arc_transform(0.0, -roll, 0.0)
            roll = math.remainder(roll + turned, 2 * math.pi)
            u[0], u[1], u[2] = float(length), roll, float(curvature)
            path.append(self._state(start), u, 1.0)
        path.append(self._state(self.path.frames()[-1] @ arc_transform(0.0, -roll, 0.0)))
        definition = self.getProblemDefinition()
        definition.clearSolutionPaths()
        definition.addSolutionPath(path)

    def _state(self, frame: Float) -> Any:
        state = self._si.allocState()
        write_state(state, frame)
        return state


def write_state(state: Any, frame: Float) -> None:
    """Set an OMPL SE(3) state to a frame."""
    state.setX(float(frame[0, 3]))
    state.setY(float(frame[1, 3]))
    state.setZ(float(frame[2, 3]))
    x, y, z, w = (float(v) for v in Rotation.from_matrix(frame[:3, :3]).as_quat())
    rotation = state.rotation()
    rotation.x, rotation.y, rotation.z, rotation.w = x, y, z, w


def read_state(state: Any) -> Float:
    """Return the frame of an OMPL SE(3) state."""
    rotation = state.rotation()
    frame = np.eye(4)
    frame[:3, :3] = Rotation.from_quat([rotation.x, rotation.y, rotation.z, rotation.w]).as_matrix()
    frame[:3, 3] = state.getX(), state.getY(), state.getZ()
    return frame


class NeedleProblem:
    """Plans needle paths in one lung with OMPL; made once, asked many times.

    Parameters
    ----------
    space : NeedleSpace
    """

    def __init__(self, space: NeedleSpace) -> None:
        self._space = space
        self._seed = 1
        self._states = base.SE3StateSpace()
        self._states.setBounds(_bounds_of(space))
        controls = control.RealVectorControlSpace(self._states, 3)
        controls.setBounds(_control_bounds(space))
        self.setup = control.SimpleSetup(controls)
        self._si = self.setup.getSpaceInformation()
        self._si.setPropagationStepSize(PROPAGATION_STEP)
        self._si.setMinMaxControlDuration(1, round(1 / PROPAGATION_STEP))
        self.setup.setStatePropagator(_propagate)
        self.setup.setStateValidityChecker(_validity(space))
        self.planner = NeedlePlanner(self._si, self._rrt)
        self.setup.setPlanner(self.planner)

    def plan(self, query: Query, *, seed: int, iterations: int, time_s: float = math.inf) -> ArcPath | None:
        """Search a path of arcs with the RRT.

        Parameters
        ----------
        query : Query
        seed, iterations : int
            The same pair gives the same path, if the time does not run out first.
        time_s : float
            Stop after this time.

        Returns
        -------
        ArcPath or None
            A path proved clear and within all limits; None if none was found.
        """
        self._seed = seed
        self.planner.query = query
        self.planner.iterations = iterations
        definition = base.ProblemDefinition(self._si)
        start = self._si.allocState()
        write_state(start, query.lps_from_start)
        definition.addStartState(start)
        definition.setGoal(NeedleGoal(self._si, query.target))
        self.planner.clear()
        self.planner.setProblemDefinition(definition)
        # Not through SimpleSetup.solve, which sets everything up again for each query.
        self.planner.solve(_termination(time_s))
        return self.planner.path

    def _rrt(self, query: Query) -> Search:
        return RestartingRRT(self._space, query, seed=self._seed)


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
    """Bound length, roll and curvature of an arc."""
    bounds = base.RealVectorBounds(3)
    highs = (space.needle.max_length_mm, math.pi, space.needle.max_curvature_per_mm)
    for n, (low, high) in enumerate(zip((0.0, -math.pi, 0.0), highs, strict=True)):
        bounds.setLow(n, low)
        bounds.setHigh(n, high)
    return bounds


def _propagate(state: Any, u: Any, duration: float, result: Any) -> None:
    """Advance a state along a share `duration` of an arc that bends towards `u[1]` about its axis."""
    bent = read_state(state) @ arc_transform(duration * u[0], u[1], u[2])
    write_state(result, bent @ arc_transform(0.0, -u[1], 0.0))


def _validity(space: NeedleSpace) -> Any:
    _field, labels, geometry, _bits = space.arrays

    def is_valid(state: Any) -> bool:
        label = label_at(labels, geometry, state.getX(), state.getY(), state.getZ())
        return bool(label & OUTSIDE == 0)

    return is_valid
