"""The needle problem in OMPL: its planners and ours on one setup, and one test for each trap avoided."""

from __future__ import annotations

import ast
import gc
import json
import math
import re
import resource
import subprocess
import sys
import weakref
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ompl import base, control
from ompl.tools import readBenchmarkLog
from scipy.spatial.transform import Rotation

from anatomy.errors import FileError, SettingsError
from anatomy.kernels.field import exact_at
from anatomy.lung import Lung
from anatomy.margins import Margins
from anatomy.structures import OUTSIDE, VESSEL
from anatomy.typed import Float
from stages.needle import ompl as ompl_planner
from stages.needle.device import Needle
from stages.needle.environment import NeedleEnvironment, needle_environment
from stages.needle.kernels.states import proved_step
from stages.needle.ompl import (
    NeedleGoal,
    NeedlePlanner,
    NeedleProblem,
    benchmark,
    path_of,
    read_state,
    seed_ompl,
    write_state,
)
from stages.needle.path import ArcPath, arc_transform, blocker_on_path
from stages.needle.query import Query
from stages.needle.search.base import RestartingRRT, Search
from stages.needle.search.planners import PLANNERS
from tests.stages.scenes import Canvas

GOAL = np.array([0.0, 0.0, 28.0])
NEAR = np.array([8.0, 0.0, -4.0])
ITERATIONS = 5000
OMPL_PLANNERS = ("control.RRT", "control.EST", "control.KPIECE1")
LONG_S = 60.0
"""No test waits so long: what it stands for is found within a second."""


def scene() -> Lung:
    """A vessel ball between start and goal; the lung ends at x = -28."""
    canvas = Canvas.empty([-32, -32, -32], [32, 32, 32], 1.0)
    canvas.add(canvas.ball([0, 0, 0], 4.0), VESSEL)
    canvas.add(canvas.points[..., 0] < -28, OUTSIDE)
    return canvas.lung()


@pytest.fixture(scope="module")
def environment() -> NeedleEnvironment:
    needle = Needle(diameter_mm=1.0, max_curvature_per_mm=1 / 30)
    return needle_environment(scene(), needle, Margins(), with_fissures=False)


@pytest.fixture(scope="module")
def problem(environment: NeedleEnvironment) -> NeedleProblem:
    return NeedleProblem(environment)


def with_needle(environment: NeedleEnvironment, **more: float) -> NeedleEnvironment:
    return needle_environment(scene(), replace(environment.needle, **more), Margins(), with_fissures=False)


def start() -> Float:
    frame = np.eye(4)
    frame[:3, 3] = 0.0, 0.0, -28.0
    return frame


def query(target: Float = GOAL, **more: Any) -> Query:
    return Query(**{"lps_from_start": start(), "target": target, **more})


def ask(problem: NeedleProblem, seed: int = 1, **more: Any) -> ArcPath | None:
    return problem.plan(query(), **{"seed": seed, "iterations": ITERATIONS, **more})


def require(path: ArcPath | None) -> ArcPath:
    assert path is not None
    return path


def handed_over(problem: NeedleProblem) -> Any:
    return problem.own().getProblemDefinition().getSolutionPath()


def arcs_of(*arcs: tuple[float, float, float]) -> ArcPath:
    return ArcPath(lps_from_start=start(), arcs=np.array(arcs))


class Given:
    """A search that finds the paths it is given, one a slice."""

    def __init__(self, *paths: ArcPath) -> None:
        self.path: ArcPath | None = None
        self.cost = math.inf
        self.finished = False
        self._paths = list(paths)

    def advance(self, iterations: int) -> bool:
        self.path = self._paths.pop(0)
        self.finished = not self._paths
        return True


def given(*paths: ArcPath) -> Callable[[NeedleEnvironment, Query, int], Search]:
    return lambda _environment, _query, _seed: Given(*paths)


# A query answered with arcs.


def test_a_planner_written_in_python_solves(problem: NeedleProblem, environment: NeedleEnvironment) -> None:
    path = require(ask(problem))
    assert len(path.arcs) >= 2
    assert np.linalg.norm(path.frames()[-1][:3, 3] - GOAL) < 1e-6
    assert blocker_on_path(environment, path, -1) == 0
    assert np.array_equal(path.lps_from_start, start())


def test_the_same_seed_gives_the_same_path(problem: NeedleProblem, environment: NeedleEnvironment) -> None:
    first, again = require(ask(problem, 7)), require(ask(problem, 7))
    assert np.array_equal(first.arcs, again.arcs)
    assert np.array_equal(first.arcs, require(ask(NeedleProblem(environment), 7)).arcs)
    assert not np.array_equal(first.arcs, require(ask(problem, 8)).arcs)


