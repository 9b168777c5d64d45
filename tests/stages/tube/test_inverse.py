"""Joint values for wanted tip poses."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anatomy.base.errors import FrameError, SettingsError
from anatomy.base.typed import Float
from stages.tube.device import Tube
from stages.tube.inverse import Match, _Problem, inverse_kinematics
from stages.tube.mechanics import TubeMechanics

PAIR = TubeMechanics(
    [
        Tube(outer_diameter_mm=1.5, inner_diameter_mm=1.3, length_mm=660.0, curved_length_mm=40.0,
             precurvature_per_mm=0.0045),
        Tube(outer_diameter_mm=1.9, inner_diameter_mm=1.65, length_mm=640.0, curved_length_mm=40.0,
             precurvature_per_mm=0.0045),
    ]
)  # fmt: skip
SINGLE = TubeMechanics(
    [Tube(outer_diameter_mm=1.5, inner_diameter_mm=1.3, length_mm=100.0, curved_length_mm=60.0,
          precurvature_per_mm=0.02)]
)  # fmt: skip


def within_limits(beta: Float, mechanics: TubeMechanics, most: float) -> bool:
    ahead = beta + mechanics.lengths_mm
    return bool(
        (beta <= 0.0).all()
        and (np.diff(beta) >= -1e-9).all()
        and (np.diff(ahead) <= 1e-9).all()
        and ahead[0] <= most + 1e-9
        and ahead.min() >= 0.0
    )


@pytest.mark.parametrize("match", ["position", "direction", "pose"])
def test_poses_that_tubes_take_are_found_again(match: Match) -> None:
    rng = np.random.default_rng(2)
    for _ in range(4):
        ahead = rng.uniform(20.0, 58.0)
        second = rng.uniform(max(ahead - 20.0, 0.0), ahead)
        wanted = PAIR.given_tip_angles(rng.uniform(-3.0, 3.0, 2), [ahead - 660.0, second - 640.0])
        found = inverse_kinematics(PAIR, wanted.base_from_tip, match=match)
        assert found.reached and found.position_error_mm < 0.01
        assert found.direction_error_rad < 1e-3 and found.roll_error_rad < 1e-3
        assert found.equilibrium.stable and within_limits(found.beta_mm, PAIR, 60.0)
        again = PAIR.given_base_angles(
            found.base_angles_rad, found.beta_mm, guess_rad=found.equilibrium.tip_angles_rad
        )
        assert np.allclose(again.base_from_tip, found.equilibrium.base_from_tip, atol=1e-9)


def test_of_a_single_tube_the_nearest_tip_is_on_its_arc() -> None:
    """A point aside of the arc, in its plane: the nearest tip by a fine scan of the one length."""
    wanted = np.eye(4)
    wanted[:3, 3] = 20.0, 0.0, 30.0
    scan = np.array(
        [
            [(1.0 - math.cos(0.02 * s)) / 0.02, math.sin(0.02 * s) / 0.02] if s < 60.0 else [0.0, 1e9]
            for s in np.linspace(0.01, 59.0, 60_000)
        ]
    )
    nearest = float(np.linalg.norm(scan - [20.0, 30.0], axis=1).min())
    found = inverse_kinematics(SINGLE, wanted, match="position", max_extension_mm=59.0)
    assert not found.reached
    assert found.position_error_mm == pytest.approx(nearest, abs=1e-6)
    assert found.equilibrium.base_from_tip[0, 3] > 0.0


def test_limits_hold_for_what_cannot_be_reached() -> None:
    wanted = np.eye(4)
    wanted[:3, 3] = 0.0, 0.0, 300.0
    found = inverse_kinematics(PAIR, wanted, match="position", max_extension_mm=45.0)
    assert not found.reached and within_limits(found.beta_mm, PAIR, 45.0)
    assert found.position_error_mm > 250.0


def test_derivatives_of_the_residuals() -> None:
    wanted = PAIR.given_tip_angles([0.4, 1.5], [-620.0, -610.0]).base_from_tip
    problem = _Problem(PAIR, wanted, "pose", 60.0, 40.0)
    for x in (np.array([0.2, 1.0, 0.7, 0.6]), np.array([0.2, -1.0, 0.2, 0.4])):
        h = 1e-6
        for column, derivative in enumerate(problem.jacobian(x).T):
            step = np.eye(4)[column] * h
            rate = (problem.residual(x + step) - problem.residual(x - step)) / (2.0 * h)
            assert np.allclose(rate, derivative, atol=1e-4 * max(1.0, np.abs(derivative).max()))


def test_same_seed_same_answer() -> None:
    wanted = PAIR.given_tip_angles([0.4, 1.5], [-620.0, -610.0]).base_from_tip
    one, two = (inverse_kinematics(PAIR, wanted, seed=5) for _ in range(2))
    assert np.array_equal(one.base_angles_rad, two.base_angles_rad)
    assert np.array_equal(one.beta_mm, two.beta_mm)


def test_bad_input() -> None:
    with pytest.raises(FrameError, match="rigid"):
        inverse_kinematics(PAIR, np.diag([1.0, 1.0, 2.0, 1.0]))
    with pytest.raises(FrameError, match="rigid"):
        inverse_kinematics(PAIR, np.full((4, 4), np.nan))
    with pytest.raises(SettingsError, match="max_extension_mm"):
        inverse_kinematics(PAIR, np.eye(4), max_extension_mm=1000.0)
    with pytest.raises(SettingsError, match="starts"):
        inverse_kinematics(PAIR, np.eye(4), starts=0)
