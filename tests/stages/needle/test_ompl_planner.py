"""The needle problem in OMPL: one test for each trap that the adapter avoids."""

from __future__ import annotations

import gc
import resource
import sys
import weakref
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from ompl import base

from anatomy.grid import Float
from anatomy.lung import Lung
from anatomy.margins import Margins
from anatomy.structures import OUTSIDE, VESSEL
from stages.needle.device import Needle
from stages.needle.ompl_planner import NeedleGoal, NeedleProblem, read_state, write_state
from stages.needle.path import ArcPath, blocker_on_path
from stages.needle.searches import Query
from stages.needle.space import NeedleSpace, needle_space
from tests.stages.scenes import Canvas

GOAL = np.array([0.0, 0.0, 28.0])
ITERATIONS = 5000


def scene() -> Lung:
    """A vessel ball between start and goal; the lung ends at x = -28."""
    canvas = Canvas.empty([-32, -32, -32], [32, 32, 32], 1.0)
    canvas.add(canvas.ball([0, 0, 0], 4.0), VESSEL)
    canvas.add(canvas.points[..., 0] < -28, OUTSIDE)
    return canvas.lung()


@pytest.fixture(scope="module")
def space() -> NeedleSpace:
    needle = Needle(diameter_mm=1.0, max_curvature_per_mm=1 / 30)
    return needle_space(scene(), needle, Margins(), with_fissures=False)


@pytest.fixture(scope="module")
def problem(space: NeedleSpace) -> NeedleProblem:
    return NeedleProblem(space)


def start() -> Float:
    frame = np.eye(4)
    frame[:3, 3] = 0.0, 0.0, -28.0
    return frame


def query(branch: int = -1) -> Query:
    return Query(lps_from_start=start(), target=GOAL, branch=branch)


def ask(problem: NeedleProblem, seed: int = 1, **more: Any) -> ArcPath | None:
    values = {"seed": seed, "iterations": ITERATIONS, **more}
    return problem.plan(query(), **values)


def require(path: ArcPath | None) -> ArcPath:
    assert path is not None
    return path


def prepare_setup(problem: NeedleProblem, seed: int = 1) -> None:
    """Put the same question to OMPL's SimpleSetup."""
    problem.planner.query = query()
    problem.planner.iterations = ITERATIONS
    problem.setup.clear()
    problem.setup.clearStartStates()
    state = problem.setup.getSpaceInformation().allocState()
    write_state(state, start())
    problem.setup.setStartState(state)
    problem.setup.setGoal(NeedleGoal(problem.setup.getSpaceInformation(), GOAL))


def test_a_planner_written_in_python_solves(problem: NeedleProblem, space: NeedleSpace) -> None:
    path = require(ask(problem))
    assert len(path.arcs) >= 2
    assert np.linalg.norm(path.frames()[-1][:3, 3] - GOAL) < 1e-6
    assert blocker_on_path(space, path, -1) == 0
    assert np.array_equal(path.lps_from_start, start())


def test_the_simple_setup_of_ompl_solves_with_the_same_planner(problem: NeedleProblem) -> None:
    expected = require(ask(problem)).arcs
    prepare_setup(problem)
    status = problem.setup.solve(60.0)
    assert bool(status) and problem.setup.haveExactSolutionPath()
    assert problem.setup.getSolutionPath().check()
    assert np.array_equal(require(problem.planner.path).arcs, expected)


def test_a_solve_without_query_or_start_is_no_crash(space: NeedleSpace) -> None:
    problem = NeedleProblem(space)
    prepare_setup(problem)
    problem.planner.query = None
    assert not bool(problem.setup.solve(1.0))
    prepare_setup(problem)
    problem.setup.clearStartStates()
    assert not bool(problem.planner.solve(base.plannerNonTerminatingCondition()))


def test_ompl_propagates_the_arcs_to_the_same_end(space: NeedleSpace) -> None:
    """Its own propagation, in steps of a twentieth of each arc, against the kernel's numbers."""
    needle = replace(space.needle, max_angle_from_start_deg=28.0)
    problem = NeedleProblem(needle_space(scene(), needle, Margins(), with_fissures=False))
    deepest = 0
    for seed in range(6):
        path = require(ask(problem, seed))
        solution = problem.planner.getProblemDefinition().getSolutionPath()
        assert solution.check()
        info = problem.setup.getSpaceInformation()
        state = info.allocState()
        info.copyState(state, solution.getState(0))
        for n, frame in enumerate(path.frames()[1:]):
            info.propagate(state, solution.getControl(n), 20, state)
            reached = read_state(state)
            assert np.linalg.norm(reached[:3, 3] - frame[:3, 3]) < 1e-9
            assert np.linalg.norm(reached[:3, 2] - frame[:3, 2]) < 1e-9
        assert np.linalg.norm(read_state(state)[:3, 3] - GOAL) < 1e-9
        deepest = max(deepest, len(path.arcs))
    assert deepest >= 3


def test_the_check_of_ompl_notices_a_path_that_is_not_the_arcs(problem: NeedleProblem) -> None:
    require(ask(problem))
    solution = problem.planner.getProblemDefinition().getSolutionPath()
    solution.getControl(0)[0] *= 1.01
    assert not solution.check()


