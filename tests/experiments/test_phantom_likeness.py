"""The study of how like patients phantoms are: what is measured, and how it is compared."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from anatomy.lung import Lung
from anatomy.structures import OUTSIDE, VESSEL
from experiments.phantom_likeness import Measured, add_rows, draw
from experiments.support.likeness import DEPTHS_MM, FAR_MM, Likeness, _far_from_carina, likeness_of
from experiments.support.results import Result, small_png
from lungaccess.running.benchmark.synthetic.cases import FAMILIES


@pytest.fixture(scope="module")
def like(small_lung: Lung) -> Likeness:
    return likeness_of(small_lung)


def test_voxels_far_from_the_carina_are_those(small_lung: Lung) -> None:
    far = _far_from_carina(small_lung)
    places = np.random.default_rng(0).integers(0, small_lung.grid.shape, (500, 3))
    distance = np.linalg.norm(small_lung.grid.lps(places) - small_lung.tree.carina_lps, axis=1)
    assert (far[tuple(places.T)] == (distance > FAR_MM)).all()
    assert 0 < far.sum() < far.size


def test_shares_of_vessels_are_counted_in_their_shells(small_lung: Lung, like: Likeness) -> None:
    labels = np.asarray(small_lung.labels)
    inside, vessel = (labels & OUTSIDE) == 0, (labels & VESSEL) != 0
    assert len(like.vessel_share) == len(like.far_vessel_share) == len(DEPTHS_MM)
    whole = vessel[inside].mean()
    assert min(like.vessel_share) < whole < max(like.vessel_share)
    assert like.lung_l == pytest.approx(inside.sum() * np.prod(small_lung.grid.spacing_mm) * 1e-6)


def test_phantoms_are_compared_with_patients_by_medians(like: Likeness) -> None:
    wide = {g: tuple(2.0 * value for value in each) for g, each in like.diameter_mm.items()}
    patients = [Measured(likeness=like, family="", reached=40.0)]
    made = [
        Measured(likeness=replace(like, diameter_mm=wide), family=family, reached=20.0) for family in FAMILIES
    ]
    result = Result(name="phantom_likeness", title="t")
    add_rows(result, patients, made)
    rows = {row.quantity: row for row in result.rows}
    for row in rows.values():
        assert row.paper is not None and row.ours is not None
        factor = 2.0 if "diameter" in row.quantity else 0.5 if "reach" in row.quantity else 1.0
        assert row.ours == pytest.approx(factor * row.paper)
    assert rows["peripheral targets within reach of thin-scope"].unit == "%"
    assert small_png(draw(patients, made)).startswith(b"\x89PNG")


def test_children_are_not_compared_with_patients(like: Likeness) -> None:
    tall = Measured(likeness=like, family="adult", reached=10.0)
    result = Result(name="phantom_likeness", title="t")
    add_rows(result, [tall], [tall, Measured(likeness=like, family="child", reached=90.0)])
    (row,) = [each for each in result.rows if "reach" in each.quantity]
    assert (row.ours, row.paper) == (10.0, 10.0) and "children 90" in row.note