def test_the_iterations_are_a_limit(problem: NeedleProblem) -> None:
    in_vessel = query(np.zeros(3))
    assert problem.plan(in_vessel, seed=0, iterations=450) is None
    assert problem.own().iterations_used == 450
    assert problem.plan(in_vessel, seed=0, iterations=0) is None
    assert problem.own().iterations_used == 0


def test_without_iterations_only_the_direct_arc_is_tried(problem: NeedleProblem) -> None:
    path = require(problem.plan(query(np.array([15.0, 0.0, 5.0])), seed=0, iterations=0))
    assert len(path.arcs) == 1
    assert ask(problem, iterations=0) is None


def test_anytime_goes_on_to_shorter_paths(problem: NeedleProblem) -> None:
    first, last = require(ask(problem)), require(ask(problem, anytime=True))
    assert problem.own().iterations_used == ITERATIONS
    assert last.length_mm < first.length_mm


def test_a_termination_condition_that_holds_already_stops_at_once(problem: NeedleProblem) -> None:
    require(ask(problem))
    assert ask(problem, time_s=0.0) is None
    assert problem.own().iterations_used == 0
    problem.pose(query())
    status = problem.setup.solve(base.plannerAlwaysTerminatingCondition())
    assert not bool(status)
    assert problem.planner.path is None and problem.planner.iterations_used == 0


