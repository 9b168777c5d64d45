"""Nested tubes and a needle beside PyElastica: Cosserat rods, tied at their nodes, free to turn, at rest."""

from __future__ import annotations

import numpy as np
import pytest

from stages.tube.device import Tube
from stages.tube.mechanics import TubeMechanics

pytest.importorskip("elastica", reason="PyElastica (the extra 'test') is not installed")
from experiments.support import rods as rods_of

pytestmark = pytest.mark.slow

SYSTEMS = 3
"""So many of the random systems; `experiments.needle_rods` takes 50."""


@pytest.mark.parametrize("degrees", [0.0, 60.0, 120.0])
def test_two_rods_come_to_rest_in_the_shape_of_the_tubes(degrees: float) -> None:
    length = 42.0
    tubes = [
        Tube(
            outer_diameter_mm=1.0 + 0.3 * size,
            inner_diameter_mm=0.85 + 0.3 * size,
            length_mm=length,
            curved_length_mm=length,
            precurvature_per_mm=curvature,
            youngs_modulus_gpa=1e-3 * rods_of.MODULUS,
        )
        for size, curvature in ((0, 0.02), (1, 0.012))
    ]
    angles = [0.0, np.radians(degrees)]
    wanted = TubeMechanics(tubes).given_base_angles(angles, [0.0, 0.0])
    twisted = float(wanted.tip_angles_rad[1] - wanted.tip_angles_rad[0])
    apart_mm = []
    for spacing in (3.0, 1.5):
        rods = rods_of.at_rest([(tubes, [length, length], angles)], spacing, 60_000.0)[0]
        apart_mm.append(float(np.linalg.norm(rods_of.tip_of(rods[0])[0] - wanted.base_from_tip[:3, 3])))
        inner, outer = (rod.director_collection[..., -1] for rod in rods)
        turn = outer @ inner.T
        turned = float(np.arctan2(turn[0, 1] - turn[1, 0], turn[0, 0] + turn[1, 1]))
        assert turned == pytest.approx(twisted, abs=0.02)
    assert apart_mm[1] < 0.01


def test_tips_under_a_needle_are_those_of_three_rods() -> None:
    found = rods_of.apart(range(SYSTEMS))
    assert max(each.mm for each in found) < 0.1
    assert max(each.degrees for each in found) < 0.2
    assert max(each.moved_mm for each in found) > 0.5
