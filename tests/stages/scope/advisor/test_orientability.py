"""Where a bent tip can point in a straight tube, and in a forked airway."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anatomy.lung import Lung
from stages.scope.advisor.environment import ScopeEnvironment
from stages.scope.advisor.kinematics import ScopeModel, model_of
from stages.scope.advisor.lumen import Lumen, lumen_of_lung
from stages.scope.advisor.nf1 import navigation_field
from stages.scope.advisor.orientability import BEND_STEP_RAD, Orientability, measure_orientability
from stages.scope.device import Bronchoscope
from stages.scope.passages import find_passages
from tests.stages.scope.airways import tube

RANGES = {"twist_low_deg": -90.0, "bend_low_deg": -120.0}


def in_tube(radius_mm: float, scope_mm: float, **more: float) -> Orientability:
    lumen, tree = tube(radius_mm, 50.0, 0.5)
    model = ScopeModel(radius_mm=scope_mm, **{**RANGES, **more})  # type: ignore[arg-type]
    return measure_orientability(ScopeEnvironment(model=model, field=navigation_field(lumen, 0)), tree, 60)


def test_a_wide_tube_leaves_every_bend_a_narrow_one_none() -> None:
    wide, narrow = in_tube(14.0, 1.0), in_tube(1.9, 1.2)
    assert wide.possible.all()
    assert wide.largest_bend_rad == pytest.approx(math.radians(120.0))
    assert narrow.largest_bend_rad < math.radians(40.0)
    assert narrow.allows([0.0, 0.0, -1.0]), "straight on always goes"
    assert not narrow.allows([1.0, 0.0, 0.0])
    assert wide.allows([1.0, 0.0, 0.0])
    assert wide.allows([0.0, -1.0, -0.2])


def test_the_chord_of_the_bend_must_fit_across_the_tube() -> None:
    """A bend of b over 10 mm goes (1 - cos b) 10 mm / b sideways; leaning aside, it needs less width."""
    found = in_tube(5.0, 1.5)
    largest = found.largest_bend_rad
    lean = math.radians(15.0)
    free = 2.0 * (5.0 - 1.5) + 0.6

    def sideways(bend: float) -> float:
        return 10.0 / bend * (math.cos(lean) - math.cos(bend - lean))

    assert sideways(largest) <= free
    upright = 10.0 / (largest + 2 * BEND_STEP_RAD) * (1.0 - math.cos(largest + 2 * BEND_STEP_RAD))
    assert upright > 0.7 * (free - 1.2), "and not much less than what fits"


def test_directions_are_where_the_tip_looks(forked: tuple[Lung, Lumen]) -> None:
    lung, lumen = forked
    environment = ScopeEnvironment(
        model=ScopeModel(radius_mm=1.5, **RANGES), field=navigation_field(lumen, 0)
    )
    for point in (40, 110, 150):
        found = measure_orientability(environment, lung.tree, point)
        assert np.linalg.norm(found.directions, axis=1) == pytest.approx(1.0)
        assert found.angle_rad(found.forward) < math.radians(25.0)
        best = found.directions[found.possible][0]
        assert found.angle_rad(best) < 1e-6
        assert found.possible.any()


def test_a_wider_scope_points_nowhere_where_a_thinner_one_cannot(forked: tuple[Lung, Lumen]) -> None:
    lung, lumen = forked
    field = navigation_field(lumen, 0)
    sizes = (1.0, 2.0, 3.0, 6.0)
    bends = []
    for radius in sizes:
        environment = ScopeEnvironment(model=ScopeModel(radius_mm=radius, **RANGES), field=field)
        bends.append(int(measure_orientability(environment, lung.tree, 130).possible.sum()))
    assert bends[0] > bends[1] > bends[2] > bends[3] == 0
    nowhere = measure_orientability(
        ScopeEnvironment(model=ScopeModel(radius_mm=6.0, **RANGES), field=field), lung.tree, 130
    )
    assert nowhere.largest_bend_rad == 0.0
    assert not nowhere.allows(nowhere.forward, math.pi)


def test_the_tip_can_look_along_the_airway(small_lung: Lung) -> None:
    scope = Bronchoscope(
        name="thin",
        outer_diameter_mm=3.0,
        channel_diameter_mm=1.2,
        lumen_margin_mm=0.1,
        bend_up_deg=180.0,
        bend_down_deg=130.0,
        bending_length_mm=15.0,
        min_bending_radius_mm=8.0,
        min_shaft_radius_mm=10.0,
        bending_stiffness_n_mm2=1000.0,
    )
    places = find_passages(small_lung, scope, reach_mm=30.0)
    points = np.flatnonzero(places.passable & places.exits_ahead)
    field = navigation_field(lumen_of_lung(small_lung), 0)
    environment = ScopeEnvironment(model=model_of(scope), field=field)
    misses = []
    for point in points[:: max(1, len(points) // 12)]:
        found = measure_orientability(environment, small_lung.tree, int(point))
        misses.append(found.angle_rad(small_lung.tree.tangents[point]))
    assert np.median(misses) < math.radians(10.0)
    assert all(0.0 <= miss <= math.pi for miss in misses)


def test_the_papers_twists_leave_a_sector_out() -> None:
    """Alpha in [-60, 90] with bends to both sides leaves a gap of 30 degrees, on either side."""
    found = in_tube(14.0, 1.0, twist_low_deg=-60.0)
    angles = [
        found.angle_rad([math.cos(a), math.sin(a), 0.0]) for a in np.radians(np.arange(0.0, 360.0, 5.0))
    ]
    assert max(angles) > math.radians(12.0)
    full = in_tube(14.0, 1.0)
    angles = [full.angle_rad([math.cos(a), math.sin(a), 0.0]) for a in np.radians(np.arange(0.0, 360.0, 5.0))]
    assert max(angles) < math.radians(8.5)