def test_the_exemption_reaches_the_kernel(environment: NeedleEnvironment) -> None:
    """A start in the wall of branch 0 has a path only if that is the pierced branch."""
    canvas = Canvas.empty([-20, -20, -20], [20, 20, 20], 1.0)
    x = canvas.points[..., 0]
    canvas.airway(x < -4, x < 0, 0)
    problem = NeedleProblem(
        needle_environment(canvas.lung(), environment.needle, Margins(), with_fissures=False)
    )
    frame = np.eye(4)
    frame[:3, :3] = [[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    frame[0, 3] = -1.0
    pierced = Query(lps_from_start=frame, target=np.array([12.0, 1.0, 0.0]), branch=0)
    path = require(problem.plan(pierced, seed=0, iterations=50))
    assert handed_over(problem).check() and problem.violation(path) == ""
    assert problem.plan(replace(pierced, branch=1), seed=0, iterations=50) is None
    assert "airway" in problem.violation(path)
    # The wall is exempt at the exit alone, which lies behind a needle that is on its way.
    assert problem.plan(replace(pierced, inserted_mm=6.0), seed=0, iterations=50) is None
    assert "airway" in problem.violation(path)


def test_searches_are_chosen_by_name(environment: NeedleEnvironment) -> None:
    path = arcs_of((20.0, 0.0, 0.0))
    problem = NeedleProblem(
        environment,
        {
            "line": given(path),
            "tree": lambda environment, query, seed: RestartingRRT(environment, query, seed=seed),
        },
    )
    assert require(ask(problem)) is path
    assert len(require(ask(problem, method="tree")).arcs) >= 2
    assert list(problem.planners()) == ["line", "tree", *OMPL_PLANNERS]
    assert problem.own("tree").getName() == "tree"
    with pytest.raises(SettingsError, match="line, tree"):
        ask(problem, method="maze")


# The same question to OMPL's SimpleSetup.


def test_the_simple_setup_of_ompl_solves_with_the_same_planner(problem: NeedleProblem) -> None:
    expected = require(ask(problem)).arcs
    problem.pose(query())
    status = problem.setup.solve(LONG_S)
    assert bool(status) and problem.setup.haveExactSolutionPath()
    assert problem.setup.getSolutionPath().check()
    assert np.array_equal(require(problem.planner.path).arcs, expected)
    assert np.abs(require(problem.solution()).frames() - require(problem.planner.path).frames()).max() < 1e-9


def test_a_planner_may_be_allocated_by_the_setup(environment: NeedleEnvironment) -> None:
    problem = NeedleProblem(environment)
    problem.setup.setPlannerAllocator(problem.planners()["rrt"])
    problem.pose(query())
    assert bool(problem.setup.solve(LONG_S))
    assert isinstance(problem.setup.getPlanner(), NeedlePlanner)
    require(problem.solution())


@pytest.mark.parametrize("name", OMPL_PLANNERS)
def test_planners_of_ompl_run_on_the_same_problem(problem: NeedleProblem, name: str) -> None:
    asked = query(NEAR)
    problem.pose(asked, goal_tolerance_mm=4.0)
    problem.setup.setPlanner(problem.planners()[name](problem.si))
    try:
        assert problem.setup.solve(LONG_S).asString() == "Exact solution"
        path = require(problem.solution())
        found = problem.setup.getSolutionPath()
        assert found.check()
    finally:
        problem.setup.setPlanner(problem.planner)
    assert 1e-3 < np.linalg.norm(path.frames()[-1][:3, 3] - NEAR) < 4.0
    last = read_state(found.getState(found.getStateCount() - 1))
    assert np.abs(path.frames()[-1][:3, 2:] - last[:3, 2:]).max() < 1e-9
    assert path.arcs[:, 2].max() <= 1 / 30
    assert blocker_on_path(problem.environment, path, -1) == 0


def test_a_solve_without_query_or_start_is_no_crash(environment: NeedleEnvironment) -> None:
    problem = NeedleProblem(environment)
    alone = NeedlePlanner(problem.si, lambda _query, _seed: Given(), ompl_planner.Question())
    problem.pose(query())
    problem.setup.setPlanner(alone)
    assert problem.setup.solve(1.0).asString() == "Invalid start"
    problem.setup.setPlanner(problem.planner)
    problem.setup.clearStartStates()
    problem.planner.setProblemDefinition(problem.setup.getProblemDefinition())
    assert not bool(problem.planner.solve(base.plannerNonTerminatingCondition()))


def test_a_start_that_is_not_the_query_is_refused(problem: NeedleProblem) -> None:
    problem.pose(query())
    state = problem.si.allocState()
    write_state(state, start() @ arc_transform(0.5, 0.0, 0.0))
    problem.setup.setStartState(state)
    assert problem.setup.solve(1.0).asString() == "Invalid start"
    problem.pose(query())
    ask(problem, iterations=0)
    problem.plan(
        replace(query(), lps_from_start=start() @ arc_transform(1.0, 0.0, 0.0)), seed=1, iterations=0
    )
    assert problem.setup.solve(1.0).asString() == "Invalid start"


def test_a_path_to_another_goal_is_an_approximate_solution(problem: NeedleProblem) -> None:
    problem.pose(query(NEAR))
    problem.setup.setGoal(NeedleGoal(problem.si, NEAR + [0.0, 3.0, 4.0]))
    assert problem.setup.solve(LONG_S).asString() == "Approximate solution"
    assert problem.setup.getProblemDefinition().getSolutionDifference() == pytest.approx(5.0, abs=1e-5)
    assert problem.solution() is None


def test_the_goal_is_a_ball_and_any_orientation_at_its_centre(problem: NeedleProblem) -> None:
    goal = NeedleGoal(problem.si, NEAR, 2.0)
    state = problem.si.allocState()
    forwards = []
    for _ in range(4):
        goal.sampleGoal(state)
        assert np.array_equal(read_state(state)[:3, 3], NEAR)
        forwards.append(read_state(state)[:3, 2])
    assert np.linalg.norm(np.diff(forwards, axis=0), axis=1).min() > 1e-3
    for away, inside in ((1.99, True), (2.01, False)):
        state.setX(float(NEAR[0]) + away)
        assert goal.isSatisfied(state) is inside


# OMPL's own propagation: independent arithmetic, and proved.


def test_ompl_propagates_the_arcs_to_the_same_end(environment: NeedleEnvironment) -> None:
    """Quaternions in steps of a twentieth of each control, against the kernel's numbers."""
    problem = NeedleProblem(with_needle(environment, max_angle_from_start_deg=28.0))
    deepest = 0
    for seed in range(6):
        path = require(ask(problem, seed))
        solution = handed_over(problem)
        assert solution.check()
        state = problem.si.allocState()
        problem.si.copyState(state, solution.getState(0))
        for n in range(solution.getControlCount()):
            problem.si.propagate(state, solution.getControl(n), 20, state)
        assert np.linalg.norm(read_state(state)[:3, 3] - GOAL) < 1e-9
        assert np.linalg.norm(read_state(state)[:3, 2] - path.frames()[-1][:3, 2]) < 1e-9
        assert np.abs(path_of(solution).frames() - path.frames()).max() < 1e-9
        deepest = max(deepest, len(path.arcs))
    assert deepest >= 3


def test_no_step_of_a_handed_over_path_is_longer_than_a_millimetre(problem: NeedleProblem) -> None:
    require(ask(problem))
    solution = handed_over(problem)
    bound = problem.si.getControlSpace().getBounds().high[0]
    lengths = [solution.getControl(n)[0] for n in range(solution.getControlCount())]
    assert max(lengths) <= bound == 20.0
    assert problem.si.getPropagationStepSize() * bound <= 1.0
    assert set(solution.getControlDurations()) == {1.0}


def test_the_check_of_ompl_notices_a_path_that_is_not_the_arcs(problem: NeedleProblem) -> None:
    require(ask(problem))
    solution = handed_over(problem)
    solution.getControl(0)[0] *= 1.01
    assert not solution.check()


def test_a_step_is_the_arc(environment: NeedleEnvironment) -> None:
    rng = np.random.default_rng(0)
    for seed in range(50):
        frame = np.eye(4)
        frame[:3, :3] = Rotation.random(random_state=seed).as_matrix()
        frame[:3, 3] = 15.0, 15.0, 15.0
        length, roll, curvature = rng.uniform([0.0, -3.0, 0.0], [5.0, 3.0, 1 / 30])
        problem = NeedleProblem(environment)
        before, after = problem.si.allocState(), problem.si.allocState()
        write_state(before, frame)
        problem.pose(Query(lps_from_start=frame, target=GOAL))
        u = problem.si.allocControl()
        u[0], u[1], u[2] = length, roll, curvature
        problem.si.propagate(before, u, 20, after)
        expected = frame @ arc_transform(length, roll, curvature) @ arc_transform(0.0, -roll, 0.0)
        assert np.abs(read_state(after) - expected).max() < 1e-12


def test_states_and_frames_are_the_same_thing(problem: NeedleProblem) -> None:
    state = problem.si.allocState()
    half_turns = [Rotation.from_rotvec(np.pi * axis).as_matrix() for axis in np.eye(3)]
    randoms = [Rotation.random(random_state=seed).as_matrix() for seed in range(50)]
    for n, rotation in enumerate([np.eye(3), *half_turns, *randoms]):
        frame = np.eye(4)
        frame[:3, :3] = rotation
        frame[:3, 3] = np.random.default_rng(n).uniform(-30, 30, 3)
        write_state(state, frame)
        assert np.abs(read_state(state) - frame).max() < 1e-14


def test_the_bounds_hold_the_whole_lung(problem: NeedleProblem) -> None:
    bounds = problem.si.getStateSpace().getBounds()
    assert [float(bounds.low[n]) for n in range(3)] == pytest.approx([-32.0] * 3)
    assert [float(bounds.high[n]) for n in range(3)] == pytest.approx([32.0] * 3)


def thin_sheet() -> NeedleEnvironment:
    """A vessel 0.2 mm thick across the way at z = 0, and a needle of 0.1 mm."""
    canvas = Canvas.empty([-4, -4, -4], [4, 4, 4], 0.2)
    canvas.add(np.abs(canvas.points[..., 2] - 0.1) < 0.05, VESSEL)
    needle = Needle(diameter_mm=0.1, max_curvature_per_mm=0.05)
    return needle_environment(canvas.lung(), needle, Margins(segmentation_margin_mm=0.0), with_fissures=False)


def test_a_step_over_an_obstacle_between_two_valid_states_is_refused() -> None:
    problem = NeedleProblem(thin_sheet())
    frame = np.eye(4)
    frame[2, 3] = -0.3
    problem.pose(Query(lps_from_start=frame, target=np.array([0.0, 0.0, 2.0])))
    before, after = problem.si.allocState(), problem.si.allocState()
    write_state(before, frame)
    for height, clear in ((-0.3, True), (0.0, False), (0.2, False), (0.6, True)):
        frame[2, 3] = height
        write_state(after, frame)
        assert problem.si.isValid(after) is clear
    u = problem.si.allocControl()
    u[0], u[1], u[2] = 18.0, 0.0, 0.0
    assert problem.si.propagateWhileValid(before, u, 1, after) == 0
    problem.si.propagate(before, u, 1, after)
    assert math.isnan(after.getX()) and not problem.si.isValid(after)
    u[0] = 4.0
    assert problem.si.propagateWhileValid(before, u, 1, after) == 1


def test_a_step_backwards_is_refused(environment: NeedleEnvironment) -> None:
    moved = proved_step(
        environment.obstacles, environment.limits, (15.0, 15.0, 15.0, 0.0, 0.0, 0.0, 1.0), 0.0, 0.0, -1.0,
        (15.0, 15.0, 15.0, 0.0, 0.0, 1.0, 0.0), -1,
    )  # fmt: skip
    assert math.isnan(moved[0])


def test_what_is_proved_as_arcs_passes_in_steps(environment: NeedleEnvironment) -> None:
    """Short paths graze the obstacle, where steps meet points that the arcs' proof passed over."""
    problem = NeedleProblem(environment)
    rng = np.random.default_rng(0)
    _field, labels, geometry, bits = environment.obstacles
    grazing = 0
    for seed in range(25):
        target = np.append(rng.uniform(-4, 4, 2), rng.uniform(15, 28))
        path = require(problem.plan(query(target), seed=seed, iterations=3000, anytime=True))
        assert handed_over(problem).check()
        points, _lengths = path.sample(0.02)
        distances = np.zeros(len(points))
        exact_at(labels, geometry, points, bits, -1, 2.0, distances)
        grazing += float(distances.min()) < environment.required_clearance_mm + 0.03
    assert grazing >= 3


@pytest.mark.parametrize(
    ("gap_mm", "as_arc", "in_steps"),
    [(0.006, True, True), (0.004, False, True), (0.001, False, False), (-0.001, False, False)],
)
def test_a_step_needs_half_of_what_an_arc_needs_to_spare(gap_mm: float, as_arc: bool, in_steps: bool) -> None:
    """Along a wall, where the same gap is left all the way; beyond the required clearance nothing passes."""
    canvas = Canvas.empty([-8, -8, -8], [8, 8, 8], 1.0)
    canvas.add(canvas.points[..., 0] > 0, VESSEL)
    needle = Needle(diameter_mm=1.0, max_curvature_per_mm=0.05)
    problem = NeedleProblem(needle_environment(canvas.lung(), needle, Margins(), with_fissures=False))
    frame = np.eye(4)
    frame[0, 3] = -problem.environment.required_clearance_mm - gap_mm
    problem.pose(Query(lps_from_start=frame, target=frame[:3, 3] + [0.0, 0.0, 4.0]))
    assert (
        problem.violation(ArcPath(lps_from_start=frame, arcs=np.array([[4.0, 0.0, 0.0]]))) == ""
    ) is as_arc
    state, u = problem.si.allocState(), problem.si.allocControl()
    write_state(state, frame)
    u[0], u[1], u[2] = 4.0, 0.0, 0.0
    assert problem.si.isValid(state) is in_steps
    assert problem.si.propagateWhileValid(state, u, 20, state) == (20 if in_steps else 0)


def test_a_start_that_is_not_clear_is_refused_by_the_validity_checker(problem: NeedleProblem) -> None:
    """The checker returns a real bool: numpy's raises `std::bad_cast`."""
    problem.pose(query())
    state = problem.si.allocState()
    write_state(state, start())
    assert problem.si.isValid(state) is True
    near_pleura = start()
    near_pleura[0, 3] = -27.6
    for frame in (
        near_pleura,
        start() @ arc_transform(24.0, 0.0, 0.0),
        start() @ arc_transform(-30.0, 0.0, 0.0),
    ):
        write_state(state, frame)
        assert problem.si.isValid(state) is False
    assert problem.plan(replace(query(), lps_from_start=near_pleura), seed=0, iterations=100) is None
    assert problem.own().search is None


def test_no_state_is_valid_before_a_query(environment: NeedleEnvironment) -> None:
    problem = NeedleProblem(environment)
    state = problem.si.allocState()
    write_state(state, start())
    assert problem.si.isValid(state) is False


def test_a_state_is_valid_only_within_the_angle_and_length(environment: NeedleEnvironment) -> None:
    problem = NeedleProblem(with_needle(environment, max_angle_from_start_deg=30.0, max_length_mm=20.0))
    state = problem.si.allocState()

    def valid(turned_deg: float, ahead_mm: float, asked: Query) -> bool:
        frame = start() @ arc_transform(ahead_mm, 0.0, 0.0)
        frame[:3, :3] = Rotation.from_euler("x", turned_deg, degrees=True).as_matrix()
        write_state(state, frame)
        problem.pose(asked)
        return bool(problem.si.isValid(state))

    assert valid(29.9, 0.0, query()) and not valid(30.1, 0.0, query())
    assert valid(0.0, 19.9, query()) and not valid(0.0, 20.1, query())
    tilted = query(reference=np.array([0.0, -math.sin(math.radians(20)), math.cos(math.radians(20))]))
    assert valid(49.9, 0.0, tilted) and not valid(-10.1, 0.0, tilted)
    assert valid(0.0, 4.9, query(inserted_mm=15.0)) and not valid(0.0, 5.1, query(inserted_mm=15.0))


def test_what_ompl_takes_for_a_solution_is_refused_if_it_is_none(environment: NeedleEnvironment) -> None:
    through = arcs_of((40.0, 0.0, 0.0))
    problem = NeedleProblem(environment, {"given": given(through)})
    assert "no query" in problem.violation(through)
    problem.pose(query(through.frames()[-1][:3, 3]))
    assert problem.setup.solve(1.0).asString() == "Exact solution"
    assert problem.solution() is None
    assert "vessel" in problem.violation(path_of(problem.setup.getSolutionPath()))


def test_controls_that_bend_alike_become_one_arc(problem: NeedleProblem) -> None:
    solution = control.PathControl(problem.si)
    state = problem.si.allocState()
    write_state(state, start())
    for length, roll, curvature, duration in (
        (10.0, 3.0, 0.01, 0.5), (8.0, 3.0, 0.01, 0.25), (8.0, -3.0, 0.01, 1.0), (8.0, -3.0, 0.02, 1.0)
    ):  # fmt: skip
        u = problem.si.allocControl()
        u[0], u[1], u[2] = length, roll, curvature
        solution.append(state, u, duration)
    solution.append(state)
    expected = [[7.0, 3.0, 0.01], [8.0, 2 * math.pi - 6.0, 0.01], [8.0, 0.0, 0.02]]
    assert np.abs(path_of(solution).arcs - expected).max() < 1e-12


# Traps of OMPL.


def test_the_path_outlives_the_states_of_ompl(problem: NeedleProblem) -> None:
    path = require(ask(problem))
    before = path.arcs.copy(), path.frames().copy()
    problem.own().clear()
    problem.own().getProblemDefinition().clearSolutionPaths()
    require(ask(problem, seed=2))
    assert np.array_equal(path.arcs, before[0])
    assert np.array_equal(path.frames(), before[1])


def test_a_converted_path_outlives_the_setup(environment: NeedleEnvironment) -> None:
    problem = NeedleProblem(environment)
    problem.pose(query())
    assert bool(problem.setup.solve(LONG_S))
    path = require(problem.solution())
    expected = path.arcs.copy(), path.lps_from_start.copy()
    problem.setup.clear()
    del problem
    gc.collect()
    assert np.array_equal(path.arcs, expected[0]) and np.array_equal(path.lps_from_start, expected[1])


def test_the_best_path_is_the_only_solution_of_the_problem_definition(environment: NeedleEnvironment) -> None:
    """OMPL would rank by the number of arcs, and put the first path before the cheaper second."""
    costly, cheap = arcs_of((20.0, 0.0, 0.0)), arcs_of((8.0, 0.0, 0.01), (8.0, 1.0, 0.01), (4.0, 0.0, 0.0))
    problem = NeedleProblem(environment, {"given": given(costly, cheap)})
    target = cheap.frames()[-1][:3, 3]
    problem.pose(query(target), goal_tolerance_mm=5.0)
    problem.planner.anytime = True
    assert bool(problem.setup.solve(1.0))
    definition = problem.setup.getProblemDefinition()
    assert definition.getSolutionCount() == 1
    assert np.abs(path_of(problem.setup.getSolutionPath()).arcs - cheap.arcs).max() < 1e-9


def names_in(tree: ast.AST) -> set[str]:
    return {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)} | {
        node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)
    }


