"""Where a scope passes along the axis of a forked airway of known radii, and where exits are ahead."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from anatomy.lung import Lung
from anatomy.structures import BRANCH_SHIFT, LUMEN, OUTSIDE, VESSEL
from stages.scope.device import Bronchoscope
from stages.scope.motions import Passages, find_passages
from tests.stages.scenes import Canvas, brute_clearance, forked_tree, lung_of

CARINA, FORK = np.array([0.0, 0.0, 20.0]), np.array([26.0, 0.0, -4.0])
LINES = [
    (np.array([0.0, 0.0, 44.0]), CARINA, 6.0, -1),
    (CARINA, FORK, 4.0, 0),
    (CARINA, np.array([-26.0, 0.0, -4.0]), 2.5, 0),
    (FORK, np.array([40.0, 0.0, -24.0]), 2.0, 1),
    (FORK, np.array([46.0, 0.0, 4.0]), 3.0, 1),
]
MEDIASTINUM_MM = 11.0


@pytest.fixture(scope="module")
def lung() -> Lung:
    """Trachea (6 mm), left (4) and right (2.5) main bronchus, two more on the left (2 and 3)."""
    return forked_lung()


def forked_lung(mediastinum_mm: float = MEDIASTINUM_MM) -> Lung:
    canvas = Canvas.empty([-36, -12, -34.2], [54, 12, 49.8], 0.6)
    canvas.add(np.abs(canvas.points[..., 0]) < mediastinum_mm, OUTSIDE)
    for branch, (a, b, radius, _parent) in enumerate(LINES):
        canvas.airway(canvas.capsule(a, b, radius), canvas.capsule(a, b, radius + 1.0), branch)
    return canvas.lung(forked_tree(LINES))


def scope(diameter_mm: float, margin_mm: float = 0.0) -> Bronchoscope:
    return Bronchoscope(
        name="test", outer_diameter_mm=diameter_mm, channel_diameter_mm=1.0, lumen_margin_mm=margin_mm,
        bend_up_deg=180.0, bend_down_deg=130.0, bending_length_mm=15.0,
        min_bending_radius_mm=8.0, min_shaft_radius_mm=10.0, bending_stiffness_n_mm2=1000.0,
    )  # fmt: skip


def found_in(lung: Lung, diameter_mm: float, margin_mm: float = 0.0, reach_mm: float = 30.0) -> Passages:
    return find_passages(lung, scope(diameter_mm, margin_mm), reach_mm=reach_mm)


def branches_of(lung: Lung, diameter_mm: float, margin_mm: float = 0.0) -> set[int]:
    """Branches that open in their second half: near its root a branch is as wide as its parent."""
    found = found_in(lung, diameter_mm, margin_mm)
    halves = [lung.tree.branch_points(b) for b in range(len(LINES))]
    open_ = found.passable & found.exits_ahead
    return {b for b, points in enumerate(halves) if open_[points[len(points) // 2 :]].any()}


def test_each_branch_opens_at_its_own_diameter(lung: Lung) -> None:
    """Up to a voxel, 0.6 mm: a circle of voxels is narrower than what was drawn."""
    assert branches_of(lung, 2.4) == {0, 1, 2, 3, 4}
    assert branches_of(lung, 3.3) == {0, 1, 2, 4}, "too thick for 2 mm"
    assert branches_of(lung, 4.3) == {0, 1, 4}, "too thick for 2.5 mm"
    assert branches_of(lung, 6.05) == {0, 1}, "too thick for 3 mm"
    assert branches_of(lung, 9.0) == {0}
    assert branches_of(lung, 12.05) == set()


def test_the_lumen_margin_counts_on_both_sides(lung: Lung) -> None:
    for diameter in (2.4, 3.3, 4.3, 6.05):
        assert branches_of(lung, diameter - 1.0, 0.5) == branches_of(lung, diameter)


def test_behind_a_narrow_place_nothing_is_passable(lung: Lung) -> None:
    """The route counts: a wide branch behind a ring of wall cannot be reached."""
    labels = lung.labels.copy(order="F")
    centres = lung.grid.lps(np.argwhere(labels >= 0)).reshape(*labels.shape, 3)
    along = (centres - CARINA) @ ((FORK - CARINA) / np.linalg.norm(FORK - CARINA))
    in_left_bronchus = (labels >> BRANCH_SHIFT) == 2
    labels[in_left_bronchus & (np.abs(along - 20.0) < 1.0)] &= ~np.uint16(LUMEN)
    narrowed = lung_of(labels, lung.grid, lung.tree)
    assert not found_in(narrowed, 2.0).passable[narrowed.tree.branch_points(4)].any()


def test_radius_of_the_way_is_proved(lung: Lung) -> None:
    """Never more than the distance to the nearest voxel that is not lumen, anywhere on the route."""
    found = found_in(lung, 3.0)
    tree = lung.tree
    lumen = (lung.labels & LUMEN) != 0
    border = binary_dilation(lumen, np.ones((3, 3, 3))) & ~lumen
    not_lumen = np.where(border, VESSEL, 0).astype(np.uint16)
    parent = np.maximum(tree.parent_point, 0)
    share = np.linspace(0.0, 1.0, 6)[:, None, None]
    dense = tree.points_lps[parent] + share * (tree.points_lps - tree.points_lps[parent])
    depth = brute_clearance(not_lumen, lung.grid, dense.reshape(-1, 3), VESSEL, 7.0)
    truth = depth.reshape(6, -1).min(axis=0)
    for point in range(1, tree.n_points):
        truth[point] = min(truth[point], truth[parent[point]])
    assert (found.lumen_radius_mm <= truth + 1e-9).all()
    assert (found.lumen_radius_mm >= truth - 0.3).all()


def test_airways_in_the_mediastinum_are_left_out(lung: Lung) -> None:
    ahead = found_in(lung, 2.0, reach_mm=1.0).exits_ahead
    x, radius = np.abs(lung.tree.points_lps[ahead, 0]), lung.tree.radius_mm[ahead]
    # A probe reaches 2.5 mm beyond the lumen, and the point it is sent from may lie 1 mm ahead.
    assert (x + radius + 2.5 + 1.0 >= MEDIASTINUM_MM - 0.6).all()
    assert len(x) > 20
    trachea = lung.tree.branch_points(0)
    assert found_in(forked_lung(0.0), 2.0, reach_mm=1.0).exits_ahead[trachea].any()
    assert not ahead[trachea].any()


def test_reach_lets_the_tip_stand_before_the_lung(lung: Lung) -> None:
    distances = []
    for reach in (1.0, 10.0, 20.0):
        ahead = found_in(lung, 2.0, reach_mm=reach).exits_ahead
        distances.append(float(np.abs(lung.tree.points_lps[ahead, 0]).min()))
    assert distances[0] > distances[1] >= distances[2] == 0.0


def test_why_the_others_are_closed(lung: Lung) -> None:
    assert found_in(lung, 2.4).narrowest == (-1, 0.0)
    generation, excess = found_in(lung, 3.3).narrowest
    assert generation == 2 and 0.0 < excess < 0.6
    generation, excess = found_in(lung, 13.0).narrowest
    assert generation == 0 and 0.4 < excess < 1.5


def test_the_widest_scope_that_passes_a_place_with_an_exit_ahead(lung: Lung) -> None:
    for margin in (0.0, 0.4):
        widest = found_in(lung, 14.0, margin).widest_scope_mm
        assert 9.0 < widest < 12.0
        for diameter, passes in ((widest - 1e-6, True), (widest + 1e-6, False)):
            found = found_in(lung, diameter, margin)
            assert (found.passable & found.exits_ahead).any() == passes


def test_no_airway_in_lung_tissue() -> None:
    found = found_in(forked_lung(200.0), 2.0)
    assert found.widest_scope_mm == 0.0
    assert found.passable.all() and not found.exits_ahead.any()
