"""The same question to OMPL's SimpleSetup, with our planners and with OMPL's own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ompl import base

from stages.needle import ompl as ompl_planner
from stages.needle.environment import NeedleEnvironment
from stages.needle.ompl import NeedleGoal, NeedlePlanner, NeedleProblem, read_state, write_state
from stages.needle.path import arc_transform, blocker_on_path
from tests.stages.needle.ompl.problems import LONG_S, NEAR, OMPL_PLANNERS, Given, ask, query, require, start


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


@pytest.mark.parametrize(
    "name", [*OMPL_PLANNERS[:1], *(pytest.param(name, marks=pytest.mark.slow) for name in OMPL_PLANNERS[1:])]
)
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