def test_the_adapter_calls_and_overrides_nothing_that_crashes() -> None:
    files = sorted(Path(ompl_planner.__file__).parent.glob("*.py"))
    tree = ast.parse("\n".join(file.read_text(encoding="utf-8") for file in files))
    crashing = {
        "getStartState", "freeState", "freeControl", "getPlannerData", "stateCost", "getSolutions",
        "setIntermediateSolutionCallback",
    }  # fmt: skip
    used = names_in(tree)
    assert not used & crashing
    assert {"nextStart", "search_tree", "addSolutionPath"} <= used
    requests = [
        node for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "Request"
    ]  # fmt: skip
    assert len(requests) == 1
    assert {"saveConsoleOutput": False, "displayProgress": False}.items() <= {
        word.arg: word.value.value for word in requests[0].keywords if isinstance(word.value, ast.Constant)
    }.items()


def test_what_the_bindings_cannot_convert_is_still_not_needed(problem: NeedleProblem) -> None:
    """If these work one day, better paths can be announced as OMPL means it."""
    require(ask(problem))
    definition = problem.own().getProblemDefinition()
    with pytest.raises(TypeError):
        definition.getSolutions()
    with pytest.raises(TypeError):
        definition.setIntermediateSolutionCallback(lambda *_: None)


def peak_mib() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


