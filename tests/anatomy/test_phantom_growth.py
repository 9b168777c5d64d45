"""The parts that grow a phantom's trees."""

from __future__ import annotations

import numpy as np
import pytest

from anatomy.phantom.branching import Sprouts, centerlines, limit_turn, split_cloud
from tests.anatomy.phantom_lines import lengths_mm


def _tiny_tree() -> Sprouts:
    tree = Sprouts()
    x = np.array([1.0, 0.0, 0.0])
    tree.add(-1, np.outer(np.arange(3), x), 4.0, 0, "root")
    tree.add(0, 2 * x + np.outer(np.arange(3), [0.0, 1, 0]), 3.0, 1)
    tree.add(0, 2 * x + np.outer(np.arange(3), [0.0, -1, 0]), 2.5, 1)
    tree.add(1, tree.points[1][-1] + np.outer(np.arange(3), [0.0, 1, 0]), 2.0, 1)
    tree.add(1, tree.points[1][-1] + np.outer(np.arange(3), [0.0, 0, 1]), 2.0, 1)
    return tree


def test_orders_of_a_tiny_tree() -> None:
    tree = _tiny_tree()
    lines = centerlines(tree, np.ones(15), np.ones(15), np.ones(5, dtype=bool))
    assert lines.generation.tolist() == [0, 1, 1, 2, 2]
    assert lines.horsfield_order.tolist() == [3, 2, 1, 1, 1]
    assert lines.strahler_order.tolist() == [2, 2, 1, 1, 1]
    assert lengths_mm(lines).tolist() == [2, 2, 2, 2, 2]


def test_a_single_remaining_child_continues_its_parent() -> None:
    keep = np.array([True, True, False, True, True])
    lines = centerlines(_tiny_tree(), np.arange(15.0), np.arange(15.0), keep)
    assert lines.generation.tolist() == [0, 1, 1]
    assert lengths_mm(lines).tolist() == [4, 2, 2]
    assert lines.radius_mm[:5].tolist() == [0, 1, 2, 4, 5]


def test_splitting_keeps_every_point_and_cuts_the_long_way() -> None:
    rng = np.random.default_rng(0)
    cloud = rng.uniform(-1, 1, (60, 3)) * [10.0, 1.0, 30.0]
    parts = split_cloud(cloud, np.array([0.0, 0.0, 1.0]), rng)
    assert parts is not None
    assert sorted(map(tuple, np.vstack(parts))) == sorted(map(tuple, cloud))
    lower, upper = sorted(parts, key=lambda part: part[:, 0].mean())
    assert upper[:, 0].min() > lower[:, 0].max() - 1.0


@pytest.mark.parametrize(("wanted_deg", "given_deg"), [(5, 20), (30, 30), (90, 50), (170, 50)])
def test_turns_are_limited(wanted_deg: float, given_deg: float) -> None:
    angle = np.deg2rad(wanted_deg)
    heading = np.array([0.0, 0.0, 1.0])
    turned = limit_turn(np.array([np.sin(angle), 0, np.cos(angle)]), heading, np.deg2rad(20), np.deg2rad(50))
    assert np.rad2deg(np.arccos(turned @ heading)) == pytest.approx(given_deg)
    assert np.linalg.norm(turned) == pytest.approx(1)
