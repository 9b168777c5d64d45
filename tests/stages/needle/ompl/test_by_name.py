"""Every planner by its name on one problem: ours give what they give alone, OMPL's are led to the target."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from anatomy.base.errors import SettingsError
from anatomy.base.typed import Float
from anatomy.grid import Volume
from stages.needle import NEEDLE_PLANNERS, OUR_PLANNERS, Objective, map_integral, require_planner, violation
from stages.needle.environment import NeedleEnvironment
from stages.needle.ompl import NeedleProblem
from stages.needle.path import ArcPath
from stages.needle.search.planners import searches
from tests.stages.needle.ompl.problems import NEAR, OMPL_PLANNERS, query, require

EASY_ITERATIONS = 20_000
"""OMPL's planners find the easy target within a tenth of them."""


def places(environment: NeedleEnvironment) -> Float:
    """Return the centre of every voxel, (ni, nj, nk, 3)."""
    shape = environment.grid.shape
    return environment.grid.lps(np.argwhere(np.ones(shape)).reshape(*shape, 3))


def test_there_is_one_list_of_names(problem: NeedleProblem) -> None:
    assert tuple(searches()) == OUR_PLANNERS
    assert tuple(problem.planners()) == NEEDLE_PLANNERS
    with pytest.raises(SettingsError, match=r"control\.RRT"):
        require_planner("control.RTT")


@pytest.mark.parametrize("name", OUR_PLANNERS)
def test_ours_give_through_ompl_what_they_give_alone(environment: NeedleEnvironment, name: str) -> None:
    shorter = Objective(length=1.0, inverse_clearance=0.5)
    alone = searches()[name](environment, query(), 5, shorter)
    while alone.path is None:
        alone.advance(200)
    through = NeedleProblem(environment, objective=shorter).plan(
        query(), seed=5, iterations=EASY_ITERATIONS, method=name
    )
    assert np.array_equal(require(through).arcs, alone.path.arcs)


@pytest.mark.parametrize("name", ["rrt", "ao-rrt", "optimal", "resolution"])
def test_no_path_costs_as_much_as_the_limit(problem: NeedleProblem, name: str) -> None:
    free = require(problem.plan(query(), seed=1, iterations=2000, method=name)).length_mm
    best = require(problem.plan(query(), seed=1, iterations=2000, method="optimal", anytime=True)).length_mm
    limit = 0.5 * (free + best) if best < free else free
    limited = problem.plan(query(), seed=1, iterations=2000, method=name, cost_limit=limit)
    assert limited is None or limited.length_mm < limit
    assert problem.plan(query(), seed=1, iterations=2000, method=name, cost_limit=0.9 * best) is None
    assert require(problem.plan(query(), seed=1, iterations=2000, method=name)).length_mm == free


@pytest.mark.parametrize("name", OMPL_PLANNERS)
def test_a_path_of_ompl_ends_at_the_target(problem: NeedleProblem, name: str) -> None:
    for _ in range(20):
        path = problem.plan(query(NEAR), seed=1, iterations=EASY_ITERATIONS, method=name)
        if path is not None:
            break
    assert violation(problem.environment, query(NEAR), require(path)) == ""
    assert np.linalg.norm(require(path).frames()[-1][:3, 3] - NEAR) < 1e-6


@pytest.mark.parametrize("name", OMPL_PLANNERS)
def test_planners_of_ompl_end_by_iterations(problem: NeedleProblem, name: str) -> None:
    assert problem.plan(query(np.zeros(3)), seed=1, iterations=50, method=name) is None


def test_planners_of_ompl_enter_no_forbidden_voxel(environment: NeedleEnvironment) -> None:
    """A slab of infinite cost between start and goal leaves a gap on one side alone."""
    costs = np.ones(environment.grid.shape, dtype=np.float32, order="F")
    x, _y, z = np.moveaxis(places(environment), -1, 0)
    costs[(np.abs(z + 10.0) < 2.0) & (x < 2.0)] = np.inf
    mapped = replace(environment, cost_map=Volume(grid=environment.grid, array=costs))
    problem = NeedleProblem(mapped)
    paths = [
        problem.plan(query(NEAR), seed=1, iterations=EASY_ITERATIONS, method="control.RRT") for _ in range(10)
    ]
    found = [path for path in paths if path is not None]
    assert found
    assert all(math.isfinite(map_integral(mapped.cost_map, path)) for path in found)


def test_the_objective_of_a_problem_is_that_of_its_searches(environment: NeedleEnvironment) -> None:
    """Where the shortest path runs, the map is dear; on the other side it is cheap."""

    def best(objective: Objective) -> ArcPath:
        problem = NeedleProblem(mapped, objective=objective)
        return require(problem.plan(query(), seed=1, iterations=4000, method="ao-rrt", anytime=True))

    mapped = environment
    short = best(Objective(length=1.0))
    costs = np.full(environment.grid.shape, 0.01, dtype=np.float32, order="F")
    side = short.sample(1.0)[0][:, :2].mean(axis=0)
    costs[places(environment)[..., :2] @ side > 0.0] = 1.0
    mapped = replace(environment, cost_map=Volume(grid=environment.grid, array=costs))
    on_map = best(Objective(cost_map=1.0))
    assert map_integral(mapped.cost_map, on_map) < 0.5 * map_integral(mapped.cost_map, short)
    assert short.length_mm < on_map.length_mm