def test_the_path_outlives_the_states_of_ompl(problem: NeedleProblem) -> None:
    path = require(ask(problem))
    before = path.arcs.copy(), path.frames().copy()
    problem.planner.clear()
    problem.planner.getProblemDefinition().clearSolutionPaths()
    require(ask(problem, seed=2))
    assert np.array_equal(path.arcs, before[0])
    assert np.array_equal(path.frames(), before[1])


def test_the_same_seed_gives_the_same_path(problem: NeedleProblem, space: NeedleSpace) -> None:
    first, again = require(ask(problem, 7)), require(ask(problem, 7))
    assert np.array_equal(first.arcs, again.arcs)
    assert np.array_equal(first.arcs, require(ask(NeedleProblem(space), 7)).arcs)
    assert not np.array_equal(first.arcs, require(ask(problem, 8)).arcs)


def test_a_termination_condition_that_holds_already_stops_at_once(problem: NeedleProblem) -> None:
    require(ask(problem))
    assert ask(problem, time_s=0.0) is None
    assert problem.planner.iterations_used == 0
    prepare_setup(problem)
    status = problem.setup.solve(base.plannerAlwaysTerminatingCondition())
    assert not bool(status)
    assert problem.planner.path is None and problem.planner.iterations_used == 0


def test_the_iterations_are_a_limit(problem: NeedleProblem) -> None:
    in_vessel = np.zeros(3)
    assert problem.plan(start(), in_vessel, branch=-1, seed=0, iterations=450) is None
    assert problem.planner.iterations_used == 450
    assert problem.plan(start(), in_vessel, branch=-1, seed=0, iterations=0) is None
    assert problem.planner.iterations_used == 0


def test_without_iterations_only_the_direct_arc_is_tried(problem: NeedleProblem) -> None:
    aside = np.array([15.0, 0.0, 5.0])
    path = require(problem.plan(start(), aside, branch=-1, seed=0, iterations=0))
    assert len(path.arcs) == 1
    assert ask(problem, iterations=0) is None


def test_a_start_outside_the_lung_is_refused_by_the_validity_checker(problem: NeedleProblem) -> None:
    """The checker returns a real bool: numpy's raises `std::bad_cast`."""
    info = problem.setup.getSpaceInformation()
    state = info.allocState()
    write_state(state, start())
    assert info.isValid(state) is True
    outside = start()
    outside[0, 3] = -30.0
    write_state(state, outside)
    assert info.isValid(state) is False
    assert problem.plan(outside, GOAL, branch=-1, seed=0, iterations=100) is None


def test_states_and_frames_are_the_same_thing(problem: NeedleProblem) -> None:
    from scipy.spatial.transform import Rotation

    state = problem.setup.getSpaceInformation().allocState()
    for seed in range(20):
        frame = np.eye(4)
        frame[:3, :3] = Rotation.random(random_state=seed).as_matrix()
        frame[:3, 3] = np.random.default_rng(seed).uniform(-30, 30, 3)
        write_state(state, frame)
        assert np.abs(read_state(state) - frame).max() < 1e-14


def test_the_bounds_hold_the_whole_lung(problem: NeedleProblem) -> None:
    bounds = problem.setup.getSpaceInformation().getStateSpace().getBounds()
    assert [float(bounds.low[n]) for n in range(3)] == pytest.approx([-32.0] * 3)
    assert [float(bounds.high[n]) for n in range(3)] == pytest.approx([32.0] * 3)


def peak_mib() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


def test_memory_does_not_grow_with_queries(problem: NeedleProblem) -> None:
    for seed in range(200):
        ask(problem, seed)
    before = peak_mib()
    for seed in range(2000):
        ask(problem, seed)
    assert peak_mib() - before < 8.0


def test_a_problem_is_freed_when_it_is_dropped(space: NeedleSpace) -> None:
    """A planner that referred to the setup it is installed in would keep its search tree for ever."""
    problem = NeedleProblem(space)
    ask(problem)
    prepare_setup(problem)
    problem.setup.solve(60.0)
    tree = weakref.ref(problem.planner._nodes)
    assert tree() is not None
    del problem
    gc.collect()
    assert tree() is None


def test_the_exemption_reaches_the_kernel(space: NeedleSpace) -> None:
    """A start in the wall of branch 0 has a path only if that is the pierced branch."""
    canvas = Canvas.empty([-20, -20, -20], [20, 20, 20], 1.0)
    x = canvas.points[..., 0]
    canvas.airway(x < -4, x < 0, 0)
    wall = needle_space(canvas.lung(), space.needle, Margins(), with_fissures=False)
    problem = NeedleProblem(wall)
    frame = np.eye(4)
    frame[:3, :3] = [[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    frame[0, 3] = -1.0
    assert problem.plan(frame, np.array([12.0, 1.0, 0.0]), branch=0, seed=0, iterations=50) is not None
    assert problem.plan(frame, np.array([12.0, 1.0, 0.0]), branch=1, seed=0, iterations=50) is None
