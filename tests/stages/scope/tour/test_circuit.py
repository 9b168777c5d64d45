"""Resistances and circuits of [Pan2025]."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anatomy.base.errors import SettingsError
from experiments.support.tour_models import random_airway, random_lesions
from stages.scope.tour.subtree import (
    EXAMPLE_BETA,
    LEFT,
    Resistances,
    Subtree,
    branch_resistances,
    circuits,
    find_exits,
    subtree_to,
)
from tests.stages.scope.tour.trees import ends_of, exit_at, figure_1

ETA = 1.0


def test_worked_example_of_section_ii_b() -> None:
    """L = 40 mm, D = 10 mm, C = pi / 3, cartilage: printed as 7.12.

    Erratum: with the stated beta = 0.2 eq. 3 gives 4.71; beta = 2.5 gives what is printed.
    """
    assert Resistances().of(40.0, 10.0, math.pi / 3, 1.0) == pytest.approx(4.71, abs=0.005)
    assert Resistances(beta=EXAMPLE_BETA).of(40.0, 10.0, math.pi / 3, 1.0) == pytest.approx(7.12, abs=0.005)


def test_branches_of_a_tree_have_the_resistance_of_eq_3() -> None:
    tree = figure_1()
    weights = Resistances(cartilage_generations=1)
    z = branch_resistances(tree, weights)
    length, angle = math.hypot(10.0, 20.0), math.atan2(20.0, 10.0) - math.atan2(10.0, 20.0)
    assert z[2] == pytest.approx(weights.of(length, 4.0, angle, 0.0), rel=1e-9)
    assert z[0] == pytest.approx(weights.of(50.0, 4.0, 0.0, 1.0), rel=1e-9)


def figure_1_subtree() -> Subtree:
    tree = figure_1()
    points = ends_of(tree, [3, 4, 6, 7])
    return subtree_to(tree, [[exit_at(m, p)] for m, p in enumerate(points)])


def test_circuit_of_figure_1_by_hand() -> None:
    """The printed grouping sums BC and BF, which carry two loops each; the true reduction does not."""
    subtree = figure_1_subtree()
    z = dict(zip(subtree.tree_point.tolist(), subtree.resistance.tolist(), strict=True))
    ab, bc, cd, ce, bf, fg, fh = (z[p] for p in ends_of(figure_1(), [1, 2, 3, 4, 5, 6, 7]))
    trachea = z[ends_of(figure_1(), [0])[0]]

    def par(a: float, b: float) -> float:
        return a * b / (a + b)

    low, high = par(ETA + cd, ETA + ce), par(ETA + fg, ETA + fh)
    found = circuits(subtree)
    assert found.reduced[0] == pytest.approx(trachea + ab + par(bc + low, bf + high))
    assert found.printed[0] == pytest.approx(ab + par(bc + bf + low, high))
    assert found.printed[0] != pytest.approx(ab + par(bc + low, bf + high))
    assert set(subtree.side[1:]) == {0, LEFT}


def test_two_sides_are_parallel_in_step_5() -> None:
    tree = figure_1()
    left, right = ends_of(tree, [3, 8])
    both = subtree_to(tree, [[exit_at(0, left)], [exit_at(1, right)]])
    alone = [subtree_to(tree, [[exit_at(0, p)]]) for p in (left, right)]
    a, b = (float(circuits(w).printed[0]) for w in alone)
    assert circuits(both).printed[0] == pytest.approx(a * b / (a + b))


def test_readings_agree_where_no_two_branches_have_as_many_loops() -> None:
    """On one side, with nested forks, the printed grouping is the true reduction without the trachea."""
    tree = figure_1()
    points = ends_of(tree, [3, 4, 7])
    subtree = subtree_to(tree, [[exit_at(m, p)] for m, p in enumerate(points)])
    found = circuits(subtree)
    trachea = subtree.resistance[np.flatnonzero(subtree.tree_point == ends_of(tree, [0])[0])[0]]
    assert found.printed[0] + trachea == pytest.approx(found.reduced[0])


def test_less_overlap_has_less_resistance_though_it_is_farther() -> None:
    """Parallel branches lower the resistance: why least resistance is not the shortest tour."""
    tree = figure_1()
    near, far = ends_of(tree, [4, 7])
    subtree = subtree_to(tree, [[exit_at(0, ends_of(tree, [3])[0])], [exit_at(1, near), exit_at(1, far)]])
    found = circuits(subtree)
    assert found.reduced[1] < found.reduced[0]
    assert found.choice("reduced") == (0, 2)


def test_all_combinations_and_the_distinct_ones_are_counted() -> None:
    """Four lesions with three exits and one with one make 81 circuits; equal ones are counted once."""
    tree = random_airway(3)
    rng = np.random.default_rng(0)
    exits = [[exit_at(m, p) for p in rng.integers(400, tree.n_points, 3)] for m in range(4)]
    exits.append([exit_at(4, 700)])
    found = circuits(subtree_to(tree, exits))
    assert found.count == 81
    assert found.distinct("reduced") == 81
    exits[0][1] = exit_at(0, exits[0][0].tree_point)
    assert circuits(subtree_to(tree, exits)).distinct("reduced") == 54


def test_choice_is_the_least_of_all() -> None:
    tree = random_airway(1)
    subtree = subtree_to(tree, find_exits(tree, random_lesions(tree, 5, 1)))
    found = circuits(subtree)
    for reading in ("printed", "reduced"):
        chosen = found.choice(reading)
        one = subtree_to(tree, [[subtree.exits[x]] for x in chosen])
        assert circuits(one).values(reading)[0] == pytest.approx(found.values(reading).min())
    with pytest.raises(SettingsError, match="reading"):
        found.values("guessed")  # type: ignore[arg-type]


def test_too_many_combinations_are_refused() -> None:
    tree = random_airway(0)
    exits = [[exit_at(m, p) for p in (200, 300, 400)] for m in range(20)]
    with pytest.raises(SettingsError, match="combinations"):
        circuits(subtree_to(tree, exits))
