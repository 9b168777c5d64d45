"""The scores of segmentations, on two cylinders whose answers are known."""

from __future__ import annotations

import numpy as np
import pytest

from anatomy.grid import Grid, Volume
from experiments.support.segmentation import scores
from experiments.support.segmentation.synthetic_ct import SyntheticCt

SPACING_MM = 0.5
SHAPE = (60, 40, 60)


@pytest.fixture(scope="module")
def truth() -> SyntheticCt:
    """Two cylinders along k, of 1.2 and 3.3 mm radius, in a block of lung."""
    x, y, _ = np.indices(SHAPE) * SPACING_MM
    vessels = ((x - 6.0) ** 2 + (y - 10.0) ** 2 <= 1.2**2) | ((x - 20.0) ** 2 + (y - 10.0) ** 2 <= 3.3**2)
    grid = Grid.from_spacing(SHAPE, (SPACING_MM,) * 3, (0.0, 0.0, 0.0))
    nothing = np.zeros(SHAPE, dtype=np.bool_, order="F")
    ct = Volume(grid=grid, array=np.zeros(SHAPE, dtype=np.int16, order="F"))
    lung = np.ones(SHAPE, dtype=np.bool_, order="F")
    vessels = np.asfortranarray(vessels)
    return SyntheticCt(ct=ct, lung=lung, lumen=nothing, wall=nothing, vessels=vessels, fissures=nothing)


def mask_of(at: scores.Index) -> scores.Mask:
    flat = np.zeros(np.prod(SHAPE), dtype=np.bool_)
    flat[at] = True
    return flat.reshape(SHAPE, order="F")


def test_points_come_from_the_right_places(truth: SyntheticCt) -> None:
    every, sure = (scores.point_groups(truth, sure=s) for s in (False, True))
    distance = scores.distance_mm(truth.vessels, truth.ct.grid)
    np.testing.assert_array_equal(mask_of(every.vessel), truth.vessels)
    np.testing.assert_array_equal(mask_of(every.near), (distance > 0.0) & (distance <= scores.NEAR_MM))
    assert distance[mask_of(every.far)].min() > scores.NEAR_MM
    assert distance[mask_of(every.near)].min() == SPACING_MM
    assert distance[mask_of(sure.near)].min() == 2 * SPACING_MM
    np.testing.assert_array_equal(sure.vessel, every.vessel)
    inside, outside = next(every.draws(truth.vessels.astype(np.float32).ravel(order="K"), 1))
    assert (inside.size, outside.size) == (281, 601)
    assert inside.all()
    assert not outside.any()


def test_vessels_are_told_apart_by_radius(truth: SyntheticCt) -> None:
    groups = scores.point_groups(truth, sure=True)
    classes = scores.vessels_by_radius(truth, groups)
    assert sum(at.size for at in classes.values()) == groups.vessel.size
    thin = truth.vessels & (np.indices(SHAPE)[0] < 26)
    of_thin = {name: int((mask_of(at) & thin).sum()) for name, at in classes.items()}
    of_thick = {name: int((mask_of(at) & truth.vessels & ~thin).sum()) for name, at in classes.items()}
    assert of_thin["1 to 1.5 mm"] == thin.sum()
    assert of_thick["2.83 to 4 mm"] > 0.9 * (truth.vessels & ~thin).sum()
    assert of_thick["over 4 mm"] == 0


def test_f1_of_known_counts() -> None:
    inside = np.array([0.9] * 200 + [0.1] * 81, dtype=np.float32)
    outside = np.array([0.9] * 50 + [0.1] * 551, dtype=np.float32)
    assert scores.f1(inside, outside, 0.5) == pytest.approx(2 * 200 / (2 * 200 + 50 + 81))
    assert scores.f1(inside, outside, 0.95) == 0.0
    assert scores.f1(inside[::10], outside, 0.05) == pytest.approx(2 * 281 / (281 + 882), rel=1e-6)


def test_a_perfect_score_is_one_and_a_blind_one_is_not(truth: SyntheticCt) -> None:
    groups = scores.point_groups(truth, sure=False)
    perfect = scores.point_scores(groups, truth.vessels.astype(np.float32), 0.25, 3)
    assert (perfect.best, perfect.fixed) == (1.0, 1.0)
    blind = scores.point_scores(groups, np.ones(SHAPE, dtype=np.float32, order="F"), 0.25, 3)
    assert blind.best == pytest.approx(2 * 281 / (281 + 882))


def test_area_under_the_curve_counts_ties_half() -> None:
    low, high = np.array([0.1, 0.2], dtype=np.float32), np.array([0.2, 0.3], dtype=np.float32)
    assert scores.auc(high, low) == pytest.approx(0.875)
    assert scores.auc(low, low) == pytest.approx(0.5)
