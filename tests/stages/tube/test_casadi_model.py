"""The CasADi model of the tubes against closed forms, finite differences and the kernels."""

from __future__ import annotations

import math

import casadi
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from scipy.special import ellipj, ellipk

from anatomy.base.errors import SettingsError
from stages.tube.casadi_model import CasadiTubes
from stages.tube.device import BentPiece, Tube
from stages.tube.errors import ConvergenceError
from stages.tube.mechanics import TubeMechanics

FINE = 800
"""Runge-Kutta steps in a piece where many digits count."""


class RigidTube(Tube):
    """A tube that bends but hardly twists."""

    @property
    def torsional_stiffness_n_mm2(self) -> float:
        return 1e12 * super().torsional_stiffness_n_mm2


def tube(size: int, length: float, curved: float = 0.0, curvature: float = 0.0, kind: type = Tube) -> Tube:
    """Return a tube that fits around the one of the size before."""
    return kind(
        outer_diameter_mm=1.0 + 0.3 * size,
        inner_diameter_mm=0.85 + 0.3 * size,
        length_mm=length,
        curved_length_mm=curved,
        precurvature_per_mm=curvature,
        youngs_modulus_gpa=55.0,
        poisson_ratio=0.3,
    )


TWIST = Tube(
    outer_diameter_mm=1.0,
    inner_diameter_mm=0.8,
    length_mm=150.0,
    bent_pieces=(
        BentPiece(length_mm=20.0, precurvature_per_mm=0.012, direction_deg=70.0),
        BentPiece(length_mm=10.0, precurvature_per_mm=0.0),
        BentPiece(length_mm=15.0, precurvature_per_mm=0.03, direction_deg=-130.0),
    ),
)
CASES = {
    "two": ([tube(0, 150.0, 50.0, 0.02), tube(1, 100.0, 40.0, 0.015)], [0.4, 1.9], [-90.0, -57.0]),
    "partly retracted": (
        [tube(0, 150.0, 90.0, 0.02), tube(1, 100.0, 60.0, 0.01)],
        [1.0, -1.2],
        [-95.0, -62.0],
    ),
    "two, unstable": ([tube(0, 150.0, 50.0, 0.03), tube(1, 100.0, 45.0, 0.03)], [0.1, 3.0], [-96.0, -54.0]),
    "three": (
        [tube(0, 200.0, 60.0, 0.02), tube(1, 150.0, 50.0, 0.012), tube(2, 90.0, 30.0, 0.015)],
        [0.2, 1.1, -2.0],
        [-110.0, -85.0, -61.0],
    ),
    "out of plane": ([TWIST, tube(1, 90.0, 40.0, 0.015)], [0.5, -1.0], [-80.0, -55.0]),
    "flush, at the plate": ([tube(0, 80.0, 30.0, 0.02), tube(1, 80.0, 30.0, 0.02)], [0.0, 2.0], [0.0, 0.0]),
    "outer ends at the plate": ([tube(0, 150.0, 90.0, 0.02), tube(1, 100.0)], [0.3, 1.4], [-110.0, -100.0]),
    "all end at the plate": ([tube(0, 80.0, 30.0, 0.02), tube(1, 70.0)], [0.3, 1.4], [-80.0, -70.0]),
    "one": ([TWIST], [0.7], [-70.0]),
}


def about(axis: str, angle: float) -> np.ndarray:
    return Rotation.from_euler(axis, angle).as_matrix()


def arc(curvature: float, length: float, direction: float = 0.0) -> np.ndarray:
    """Return the frame after a circular arc that bends towards -y turned by a direction."""
    frame = np.eye(4)
    turn = about("z", direction)
    frame[:3, :3] = turn @ about("x", curvature * length) @ turn.T
    angle = curvature * length
    frame[:3, 3] = turn @ [0.0, -(1.0 - math.cos(angle)) / curvature, math.sin(angle) / curvature]
    return frame


def turned(angle: float, *frames: np.ndarray) -> np.ndarray:
    whole = np.eye(4)
    whole[:3, :3] = about("z", angle)
    for frame in frames:
        whole = whole @ frame
    return whole


def equal_pair(lam: float, length: float = 50.0, shaft: float = 0.0) -> list[Tube]:
    """Return two tubes with `sqrt(c) length = lam` over their curved ends, behind straight shafts."""
    curvature = lam / (length * math.sqrt(1.3))
    return [tube(size, shaft + length, length, curvature) for size in range(2)]


def test_single_tube_is_an_arc() -> None:
    found = CasadiTubes([tube(0, 100.0, 60.0, 0.02)]).given_tip_angles([0.8], [-50.0])
    assert found.base_from_tip == pytest.approx(turned(0.8, arc(0.02, 50.0)), abs=1e-6)
    assert found.base_angles_rad == pytest.approx([0.8], abs=1e-15)
    assert found.determinant == 1.0


