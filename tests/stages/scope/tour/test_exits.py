"""Target positions P1, P2, P3 and their vetting."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anatomy.base.errors import SettingsError, TargetError
from experiments.support.tour_models import random_airway, random_lesions
from stages.scope.tour.subtree import ExitRule, find_exits
from tests.stages.scope.tour.trees import figure_1, straight_branches


def test_positions_beside_a_straight_airway() -> None:
    """Lesion 10 mm aside of z = -40: P2 is opposite, P1 the highest point within reach."""
    tree = straight_branches([(-1, (0.0, 0.0, -100.0))])
    (exits,) = find_exits(tree, [(10.0, 0.0, -40.0)], rule=ExitRule(reach_mm=26.0))
    by_role = {role: e for e in exits for role in e.roles}
    assert tree.points_lps[by_role["P2"].tree_point][2] == -40.0
    assert by_role["P2"].distance_mm == 10.0
    assert by_role["P2"].angle_rad == pytest.approx(math.pi / 2)
    assert tree.points_lps[by_role["P1"].tree_point][2] == -16.0
    assert by_role["P1"].angle_rad == pytest.approx(math.atan2(10.0, 24.0))


def test_p3_minimises_the_weighted_sum_and_follows_its_weights() -> None:
    tree, lesion = random_airway(2), random_lesions(random_airway(2), 1, 2)
    for k in (0.0, 0.5, 2.0, 100.0):
        rule = ExitRule(calibration=k)
        (exits,) = find_exits(tree, lesion, rule=rule)
        third = next(e for e in exits if "P3" in e.roles)
        assert all(third.weighted <= e.weighted for e in exits)
        w = k / (1.0 + k)
        assert third.weighted == pytest.approx(
            (1 - w) * third.distance_mm / 40.0 + w * third.angle_rad / math.pi
        )
        if k == 0.0:
            assert "P2" in third.roles


def test_a_lesion_in_the_airway_has_one_exit() -> None:
    (exits,) = find_exits(figure_1(), [(20.0, 1.0, -60.0)])
    assert [e.roles for e in exits] == [("inside",)]


def test_the_reach_grows_by_whole_steps() -> None:
    """At 40.1 mm the sphere of 40.2 mm would be needed, which is beyond the limit."""
    tree = straight_branches([(-1, (0.0, 0.0, -10.0))])
    assert find_exits(tree, [(40.0, 0.0, -5.0)])
    with pytest.raises(TargetError, match=r"40\.1 mm away"):
        find_exits(tree, [(40.1, 0.0, -5.0)])


def test_vetting_takes_points_away() -> None:
    tree = figure_1()
    lesion = [(60.0, 0.0, -70.0)]
    (free,) = find_exits(tree, lesion)
    refused = {e.tree_point for e in free}
    asked: list[int] = []

    def accepts(number: int, point: int) -> bool:
        asked.append(number)
        return point not in refused

    (found,) = find_exits(tree, lesion, accepts=accepts)
    assert set(asked) == {0}
    assert not refused & {e.tree_point for e in found}
    with pytest.raises(TargetError, match="within reach is accepted"):
        find_exits(tree, lesion, accepts=lambda _number, _point: False)


def test_random_models_are_as_the_paper_describes() -> None:
    """Eight orders, binary, about 21 degrees up to order 5 and more beyond; lesions within reach."""
    tree = random_airway(7)
    assert tree.n_branches == 2**8 - 1
    assert tree.generation.max() == 7
    chord = tree.points_lps[tree.branch_start[1:] - 1]
    hook = tree.points_lps[np.maximum(tree.parent_point[tree.branch_start[:-1]], 0)]
    direction = (chord - hook) / np.linalg.norm(chord - hook, axis=1, keepdims=True)
    angle = np.degrees(
        np.arccos(np.clip((direction[1:] * direction[tree.branch_parent[1:]]).sum(axis=1), -1, 1))
    )
    by_generation = [angle[tree.generation[1:] == g].mean() for g in range(1, 8)]
    # The mean of front and back branches is 0.925 of the paper's angle.
    assert by_generation[4] < by_generation[5] < by_generation[6]
    assert by_generation[6] / 0.925 == pytest.approx(21.0 + 0.3 * 29.0, rel=0.1)
    lesions = random_lesions(tree, 9, 7)
    distance = np.linalg.norm(tree.points_lps[:, None] - lesions, axis=2).min(axis=0)
    assert distance.max() <= 40.0
    np.testing.assert_array_equal(lesions, random_lesions(random_airway(7), 9, 7))
    with pytest.raises(SettingsError):
        random_airway(0, orders=1)