def test_memory_does_not_grow_with_queries(problem: NeedleProblem) -> None:
    def some(count: int) -> None:
        for seed in range(count):
            ask(problem, seed)
            if seed % 10 == 0:
                problem.pose(query())
                problem.setup.solve(LONG_S)

    some(200)
    before = peak_mib()
    some(2000)
    assert peak_mib() - before < 8.0


def test_a_problem_is_freed_when_it_is_dropped(environment: NeedleEnvironment) -> None:
    """Whatever refers to the setup it is installed in keeps everything for ever."""
    problem = NeedleProblem(environment)
    require(ask(problem))
    problem.setup.setPlannerAllocator(problem.planners()["rrt"])
    problem.setup.setPlanner(problem.planners()["control.EST"](problem.si))
    problem.pose(query(NEAR), goal_tolerance_mm=4.0)
    problem.setup.solve(LONG_S)
    problem.setup.setPlanner(problem.planner)
    benchmark(problem, query(), time_s=LONG_S, runs=1, planners=["rrt"])
    alive = [weakref.ref(problem), weakref.ref(problem.own().search), weakref.ref(problem._question)]
    assert all(reference() is not None for reference in alive)
    del problem
    gc.collect()
    assert all(reference() is None for reference in alive)


SOLVE_WITH_SEED = """
import json, sys
from stages.needle.ompl import NeedleProblem, seed_ompl
from tests.stages.needle.ompl.test_ompl import NEAR, query, scene
from anatomy.margins import Margins
from stages.needle.device import Needle
from stages.needle.environment import needle_environment
seed_ompl(int(sys.argv[1]))
needle = Needle(diameter_mm=1.0, max_curvature_per_mm=1 / 30)
problem = NeedleProblem(needle_environment(scene(), needle, Margins(), with_fissures=False))
problem.setup.setPlanner(problem.planners()["control.RRT"](problem.si))
problem.pose(query(NEAR), goal_tolerance_mm=4.0)
problem.setup.solve(120.0)
print(json.dumps(problem.solution().arcs.tolist()))
"""