def test_bent_pieces_follow_each_other_in_their_own_directions() -> None:
    found = CasadiTubes([TWIST], steps_per_piece=FINE).given_tip_angles([-0.3], [-110.0])
    straight = np.eye(4)
    straight[2, 3] = 10.0
    first = arc(0.012, 15.0, math.radians(70.0))
    expected = turned(-0.3, first, straight, arc(0.03, 15.0, math.radians(-130.0)))
    assert found.base_from_tip == pytest.approx(expected, abs=1e-9)


def test_straight_outer_tube_shares_the_curvature_of_the_inner_one() -> None:
    tubes = [tube(0, 150.0, 50.0, 0.025), tube(1, 100.0)]
    found = CasadiTubes(tubes, steps_per_piece=FINE).solve([0.3, 1.5], [-100.0, -80.0])
    inner, outer = (t.bending_stiffness_n_mm2 for t in tubes)
    expected = turned(0.3, arc(0.025 * inner / (inner + outer), 20.0), arc(0.025, 30.0))
    assert found.base_from_tip == pytest.approx(expected, abs=1e-9)
    assert found.tip_angles_rad == pytest.approx([0.3, 1.5], abs=1e-12)
    assert found.determinant == pytest.approx(1.0, abs=1e-12)


def test_tubes_that_do_not_twist_add_their_curvatures_as_vectors() -> None:
    tubes = [tube(0, 150.0, 50.0, 0.025, RigidTube), tube(1, 100.0, 40.0, 0.015, RigidTube)]
    found = CasadiTubes(tubes, steps_per_piece=FINE).solve([0.3, 1.5], [-100.0, -60.0])
    stiff = [t.bending_stiffness_n_mm2 for t in tubes]
    mean = (stiff[0] * 0.025 * np.exp(0.3j) + stiff[1] * 0.015 * np.exp(1.5j)) / sum(stiff)
    both = arc(abs(mean), 40.0, float(np.angle(mean)))
    expected = both @ arc(0.025, 10.0, 0.3) @ turned(0.3)
    assert found.base_from_tip == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("lam", [0.5, 1.0, 2.5])
@pytest.mark.parametrize("tip", [0.5, 1.5, 3.0])
def test_two_tubes_are_a_pendulum(lam: float, tip: float) -> None:
    found = CasadiTubes(equal_pair(lam), steps_per_piece=2 * FINE).given_tip_angles([0.0, tip], [0.0, 0.0])
    modulus = math.sin(0.5 * (math.pi - tip))
    _, cn, dn, _ = ellipj(lam, modulus**2)
    expected = math.pi - 2.0 * math.asin(modulus * cn / dn)
    base = found.base_angles_rad
    assert base[1] - base[0] == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("shaft", [0.0, 25.0, 100.0, 500.0])
def test_opposed_tubes_become_unstable_at_the_known_length(shaft: float) -> None:
    length = 50.0

    def determinant(lam: float) -> float:
        model = CasadiTubes(equal_pair(lam, length, shaft), steps_per_piece=200)
        return model.given_tip_angles([0.0, math.pi], [-shaft, -shaft]).determinant

    def threshold(lam: float) -> float:
        return math.cos(lam) * length - shaft * lam * math.sin(lam)

    found = brentq(determinant, 0.2, 1.7, xtol=1e-12)
    assert found == pytest.approx(brentq(threshold, 0.1, 1.7, xtol=1e-14), abs=1e-9)


def test_all_three_equilibria_of_a_snapping_pair() -> None:
    lam = 2.0
    model = CasadiTubes(equal_pair(lam), steps_per_piece=FINE)
    modulus = math.sqrt(brentq(lambda m: ellipk(m) - lam, 0.0, 0.99, xtol=1e-15))
    aside = math.pi - 2.0 * math.asin(modulus)
    for expected, sign in [(aside, 1), (math.pi, -1), (2.0 * math.pi - aside, 1)]:
        guess = [0.0, expected + 0.05]
        found = model.solve([0.0, math.pi], [0.0, 0.0], guess)
        assert found.tip_angles_rad[1] - found.tip_angles_rad[0] == pytest.approx(expected, abs=1e-10)
        assert math.copysign(1.0, found.determinant) == sign


def test_no_equilibrium_is_found_from_just_before_the_fold() -> None:
    """The guess is on the branch that ends at the fold, and the wanted angle is beyond it."""
    model = CasadiTubes(equal_pair(2.0))
    with pytest.raises(ConvergenceError, match="Newton's method"):
        model.solve([0.0, 3.5], [0.0, 0.0], [0.0, 2.03])


