"""Torsion, stability and poses of nested tubes against closed forms and each other."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.special import ellipj

from anatomy.base.errors import LungaccessError, SettingsError
from anatomy.base.typed import Float
from stages.tube import TubeMechanics
from stages.tube.device import BentPiece, ConcentricTubes, Tube
from tests.stages.tube.closed_form import centreline

NU = 0.3
CURVED_MM = 40.0
FINE = 0.01


def tube(kappa: float, length_mm: float = 100.0, curved_mm: float = CURVED_MM, **more: Any) -> Tube:
    curved = {"curved_length_mm": curved_mm, "precurvature_per_mm": kappa} if kappa else {}
    size = {"outer_diameter_mm": 1.5, "inner_diameter_mm": 1.3, "length_mm": length_mm, "poisson_ratio": NU}
    return Tube(**(size | curved | more))


def textbook(*tubes: Tube, step_rad: float = FINE) -> TubeMechanics:
    """Tubes of any diameter."""
    return TubeMechanics(tubes, step_rad=step_rad, least_clearance_mm=None)


def pendulum(lam: float) -> TubeMechanics:
    """Two equal tubes, curved all along; sqrt(c) L is lam [Dupont2010]."""
    kappa = lam / (CURVED_MM * math.sqrt(1.0 + NU))
    return textbook(*[tube(kappa, CURVED_MM)] * 2)


def nested(kappas: tuple[float, ...], lengths_mm: tuple[float, ...]) -> TubeMechanics:
    """Tubes that fit into each other, the outer ones thicker."""
    sizes = ((1.1, 0.9), (1.5, 1.3), (1.9, 1.65))[-len(kappas) :]
    return TubeMechanics(
        [
            tube(kappa, length, outer_diameter_mm=outer, inner_diameter_mm=inner)
            for kappa, length, (outer, inner) in zip(kappas, lengths_mm, sizes, strict=True)
        ]
    )


PAIR = nested((0.0045, 0.0045), (660.0, 640.0))
TRIPLE = nested((0.006, 0.005, 0.004), (200.0, 160.0, 120.0))


def random_joints(mechanics: TubeMechanics, rng: np.random.Generator, count: int) -> tuple[Float, Float]:
    ahead = np.sort(rng.uniform(1.0, 60.0, (4 * count, mechanics.count)), axis=1)[:, ::-1]
    beta = ahead - mechanics.lengths_mm
    beta = beta[(np.diff(beta, axis=1) >= 0.0).all(axis=1) & (beta <= 0.0).all(axis=1)][:count]
    assert len(beta) == count
    return rng.uniform(-math.pi, math.pi, beta.shape), beta


def test_a_single_tube_is_an_arc() -> None:
    kappa, ahead, psi = 0.02, 50.0, 0.7
    found = textbook(tube(kappa, 100.0, 60.0)).given_base_angles([psi], [ahead - 100.0])
    c, s = math.cos(psi), math.sin(psi)
    x, y = 0.0, -(1.0 - math.cos(kappa * ahead)) / kappa
    expected = [c * x - s * y, s * x + c * y, math.sin(kappa * ahead) / kappa]
    assert np.allclose(found.base_from_tip[:3, 3], expected, atol=1e-12)
    assert found.stable and found.least_determinant == 1.0


def test_aligned_tubes_share_the_curvature_by_stiffness() -> None:
    stiff = tube(0.01, outer_diameter_mm=1.9, inner_diameter_mm=1.65)
    soft = tube(0.02)
    weights = [t.bending_stiffness_n_mm2 for t in (soft, stiff)]
    kappa = (0.02 * weights[0] + 0.01 * weights[1]) / sum(weights)
    found = textbook(soft, stiff).given_tip_angles([0.0, 0.0], [-70.0, -70.0])
    assert found.backbone(30.0)[0, 1] == pytest.approx(-(1.0 - math.cos(30.0 * kappa)) / kappa, abs=1e-12)
    assert np.all(found.torsion([0.0, 15.0, 30.0]) == 0.0)


def test_opposed_equal_tubes_are_straight() -> None:
    found = textbook(tube(0.02), tube(0.02)).given_tip_angles([0.0, math.pi], [-60.0, -60.0])
    assert np.allclose(found.base_from_tip[:3, 3], [0.0, 0.0, 40.0], atol=1e-12)


@pytest.mark.parametrize("lam", [0.5, 1.0, 1.4])
@pytest.mark.parametrize("tip", [0.5, 1.5, 2.5, 3.0])
def test_two_tubes_are_a_pendulum(lam: float, tip: float) -> None:
    """theta(0) = pi - 2 asin(k cd(lam | k^2)), k = sin((pi - theta_L) / 2) [Dupont2010]."""
    k = math.sin((math.pi - tip) / 2.0)
    _sn, cn, dn, _ph = ellipj(lam, k * k)
    found = pendulum(lam).given_tip_angles([0.0, tip], [0.0, 0.0])
    theta = found.base_angles_rad[1] - found.base_angles_rad[0]
    assert theta == pytest.approx(math.pi - 2.0 * math.asin(k * cn / dn), abs=1e-12)


@pytest.mark.parametrize("transmission", [0.0, 0.5, 1.0, 2.0, 5.0, 10.0])
def test_bifurcation_threshold(transmission: float) -> None:
    """Opposed equal tubes lose stability at lam tan lam = L / Lt."""
    formula = math.pi / 2.0
    if transmission:
        formula = brentq(lambda x: x * math.tan(x) - 1.0 / transmission, 1e-6, 1.5707, xtol=1e-14)

    def determinant(lam: float) -> float:
        kappa = lam / (CURVED_MM * math.sqrt(1.0 + NU))
        length = CURVED_MM * (1.0 + transmission)
        mechanics = textbook(*[tube(kappa, length)] * 2)
        return mechanics.given_tip_angles([0.0, math.pi], [CURVED_MM - length] * 2).least_determinant

    assert brentq(determinant, 0.9 * formula, 1.1 * formula, xtol=1e-13) == pytest.approx(formula, abs=1e-9)


def test_rigid_in_torsion_angles_are_those_of_the_base() -> None:
    """A Poisson's ratio near -1 would be rigid; shorter tubes come near that too."""
    short = TubeMechanics(
        [tube(0.02, 4.0, 4.0), tube(0.01, 4.0, 4.0, outer_diameter_mm=1.9, inner_diameter_mm=1.65)]
    )
    found = short.given_base_angles([0.3, 1.5], [0.0, 0.0])
    assert np.abs(found.tip_angles_rad - [0.3, 1.5]).max() < 3e-3
    assert np.abs(found.tip_angles_rad - [0.3, 1.5]).max() > 1e-5, "torsion counts"


