"""Traps of OMPL: one test for each that is avoided."""

from __future__ import annotations

import ast
import gc
import json
import resource
import subprocess
import sys
import weakref
from pathlib import Path

import numpy as np
import pytest

from anatomy.base.errors import SettingsError
from stages.needle import ompl as ompl_planner
from stages.needle.environment import NeedleEnvironment
from stages.needle.ompl import NeedleProblem, path_of, seed_ompl
from tests.stages.needle.ompl.problems import (
    LONG_S,
    NEAR,
    arcs_of,
    ask,
    given,
    ompls_benchmark,
    query,
    require,
)


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
    assert {"nextStart", "addSolutionPath"} <= used


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


@pytest.mark.slow
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
    ompls_benchmark(problem)
    alive = [weakref.ref(problem), weakref.ref(problem.own().search), weakref.ref(problem._question)]
    assert all(reference() is not None for reference in alive)
    del problem
    gc.collect()
    assert all(reference() is None for reference in alive)


SOLVE_WITH_SEED = """
import json, sys
from stages.needle.ompl import NeedleProblem, seed_ompl
from tests.stages.needle.ompl.problems import NEAR, query, scene
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


@pytest.mark.slow
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
