"""A portfolio of searches against a single one in clutter, where many paths lead to the target."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from anatomy.grid import Volume
from anatomy.margins import Margins
from anatomy.structures import VESSEL
from stages.needle.device import Needle
from stages.needle.environment import NeedleEnvironment, needle_environment
from stages.needle.objective import SHORTEST, Objective
from stages.needle.path import Query
from stages.needle.search.optimal import OptimalSearch
from stages.needle.search.portfolio import FIRST_ITERATIONS, PortfolioSearch
from tests.stages.needle.proved import assert_each_path_is_cheaper
from tests.stages.scenes import Canvas

INVERSE = Objective(inverse_clearance=1.0)
MAP = Objective(cost_map=1.0)


def clutter(seed: int) -> NeedleEnvironment:
    """Forty vessel balls, none at start and target."""
    rng = np.random.default_rng(seed)
    canvas = Canvas.empty([-25, -25, -42], [25, 25, 42], 1.0)
    for centre in rng.uniform([-25, -25, -28], [25, 25, 28], (40, 3)):
        canvas.add(canvas.ball(centre.tolist(), float(rng.uniform(2.0, 6.0))), VESSEL)
    needle = Needle(diameter_mm=1.0, max_curvature_per_mm=1 / 50)
    return needle_environment(canvas.lung(), needle, Margins(), with_fissures=False)


def two_valleys() -> NeedleEnvironment:
    """Free tissue where two bows from start to target cost least, one a little less than the other."""
    canvas = Canvas.empty([-25, -25, -42], [25, 25, 42], 1.0)
    needle = Needle(diameter_mm=1.0, max_curvature_per_mm=1 / 60)
    environment = needle_environment(canvas.lung(), needle, Margins(), with_fissures=False)
    x, y, z = np.moveaxis(environment.grid.lps(np.stack(np.indices(environment.grid.shape), axis=-1)), -1, 0)
    bow = 12.0 * np.sin(np.pi * np.clip(z + 38.0, 0.0, 76.0) / 76.0)
    costs = np.minimum(0.6 + 0.3 * np.hypot(x - bow, y), 0.4 + 0.3 * np.hypot(x + bow, y))
    return replace(
        environment, cost_map=Volume(grid=environment.grid, array=np.asfortranarray(costs, dtype=np.float32))
    )


def query(goal: tuple[float, float, float] = (0.0, 0.0, 38.0)) -> Query:
    frame = np.eye(4)
    frame[:3, 3] = 0.0, 0.0, -38.0
    return Query(lps_from_start=frame, target=np.array(goal))


def run(search: OptimalSearch | PortfolioSearch, iterations: int, slice_of: int = 500) -> float:
    while search.iterations < iterations:
        search.advance(slice_of)
    return search.cost


@pytest.mark.slow
def test_a_portfolio_finds_paths_that_a_single_search_does_not_leave_its_own_for() -> None:
    environment = two_valleys()
    single, portfolio = (
        np.array([run(kind(environment, query(), seed=seed, objective=MAP), 60_000) for seed in range(3)])
        for kind in (OptimalSearch, PortfolioSearch)
    )
    assert portfolio.max() < 1.001 * min(portfolio.min(), single.min())
    assert single.max() > 1.02 * portfolio.max()


@pytest.mark.slow
@pytest.mark.parametrize("objective", [SHORTEST, INVERSE])
def test_each_path_is_cheaper_clear_and_within_the_limits(objective: Objective) -> None:
    environment = clutter(1)
    search = PortfolioSearch(environment, query(), seed=3, objective=objective)
    assert_each_path_is_cheaper(environment, search, 100, query().target)


def test_the_first_path_is_that_of_the_single_search() -> None:
    environment = clutter(1)
    single, portfolio = (kind(environment, query(), seed=5) for kind in (OptimalSearch, PortfolioSearch))
    while single.path is None:
        single.advance(100)
    while portfolio.path is None:
        portfolio.advance(100)
    assert np.array_equal(single.path.arcs, portfolio.path.arcs)


def test_the_same_seed_repeats() -> None:
    costs = [run(PortfolioSearch(clutter(1), query(), seed=seed), 10_000) for seed in (5, 5, 6)]
    assert costs[0] == costs[1] != costs[2]


def test_iterations_are_those_of_all_searches() -> None:
    search = PortfolioSearch(clutter(1), query(), seed=1)
    while search.path is None:
        search.advance(100)
    first = search.iterations
    spent = 0
    while spent < 20 * FIRST_ITERATIONS:
        before = search.iterations
        found = search.advance(250)
        assert search.iterations - before == 250 or found
        spent += search.iterations - before
    assert search.iterations == first + spent


def test_a_target_at_the_start_ends() -> None:
    search = PortfolioSearch(clutter(1), query((0.0, 0.0, -38.0)), seed=1)
    assert not any(search.advance(1000) for _ in range(5))