def test_the_deployments_closed_form_is_the_special_case() -> None:
    outer = tube(0.0, 640.0, outer_diameter_mm=1.9, inner_diameter_mm=1.65)
    pair = ConcentricTubes(inner=tube(0.025, 680.0), outer=outer)
    for ahead_outer, ahead_inner in ((0.0, 30.0), (20.0, 35.0), (30.0, 55.0), (25.0, 25.0)):
        found = TubeMechanics([pair.inner, pair.outer]).given_base_angles(
            [0.4, -1.0], [ahead_inner - 680.0, ahead_outer - 640.0]
        )
        s = np.linspace(0.0, ahead_inner, 23)
        # A tube whose material is not turned bends towards -y, a deployment not turned towards +x.
        shape = centreline(pair, np.eye(4), 0.4 - 0.5 * math.pi, ahead_outer, ahead_inner, s)
        assert np.allclose(found.backbone(s), shape, atol=1e-9)
        assert found.least_determinant == 1.0


def test_pieces_and_planes() -> None:
    """Two pieces of one direction are one arc; a piece turned by 90 degrees bends aside of the first."""
    one = textbook(tube(0.01, 100.0, 40.0)).given_tip_angles([0.2], [-50.0])
    pieces = [
        BentPiece(length_mm=15.0, precurvature_per_mm=0.01),
        BentPiece(length_mm=25.0, precurvature_per_mm=0.01),
    ]
    two = textbook(tube(0.0, bent_pieces=pieces)).given_tip_angles([0.2], [-50.0])
    assert np.allclose(one.base_from_tip, two.base_from_tip, atol=1e-12)
    turned = [pieces[0], BentPiece(length_mm=25.0, precurvature_per_mm=0.01, direction_deg=90.0)]
    bent = textbook(tube(0.0, bent_pieces=turned)).given_tip_angles([0.0], [-60.0])
    assert bent.backbone(15.0)[0, 0] == pytest.approx(0.0, abs=1e-12)
    assert bent.base_from_tip[0, 3] == pytest.approx((1.0 - math.cos(0.25)) / 0.01, abs=1e-9)


