"""The order of visits, and the exact tour."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import SettingsError
from experiments.support.tour_models import random_airway, random_lesions
from stages.scope.tour.itinerary import one_by_one_mm, plan_itinerary, shortest_tour
from stages.scope.tour.subtree import Subtree, circuits, find_exits, subtree_to
from tests.stages.scope.tour.trees import (
    by_trying_everything,
    ends_of,
    exit_at,
    figure_1,
    shortest_by_permutations,
    straight_branches,
)


@functools.cache
def airway(seed: int, orders: int) -> AirwayTree:
    return random_airway(seed, orders=orders)


def random_subtree(rng: np.random.Generator, lesions: int, exits: int = 3, *, orders: int = 5) -> Subtree:
    tree = airway(int(rng.integers(20)), orders)
    chosen = [
        [exit_at(m, p) for p in rng.integers(0, tree.n_points, int(rng.integers(1, exits + 1)))]
        for m in range(lesions)
    ]
    cost = [[float(rng.choice((0.0, rng.uniform(0.0, 40.0)))) for _ in of_one] for of_one in chosen]
    return subtree_to(tree, chosen, exit_cost_mm=cost)


def test_figure_1_is_walked_as_the_paper_writes_it() -> None:
    """A B C D C E C B F G F H."""
    tree = figure_1()
    subtree = subtree_to(tree, [[exit_at(m, p)] for m, p in enumerate(ends_of(tree, [3, 4, 6, 7]))])
    tour = plan_itinerary(subtree, (0, 1, 2, 3))
    assert tour.order == (0, 1, 2, 3)
    points = [int(subtree.tree_point[v]) for v in tour.vertices()]
    a, b, c, d, e, f, g, h = ends_of(tree, [0, 1, 2, 3, 4, 5, 6, 7])
    assert points == [0, a, b, c, d, c, e, c, b, f, g, f, h]
    loops = dict(zip(subtree.tree_point.tolist(), tour.loops.tolist(), strict=True))
    assert (loops[b], loops[c], loops[f], loops[h]) == (4, 2, 2, 1)


def test_passes_are_those_of_the_walk() -> None:
    rng = np.random.default_rng(1)
    for _ in range(30):
        subtree = random_subtree(rng, 4)
        tour = shortest_tour(subtree, closed=bool(rng.integers(2)))
        walk = tour.vertices()
        counted = np.zeros(subtree.n_vertices, dtype=int)
        for a, b in zip(walk[:-1], walk[1:], strict=True):
            assert subtree.parent[a] == b or subtree.parent[b] == a
            counted[a if subtree.parent[a] == b else b] += 1
        np.testing.assert_array_equal(counted, tour.passes)
        assert counted.max() <= 2
        assert tour.length_mm == pytest.approx((counted * subtree.length_mm).sum())
        for lesion in tour.order:
            assert int(subtree.exit_vertex[tour.chosen[lesion]]) in walk
        assert sorted(tour.order) == list(range(4))


@pytest.mark.parametrize("closed", [False, True])
def test_order_is_the_best_of_all_orders(closed: bool) -> None:
    rng = np.random.default_rng(2)
    for _ in range(25):
        subtree = random_subtree(rng, 5, exits=1)
        tour = plan_itinerary(subtree, range(5), closed=closed)
        assert tour.length_mm == pytest.approx(
            shortest_by_permutations(subtree, tuple(range(5)), closed=closed)
        )


def test_open_tour_is_twice_the_union_less_the_deepest_way() -> None:
    rng = np.random.default_rng(3)
    subtree = random_subtree(rng, 6, exits=1)
    tour = plan_itinerary(subtree, range(6))
    union = float(subtree.length_mm[tour.loops > 0].sum())
    assert tour.length_mm == pytest.approx(2 * union - subtree.depth_mm[subtree.exit_vertex].max())


@pytest.mark.parametrize("block", range(5))
def test_integer_program_equals_trying_everything(block: int) -> None:
    """500 small random cases, open and closed, with exits that cost something and exits that do not."""
    rng = np.random.default_rng((4, block))
    for _ in range(100):
        subtree = random_subtree(rng, int(rng.integers(1, 5)))
        for closed in (False, True):
            best = by_trying_everything(subtree, closed=closed)
            assert shortest_tour(subtree, closed=closed).cost_mm == pytest.approx(best, abs=1e-9)


def test_exact_tour_is_never_longer_than_that_of_least_resistance() -> None:
    for seed in range(10):
        tree = random_airway(seed)
        subtree = subtree_to(tree, find_exits(tree, random_lesions(tree, 6, seed)))
        best = shortest_tour(subtree).length_mm
        for reading in ("printed", "reduced"):
            chosen = plan_itinerary(subtree, circuits(subtree).choice(reading))
            assert best <= chosen.length_mm + 1e-9
            assert chosen.length_mm <= one_by_one_mm(subtree, chosen.chosen) + 1e-9


def test_an_exit_that_costs_more_than_the_detour_is_not_taken() -> None:
    tree = straight_branches([(-1, (0.0, 0.0, -50.0)), (0, (30.0, 0.0, -50.0)), (0, (-30.0, 0.0, -50.0))])
    left, right = ends_of(tree, [1, 2])
    exits = [[exit_at(0, left)], [exit_at(1, left - 1), exit_at(1, right)]]
    free = shortest_tour(subtree_to(tree, exits, exit_cost_mm=[[0.0], [10.0, 0.0]]))
    assert free.chosen == (0, 1)
    costly = shortest_tour(subtree_to(tree, exits, exit_cost_mm=[[0.0], [100.0, 0.0]]))
    assert costly.chosen == (0, 2)


def test_one_by_one_returns_each_time() -> None:
    tree = figure_1()
    subtree = subtree_to(tree, [[exit_at(m, p)] for m, p in enumerate(ends_of(tree, [3, 7]))])
    depth = subtree.depth_mm[subtree.exit_vertex]
    assert one_by_one_mm(subtree, (0, 1)) == pytest.approx(2 * depth.sum() - depth.max())
    assert one_by_one_mm(subtree, (0, 1), closed=True) == pytest.approx(2 * depth.sum())
    assert plan_itinerary(subtree, (0, 1)).seconds(10.0, 60.0) == pytest.approx(
        plan_itinerary(subtree, (0, 1)).length_mm / 10.0 + 120.0
    )


def test_wrong_exits_are_refused() -> None:
    tree = figure_1()
    subtree = subtree_to(tree, [[exit_at(0, 10)], [exit_at(1, 20)]])
    with pytest.raises(SettingsError):
        plan_itinerary(subtree, (1, 0))
    with pytest.raises(SettingsError):
        subtree_to(tree, [])
    with pytest.raises(SettingsError):
        subtree_to(tree, [[exit_at(0, 10)]], exit_cost_mm=[[-1.0]])


@pytest.mark.slow
def test_thirty_lesions_with_scattered_exits() -> None:
    """Fewer lesions, drawn choices and changes of one exit bound the answer."""
    rng = np.random.default_rng(6)
    tree = airway(3, 8)
    exits = [[exit_at(m, p) for p in rng.integers(0, tree.n_points, 3)] for m in range(30)]
    subtree = subtree_to(tree, exits)
    best = shortest_tour(subtree, closed=True)
    fewer = shortest_tour(subtree_to(tree, exits[:15]), closed=True)
    assert fewer.length_mm <= best.length_mm + 1e-6
    for _ in range(300):
        guess = [int(rng.choice(np.flatnonzero(subtree.exit_lesion == m))) for m in range(30)]
        assert best.length_mm <= plan_itinerary(subtree, guess, closed=True).length_mm + 1e-6
    for m in range(30):
        for other in np.flatnonzero(subtree.exit_lesion == m).tolist():
            changed = [*best.chosen[:m], other, *best.chosen[m + 1 :]]
            assert best.length_mm <= plan_itinerary(subtree, changed, closed=True).length_mm + 1e-6