def test_planners_of_ompl_repeat_in_a_new_process_with_the_same_seed() -> None:
    root = Path(ompl_planner.__file__).parents[3]
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", SOLVE_WITH_SEED, str(seed)], cwd=root, stdout=subprocess.PIPE, text=True
        )
        for seed in (5, 5, 6)
    ]
    first, again, other = (json.loads(process.communicate()[0]) for process in processes)
    assert first == again
    assert first != other


def test_ompl_takes_no_seed_after_its_first_number(problem: NeedleProblem) -> None:
    problem.si.allocStateSampler().sampleUniform(problem.si.allocState())
    with pytest.raises(SettingsError, match="new process"):
        seed_ompl(987_654_321)
    with pytest.raises(SettingsError):
        seed_ompl(0)


# Benchmark and planner data.


def test_the_benchmark_of_ompl_takes_all_planners(problem: NeedleProblem, tmp_path: Path) -> None:
    log = tmp_path / "needle.log"
    results = benchmark(
        problem, query(NEAR), time_s=LONG_S, runs=2, goal_tolerance_mm=4.0, file=log, seed=3
    )  # fmt: skip
    assert list(results) == [*PLANNERS, *OMPL_PLANNERS]
    for name, result in results.items():
        assert result.runs == 2 and result.name == name
        assert result.solved_share + len(result.refusals) / 2 == 1.0
        assert all(0.0 < time < LONG_S for time in result.times_s)
        assert all(20.0 < length < 100.0 for length in result.lengths_mm)
    assert all(results[name].solved_share == 1.0 for name in PLANNERS)
    assert list(tmp_path.iterdir()) == [log]
    text = log.read_text(encoding="utf-8")
    assert text.startswith("OMPL version") and "control_KPIECE1" in text