def test_twisted_tubes_out_of_plane_are_symmetric_in_their_order_of_pieces() -> None:
    """Precurvature turned by an angle along with its tube is the same tube."""
    plain = textbook(tube(0.006), tube(0.005))
    piece = [BentPiece(length_mm=40.0, precurvature_per_mm=0.006, direction_deg=50.0)]
    turned = textbook(tube(0.0, bent_pieces=piece), tube(0.005))
    beta = [-66.0, -66.0]
    one = plain.given_tip_angles([0.3, 1.2], beta)
    two = turned.given_tip_angles([0.3 - math.radians(50.0), 1.2], beta)
    assert np.allclose(one.backbone([10.0, 34.0]), two.backbone([10.0, 34.0]), atol=1e-10)
    assert one.least_determinant == pytest.approx(two.least_determinant, abs=1e-10)


@pytest.mark.parametrize("mechanics", [PAIR, TRIPLE], ids=["two", "three"])
def test_many_snap_free_configurations(mechanics: TubeMechanics) -> None:
    angles, beta = random_joints(mechanics, np.random.default_rng(3), 50_000)
    found = mechanics.batch(angles, beta)
    assert found.converged.all() and found.stable.all()
    assert found.residual_rad.max() < 1e-9
    some = slice(0, 300)
    for alpha, b, tip, pose in zip(
        angles[some], beta[some], found.tip_angles_rad[some], found.base_from_tip[some], strict=True
    ):
        again = mechanics.given_tip_angles(tip, b)
        assert np.allclose(again.base_angles_rad, alpha, atol=1e-9)
        assert np.allclose(again.base_from_tip, pose, atol=1e-9)


@pytest.mark.parametrize("mechanics", [PAIR, TRIPLE], ids=["two", "three"])
def test_default_steps_are_fine_enough(mechanics: TubeMechanics) -> None:
    angles, beta = random_joints(mechanics, np.random.default_rng(4), 500)
    fine = TubeMechanics(mechanics.tubes, step_rad=FINE).batch(angles, beta)
    away = mechanics.batch(angles, beta).base_from_tip[:, :3, 3] - fine.base_from_tip[:, :3, 3]
    assert np.abs(away).max() < 1e-5


@given(turn=st.floats(-6.0, 6.0), seed=st.integers(0, 1000))
def test_turning_all_bases_turns_the_shape(turn: float, seed: int) -> None:
    (base,), (beta,) = random_joints(TRIPLE, np.random.default_rng(seed), 1)
    one, two = TRIPLE.given_base_angles(base, beta), TRIPLE.given_base_angles(base + turn, beta)
    c, s = math.cos(turn), math.sin(turn)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    assert np.allclose(two.base_from_tip[:3, 3], rotation @ one.base_from_tip[:3, 3], atol=1e-9)
    assert np.allclose(two.base_from_tip[:3, 2], rotation @ one.base_from_tip[:3, 2], atol=1e-10)


@given(seed=st.integers(0, 1000))
def test_mirrored_angles_give_the_mirrored_shape(seed: int) -> None:
    """Tubes not turned bend in the plane of y and z: turned by half a turn, x changes sign."""
    (base,), (beta,) = random_joints(TRIPLE, np.random.default_rng(seed), 1)
    one, two = TRIPLE.given_base_angles(base, beta), TRIPLE.given_base_angles(-base, beta)
    s = np.linspace(0.0, one.length_mm, 7)
    assert np.allclose(two.backbone(s), one.backbone(s) * [-1.0, 1.0, 1.0], atol=1e-9)