@pytest.mark.parametrize("name", CASES)
def test_agrees_with_the_kernels(name: str) -> None:
    tubes, tip, beta = CASES[name]
    here = CasadiTubes(tubes, steps_per_piece=FINE).given_tip_angles(tip, beta)
    there = TubeMechanics(tubes, step_rad=0.005).given_tip_angles(tip, beta)
    assert here.base_from_tip[:3, 3] == pytest.approx(there.base_from_tip[:3, 3], abs=1e-9)
    assert here.base_from_tip[:3, :3] == pytest.approx(there.base_from_tip[:3, :3], abs=1e-10)
    assert here.base_angles_rad == pytest.approx(there.base_angles_rad, abs=1e-10)
    behind = there.determinant([min(beta)])[0]
    assert here.determinant == pytest.approx(behind, rel=1e-9)


@pytest.mark.parametrize("name", CASES)
def test_solution_returns_to_the_tip_angles(name: str) -> None:
    tubes, tip, beta = CASES[name]
    model = CasadiTubes(tubes)
    base = model.given_tip_angles(tip, beta).base_angles_rad
    found = model.solve(base, beta, np.array(tip) + 0.01)
    assert found.tip_angles_rad == pytest.approx(tip, abs=1e-10)


def test_turning_all_bases_turns_the_shape() -> None:
    tubes, tip, beta = CASES["three"]
    model = CasadiTubes(tubes)
    one, other = (model.given_tip_angles(np.array(tip) + angle, beta) for angle in (0.0, 0.9))
    assert other.base_from_tip == pytest.approx(turned(0.9, one.base_from_tip), abs=1e-12)
    assert other.base_angles_rad == pytest.approx(one.base_angles_rad + 0.9, abs=1e-12)


def test_functions_of_an_order_are_kept() -> None:
    tubes, _, beta = CASES["two"]
    model = CasadiTubes(tubes)
    order = model.order_at(beta)
    assert order.landmarks == ((0, 1), (1, 1), (0, 0), (1, 0))
    assert model.ordered(order) is model.ordered(model.order_at(beta))
    assert model.order_at([-101.0, -57.0]) != order


def test_nonlinear_program_aims_the_tip() -> None:
    """The functions can be called with symbols, and a solver is given their derivatives."""
    tubes, tip, beta = CASES["two"]
    model = CasadiTubes(tubes, steps_per_piece=10)
    target = model.given_tip_angles(tip, beta).base_from_tip[:3, 3]
    functions = model.ordered(model.order_at(beta))
    angles, bases = casadi.MX.sym("angles", 2), casadi.MX.sym("bases", 2)
    _, position, _, determinant = functions.forward(angles, bases)
    effort = casadi.sumsqr(angles - np.array(tip) - 0.1) + 1e-4 * casadi.sumsqr(bases - np.array(beta))
    limits = casadi.vertcat(position - target, determinant)
    program = {"x": casadi.vertcat(angles, bases), "f": effort, "g": limits}
    quiet = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-10}}
    count = limits.shape[0]
    solver = casadi.nlpsol("aim", "ipopt", program, quiet)
    answer = solver(
        x0=[*(np.array(tip) + 0.3), *(np.array(beta) + 1.0)],
        lbg=[0.0] * 3 + [0.1] * (count - 3),
        ubg=[0.0] * 3 + [math.inf] * (count - 3),
    )
    assert solver.stats()["success"]
    found = answer["x"].full()[:, 0]
    reached = model.given_tip_angles(found[:2], found[2:])
    assert reached.base_from_tip[:3, 3] == pytest.approx(target, abs=1e-7)


@pytest.mark.parametrize("beta", [[1.0, -57.0], [-160.0, -101.0], [-90.0, -20.0]])
def test_impossible_bases_are_refused(beta: list[float]) -> None:
    with pytest.raises(SettingsError, match="bases are at"):
        CasadiTubes(CASES["two"][0]).order_at(beta)


def test_at_least_one_tube_and_one_step() -> None:
    with pytest.raises(SettingsError, match="0 tubes"):
        CasadiTubes([])
    with pytest.raises(SettingsError, match="0 steps"):
        CasadiTubes(CASES["one"][0], steps_per_piece=0)


@pytest.mark.parametrize("tip", [[0.0], [0.0, math.nan]])
def test_every_tube_has_a_finite_angle(tip: list[float]) -> None:
    tubes, _, beta = CASES["two"]
    with pytest.raises(SettingsError, match="tip angles are"):
        CasadiTubes(tubes).given_tip_angles(tip, beta)
