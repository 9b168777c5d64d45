"""Bounds of the cost map, what is infinite in it, and its growing."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anatomy.base.errors import GridMismatchError
from anatomy.grid import Grid
from anatomy.io.assembly import require_cost
from anatomy.patient import PatientImages
from anatomy.segmentation.airway import Airways
from anatomy.segmentation.cost_map import cost_map
from anatomy.segmentation.vessels import Vessels

SHAPE = (14, 12, 10)
GRID = Grid.from_spacing(SHAPE, (0.7, 0.8, 1.0), (0.0, 0.0, 0.0))


def parts(seed: int) -> tuple[Vessels, Airways, np.ndarray]:
    rng = np.random.default_rng(seed)
    large, lumen, wall, lung = (rng.random(SHAPE) < p for p in (0.02, 0.02, 0.02, 0.97))
    response = rng.random(SHAPE, dtype=np.float32)
    vessels = Vessels(vesselness=response, large=large, mask=response > 0.5, threshold=0.5)
    return vessels, Airways(lumen=lumen, wall=wall & ~lumen), lung


@given(st.integers(0, 10_000))
@settings(max_examples=40, deadline=None)
def test_bounds_and_obstacles(seed: int) -> None:
    vessels, airways, lung = parts(seed)
    cost = cost_map(vessels, airways, lung, GRID)
    finite = np.isfinite(cost.array)
    barred = ~lung | airways.lumen | airways.wall | vessels.large
    assert cost.array.dtype == np.float32
    assert not finite[barred].any()
    assert np.isposinf(cost.array[~finite]).all()
    assert (cost.array[finite] == vessels.vesselness[finite]).all()
    assert ((cost.array[finite] >= 0.0) & (cost.array[finite] <= 1.0)).all()
    assert (finite == ~barred).all()


def test_it_serves_as_the_cost_of_a_patient() -> None:
    vessels, airways, lung = parts(1)
    cost = cost_map(vessels, airways, lung, GRID)
    volume = require_cost(cost, GRID)
    lungs, lumen, mask = (type(cost)(grid=GRID, array=a) for a in (lung, airways.lumen, vessels.mask))
    PatientImages(name="p", kind="masks", grid=GRID, lumen=lumen, vessels=mask, lung=lungs, cost=volume)


def test_refuses_other_shapes() -> None:
    vessels, airways, lung = parts(1)
    with pytest.raises(GridMismatchError, match="lung"):
        cost_map(vessels, airways, lung[:-1], GRID)