@given(seed=st.integers(0, 1000))
def test_a_retracted_tube_disappears_continuously(seed: int) -> None:
    rng = np.random.default_rng(seed)
    angles = rng.uniform(-math.pi, math.pi, 2)
    ahead = rng.uniform(5.0, 19.0)
    gone = PAIR.given_base_angles(angles, [ahead - 660.0, -640.0])
    little = PAIR.given_base_angles(angles, [ahead - 660.0, 1e-7 - 640.0])
    alone = TubeMechanics(PAIR.tubes[:1]).given_base_angles(angles[:1], [ahead - 660.0])
    assert np.allclose(gone.base_from_tip, alone.base_from_tip, atol=1e-9)
    assert np.allclose(little.base_from_tip, gone.base_from_tip, atol=1e-6)


def test_nothing_ahead_of_the_front_plate() -> None:
    found = PAIR.given_tip_angles([0.5, 0.0], [-660.0, -640.0])
    assert found.length_mm == 0.0 and found.stable
    assert np.allclose(found.base_from_tip[:3, 3], 0.0)
    assert found.backbone([-3.0, 0.0]).tolist() == [[0.0, 0.0, -3.0], [0.0, 0.0, 0.0]]


def test_along_the_tubes() -> None:
    found = PAIR.given_base_angles([0.0, 2.0], [-610.0, -605.0])
    s = np.array([-600.0, -10.0, 0.0, 20.0, 35.0, 45.0])
    angles, torsion = found.angles(s), found.torsion(s)
    assert np.isnan(angles[:, 1]).tolist() == [False, False, False, False, False, True]
    assert np.allclose(angles[0], found.base_angles_rad + (found.beta_mm + 600.0) * -torsion[0], atol=1e-9)
    assert np.allclose(torsion[0], torsion[2]), "torsion is constant behind the front plate"
    determinants = found.determinant(np.linspace(-610.0, found.length_mm, 60))
    assert determinants[-1] == 1.0 and determinants.min() >= found.least_determinant - 1e-9
    assert np.allclose(found.backbone([found.length_mm])[0], found.base_from_tip[:3, 3], atol=1e-9)
    frames = found.frames(np.linspace(0.0, found.length_mm, 40))
    assert np.allclose(frames[:, :3, :3] @ frames[:, :3, :3].transpose(0, 2, 1), np.eye(3), atol=1e-12)


@pytest.mark.parametrize(
    ("angles", "beta", "message"),
    [
        ([0.0], [-600.0, -600.0], "one for each tube"),
        ([0.0, math.nan], [-600.0, -600.0], "finite"),
        ([0.0, 0.0], [-600.0, 1.0], "ahead of the front plate"),
        ([0.0, 0.0], [-600.0, -641.0], "behind the front plate"),
        ([0.0, 0.0], [-600.0, -610.0], "ahead of the next one"),
        ([0.0, 0.0], [-655.0, -600.0], "ahead of one in it"),
    ],
)
def test_joints_that_cannot_be(angles: list[float], beta: list[float], message: str) -> None:
    for call in (PAIR.given_tip_angles, PAIR.given_base_angles):
        with pytest.raises(SettingsError, match=message):
            call(angles, beta)


def test_tubes_that_do_not_nest() -> None:
    thick = tube(0.0, 640.0, outer_diameter_mm=1.9, inner_diameter_mm=1.5)
    for tubes, message in (
        ([], "no tube"),
        ([tube(0.01), thick], "outer diameter"),
        ([tube(0.01), tube(0.01, 120.0, outer_diameter_mm=1.9, inner_diameter_mm=1.7)], "long"),
    ):
        with pytest.raises(SettingsError, match=message):
            TubeMechanics(tubes)
    with pytest.raises(LungaccessError, match="step"):
        TubeMechanics([tube(0.01)], step_rad=0.0)


def test_same_input_same_bits() -> None:
    angles, beta = random_joints(TRIPLE, np.random.default_rng(6), 50)
    one, two = TRIPLE.batch(angles, beta), TRIPLE.batch(angles, beta)
    assert np.array_equal(one.base_from_tip, two.base_from_tip)
    assert np.array_equal(one.base_from_tip[:7], TRIPLE.batch(angles[:7], beta[:7]).base_from_tip)