def test_the_log_of_a_benchmark_can_be_read_by_ompl(problem: NeedleProblem, tmp_path: Path) -> None:
    import sqlite3

    log = tmp_path / "needle.log"
    results = benchmark(problem, query(), time_s=LONG_S, runs=3, planners=["rrt"], file=log)
    readBenchmarkLog(str(tmp_path / "needle.db"), [str(log)], None)
    with sqlite3.connect(tmp_path / "needle.db") as database:
        rows = database.execute("SELECT solved, proved, path_length_mm, time FROM runs").fetchall()
    database.close()
    assert [row[:2] for row in rows] == [(1, 1)] * 3
    assert [row[2] for row in rows] == pytest.approx(results["rrt"].lengths_mm, abs=1e-6)
    assert [row[3] for row in rows] == pytest.approx(results["rrt"].times_s, rel=1e-3)
    # Runs differ by their seeds, and each is what `plan` finds with that seed.
    expected = [require(ask(problem, seed)).length_mm for seed in (1, 2, 3)]
    assert results["rrt"].lengths_mm == pytest.approx(expected)


def test_a_benchmark_counts_what_it_refuses_apart(environment: NeedleEnvironment) -> None:
    through = arcs_of((40.0, 0.0, 0.0))
    problem = NeedleProblem(environment, {"given": given(through)})
    result = benchmark(
        problem, query(through.frames()[-1][:3, 3]), time_s=1.0, runs=2, planners=["given"]
    )["given"]  # fmt: skip
    assert result.solved_share == 0.0 and result.times_s == result.lengths_mm == ()
    assert result.refusals == ("too near: vessel",) * 2


