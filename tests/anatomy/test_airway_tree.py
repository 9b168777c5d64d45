"""Queries of an airway tree, and trees from graphs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import AnatomyError
from anatomy.tree import tree_from_graph


def _line(a: tuple[float, ...], b: tuple[float, ...], count: int) -> np.ndarray:
    return np.linspace(a, b, count + 1)[1:]


def _graph() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A trachea of 80 mm, then 50 mm to the left and 30 mm to the right, which divides again."""
    points = np.vstack(
        (
            [(0, 0, 80)],
            _line((0, 0, 80), (0, 0, 0), 8),
            _line((0, 0, 0), (30, 0, -40), 5),
            _line((0, 0, 0), (-18, 0, -24), 3),
            _line((-18, 0, -24), (-38, 0, -24), 4),
            _line((-18, 0, -24), (-18, 0, -54), 3),
        )
    )
    radius = np.repeat((8.0, 6.0, 6.5, 3.0, 4.0), (9, 5, 3, 4, 3))
    parent = np.arange(-1, 23)
    parent[[14, 17, 21]] = 8, 16, 16
    return points, radius, np.stack((parent[1:], np.arange(1, 24)), axis=1)


@pytest.fixture(scope="module")
def tree() -> AirwayTree:
    return tree_from_graph(*_graph())


def test_branches_generations_lengths(tree: AirwayTree):
    assert tree.n_points == 24
    assert tree.n_branches == 5
    assert tree.generation.tolist() == [0, 1, 1, 2, 2]
    assert tree.branch_length_mm[0] == pytest.approx(80)
    assert sorted(tree.branch_length_mm[1:3]) == pytest.approx([30, 50])
    assert sorted(tree.branch_length_mm[3:]) == pytest.approx([20, 30])
    assert sorted(tree.branch_mean_radius_mm) == pytest.approx([3, 4, 6, 6.5, 8])
    np.testing.assert_allclose(tree.carina_lps, 0, atol=1e-12)
    assert len(tree.leaf_branches) == 3
    np.testing.assert_allclose(tree.tangents[4], (0, 0, -1), atol=1e-12)


def test_trachea_and_main_bronchi_are_mediastinal(tree: AirwayTree):
    assert tree.mediastinal.tolist() == (tree.generation <= 1).tolist()


@pytest.mark.parametrize("at", [4, 11])
@pytest.mark.parametrize("radius", [2.5, 3.5])
def test_a_narrow_side_branch_does_not_end_trachea_or_main_bronchus(at: int, radius: float):
    """A bronchus of the trachea itself, or a twig by error of the mask."""
    points, radii, edges = _graph()
    points = np.vstack((points, _line(tuple(points[at]), tuple(points[at] + (0, 40, 0)), 4)))
    radii = np.append(radii, np.full(4, radius))
    edges = np.vstack((edges, [(at, 24), (24, 25), (25, 26), (26, 27)]))
    tree = tree_from_graph(points, radii, edges)
    wide = tree.branch_mean_radius_mm > 5.0
    assert wide.sum() >= 3
    assert tree.mediastinal[wide].all()
    lobar = np.isclose(tree.branch_mean_radius_mm, 3.0) | np.isclose(tree.branch_mean_radius_mm, 4.0)
    assert lobar.sum() == 2 and not tree.mediastinal[lobar].any()


def test_route_leads_from_the_root_over_neighbours(tree: AirwayTree):
    for point in range(tree.n_points):
        route = tree.route(point)
        assert route[0] == 0
        assert route[-1] == point
        np.testing.assert_array_equal(tree.parent_point[route[1:]], route[:-1])
        length = np.linalg.norm(np.diff(tree.points_lps[route], axis=0), axis=1).sum()
        assert tree.distance_from_root_mm[point] == pytest.approx(length)


def test_children_and_branch_points_cover_the_tree(tree: AirwayTree):
    found = np.concatenate([tree.branch_points(b) for b in range(tree.n_branches)])
    np.testing.assert_array_equal(found, np.arange(tree.n_points))
    assert sorted(np.concatenate([tree.children(b) for b in range(tree.n_branches)])) == [1, 2, 3, 4]
    assert tree.nearest_point((-18.2, 0.1, -54)) == tree.route(tree.nearest_point((-18, 0, -54)))[-1]


def test_arrays_are_read_only(tree: AirwayTree):
    with pytest.raises(ValueError, match="read-only"):
        tree.points_lps[0] = 0


@pytest.mark.parametrize(
    ("name", "index", "value"),
    [
        ("parent_point", 3, 5),
        ("parent_point", 0, 0),
        ("branch_of_point", 3, 1),
        ("branch_start", 1, 0),
        ("generation", 2, 2),
        ("branch_parent", 3, 0),
        ("radius_mm", 3, np.nan),
        ("points_lps", 3, np.inf),
    ],
)
def test_contradictory_arrays_are_refused(tree: AirwayTree, name: str, index: int, value: float):
    array = getattr(tree, name).copy()
    array[index] = value
    with pytest.raises(AnatomyError, match="contradict"):
        replace(tree, **{name: array})


def test_unknown_index_is_refused(tree: AirwayTree):
    with pytest.raises(AnatomyError, match="no branch 5"):
        tree.children(5)
    with pytest.raises(AnatomyError, match="no point -1"):
        tree.route(-1)


def test_order_and_direction_of_edges_do_not_matter(tree: AirwayTree):
    points, radius, edges = _graph()
    rng = np.random.default_rng(4)
    shuffled = rng.permutation(edges[:, ::-1])
    other = tree_from_graph(points, radius, shuffled)
    np.testing.assert_array_equal(other.points_lps, tree.points_lps)
    np.testing.assert_array_equal(other.parent_point, tree.parent_point)


def test_overlapping_lines_become_one_tree(tree: AirwayTree):
    points, radius, edges = _graph()
    double = np.vstack((points, points[:9]))
    pairs = np.vstack((edges, np.stack((np.arange(24, 32), np.arange(25, 33)), axis=1)))
    other = tree_from_graph(double, np.append(radius, radius[:9]), pairs)
    np.testing.assert_array_equal(other.points_lps, tree.points_lps)


def test_separate_piece_of_a_graph_is_reported():
    points, radius, edges = _graph()
    points = np.vstack((points, [(99, 0, 0), (99, 0, 1)]))
    tree = tree_from_graph(points, np.append(radius, (1.0, 1.0)), np.vstack((edges, [(24, 25)])))
    assert tree.n_points == 24
    assert tree.report.components_dropped == 1


@pytest.mark.parametrize(
    "change",
    [
        lambda p, r, e: (p[:, :2], r, e),
        lambda p, r, e: (p, r[:-1], e),
        lambda p, r, e: (p, r, e + 1),
        lambda p, r, e: (p, r, e[:0]),
        lambda p, r, e: (p, -r, e),
        lambda p, r, e: (p * np.nan, r, e),
        lambda p, r, e: (p[:0], r[:0], e),
    ],
)
def test_unusable_graph_is_refused(change):
    with pytest.raises(AnatomyError, match="graph is unusable"):
        tree_from_graph(*change(*_graph()))


def test_graph_upside_down_is_refused():
    points, radius, edges = _graph()
    with pytest.raises(AnatomyError, match="upside down"):
        tree_from_graph(points * (1, -1, -1), radius, edges)