def test_a_benchmark_refuses_what_it_cannot_run(
    problem: NeedleProblem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(SettingsError, match="control.SST"):
        benchmark(problem, query(), time_s=1.0, runs=1, planners=["control.SST"])
    with pytest.raises(SettingsError, match="0 times"):
        benchmark(problem, query(), time_s=1.0, runs=0)
    # OMPL would write a log of a name of its own to the working directory.
    monkeypatch.chdir(tmp_path)
    (tmp_path / "no folder").touch()
    with pytest.raises(FileError):
        benchmark(
            problem, query(), time_s=1.0, runs=1, planners=["rrt"], file=tmp_path / "no folder" / "x.log"
        )
    assert [file.name for file in tmp_path.iterdir()] == ["no folder"]


def unsolved(problem: NeedleProblem) -> NeedlePlanner:
    assert problem.plan(query(np.zeros(3)), seed=0, iterations=150) is None
    return problem.own()


def test_the_search_tree_is_planner_data(problem: NeedleProblem) -> None:
    planner = unsolved(problem)
    search = planner.search
    assert isinstance(search, RestartingRRT) and search.count > 10
    data = planner.search_tree()
    gc.collect()
    assert data.numVertices() == search.count and data.numEdges() == search.count - 1
    assert data.numStartVertices() == 1 and data.numGoalVertices() == 0
    for node in range(search.count):
        frame = read_state(data.getVertex(node).getState())
        assert np.abs(frame[:3, 3] - search.nodes[node, :3]).max() < 1e-9
        assert np.abs(frame[:3, 2] - search.nodes[node, 3:6]).max() < 1e-9
        assert node == 0 or data.edgeExists(int(search.parents[node]), node)
    assert data.getStartIndex(0) == 0


def test_the_search_tree_holds_the_path(problem: NeedleProblem) -> None:
    path = require(ask(problem))
    data = problem.own().search_tree()
    assert data.numGoalVertices() == 1
    at = data.getGoalIndex(0)
    assert np.abs(read_state(data.getVertex(at).getState())[:3, 3] - GOAL).max() < 1e-6
    arcs = 0
    while at != data.getStartIndex(0):
        (at,) = data.getIncomingEdges(at)
        arcs += 1
    assert arcs == len(path.arcs)
    assert NeedleProblem(problem.environment).planner.search_tree().numVertices() == 0


def test_the_search_tree_is_written_and_read_again(problem: NeedleProblem, tmp_path: Path) -> None:
    planner = unsolved(problem)
    count = planner.search_tree().numVertices()
    planner.save_search_tree(tmp_path / "tree.graphml")
    text = (tmp_path / "tree.graphml").read_text(encoding="utf-8")
    assert text.count("<node") == count and text.count("<edge") == count - 1
    assert isinstance(planner.search, RestartingRRT)
    assert f'<data key="key1">{planner.search.nodes[1, 6]:.3f}'[:-1] in text
    planner.save_search_tree(tmp_path / "tree.ompl")
    again = base.PlannerData(problem.si)
    assert base.PlannerDataStorage().load(str(tmp_path / "tree.ompl"), again)
    assert again.numVertices() == count and again.numEdges() == count - 1
    assert np.abs(read_state(again.getVertex(3).getState())[:3, 3] - planner.search.nodes[3, :3]).max() < 1e-9
    with pytest.raises(FileError):
        planner.save_search_tree(tmp_path / "no" / "tree.graphml")
    with pytest.raises(FileError):
        planner.save_search_tree(tmp_path / "no" / "tree.ompl")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["tree.graphml", "tree.ompl"]


def test_the_example_of_the_documentation_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = Path(ompl_planner.__file__).parents[3] / "docs" / "explanation" / "ompl.md"
    (code,) = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(compile(code, str(page), "exec"), names)
    assert names["problem"].violation(names["path"]) == ""
    assert "Exact solution" in capsys.readouterr().out
    assert [file.name for file in tmp_path.iterdir()] == ["needle.log"]
