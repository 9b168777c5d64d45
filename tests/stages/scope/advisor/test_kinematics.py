"""The chain against a product of exponentials, CasADi and Algorithm 1 as printed."""

from __future__ import annotations

import math

import casadi
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from anatomy.base.errors import SettingsError
from stages.scope.advisor.kinematics import (
    ScopeModel,
    ScopeState,
    advanced,
    joints,
    model_of,
    tip_frames,
    tool_frames,
)
from stages.scope.device import Bronchoscope

MODELS = st.builds(ScopeModel, links=st.integers(2, 40), link_mm=st.floats(0.2, 5.0), radius_mm=st.just(1.0))
TWISTS = st.floats(-math.pi, math.pi)
BENDS = st.floats(-2.2, 2.2)
DISTANCES = st.floats(-10.0, 10.0)


def some_base(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    frame = np.eye(4)
    frame[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    frame[:3, 3] = rng.uniform(-100, 100, 3)
    return frame


def exponential(
    axis: tuple[float, float, float], point: tuple[float, float, float], angle: float
) -> np.ndarray:
    """Return the rotation about an axis through a point, as the exponential of its twist."""
    w, q = np.array(axis), np.array(point)
    generator = np.zeros((4, 4))
    generator[:3, :3] = [[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]]
    generator[:3, 3] = -np.cross(w, q)
    return expm(generator * angle)


def algorithm_1(
    model: ScopeModel, base: np.ndarray, distance: float, alpha: float, beta: float
) -> np.ndarray:
    """Lines 1 to 7 as printed, matrix by matrix."""
    xi = beta / model.links
    d = model.link_mm * math.cos(xi / 2) / (2 * math.sin(xi / 2))
    delta = distance / d

    def about_x(angle: float) -> np.ndarray:
        out = np.eye(4)
        out[1:3, 1:3] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
        return out

    t_alpha = np.eye(4)
    t_alpha[:2, :2] = [[math.cos(alpha), -math.sin(alpha)], [math.sin(alpha), math.cos(alpha)]]
    t_c = about_x(xi)
    t_c[:3, 3] = 0.0, d, -model.link_mm / 2
    return base @ t_alpha @ t_c @ about_x(delta) @ np.linalg.inv(t_c) @ np.linalg.inv(t_alpha)


@given(model=MODELS, alpha=TWISTS, beta=BENDS)
def test_the_chain_is_a_product_of_exponentials(model: ScopeModel, alpha: float, beta: float) -> None:
    """The straight scope along -z, its twist about z, joint i about x at -i l."""
    product = exponential((0, 0, 1), (0, 0, 0), alpha)
    for i in range(1, model.links + 1):
        product = product @ exponential((1, 0, 0), (0, 0, -i * model.link_mm), beta / model.links)
    home = np.eye(4)
    home[2, 3] = -model.length_mm
    state = ScopeState(lps_from_base=np.eye(4), twist_rad=alpha, bend_rad=beta)
    np.testing.assert_allclose(tool_frames(model, state.array)[0], product @ home, atol=1e-9)


@given(
    model=MODELS,
    seed=st.integers(0, 999),
    distance=DISTANCES,
    alpha=TWISTS,
    beta=BENDS.filter(lambda b: abs(b) > 1e-3),
)
def test_the_base_moves_by_algorithm_1_as_printed(
    model: ScopeModel, seed: int, distance: float, alpha: float, beta: float
) -> None:
    base = some_base(seed)
    moved = advanced(model, ScopeState(lps_from_base=base), distance, alpha, beta)
    np.testing.assert_allclose(
        moved.lps_from_base, algorithm_1(model, base, distance, alpha, beta), atol=1e-8
    )
    assert (moved.twist_rad, moved.bend_rad) == (alpha, beta)


@given(model=MODELS, distance=DISTANCES, alpha=TWISTS, beta=BENDS.filter(lambda b: abs(b) > 1e-3))
def test_middle_and_base_of_the_base_link_move_on_circles_of_their_own(
    model: ScopeModel, distance: float, alpha: float, beta: float
) -> None:
    """The middle on that of radius d, by the distance; the base on (l / 2) / sin(xi / 2)."""
    xi = beta / model.links
    d = 0.5 * model.link_mm / math.tan(abs(xi) / 2)
    moved = advanced(model, ScopeState(lps_from_base=np.eye(4)), distance, alpha, beta).lps_from_base
    towards = math.copysign(1.0, beta) * np.array([-math.sin(alpha), math.cos(alpha), 0.0])
    middle = np.array([0.0, 0.0, -0.5 * model.link_mm])
    centre = middle + d * towards
    after = moved[:3, :3] @ middle + moved[:3, 3]
    assert np.linalg.norm(after - centre) == pytest.approx(d, rel=1e-9)
    assert np.linalg.norm(after - middle) == pytest.approx(
        2 * d * abs(math.sin(distance / (2 * d))), abs=1e-9
    )
    radius = 0.5 * model.link_mm / math.sin(abs(xi) / 2)
    assert np.linalg.norm(moved[:3, 3] - centre) == pytest.approx(radius, rel=1e-9)


@given(model=MODELS, seed=st.integers(0, 999), distance=DISTANCES, alpha=TWISTS)
def test_small_bends_tend_to_the_straight_motion(
    model: ScopeModel, seed: int, distance: float, alpha: float
) -> None:
    state = ScopeState(lps_from_base=some_base(seed))
    straight = advanced(model, state, distance, alpha, 0.0).lps_from_base
    expected = state.lps_from_base.copy()
    expected[:3, 3] -= distance * expected[:3, 2]
    np.testing.assert_allclose(straight, expected, atol=1e-12)
    for beta in (1e-2, -1e-4, 1e-6, 1e-9, -1e-13):
        bent = advanced(model, state, distance, alpha, beta).lps_from_base
        kappa = abs(beta) / model.length_mm
        allowed = kappa * (distance * distance + abs(distance) * (2.0 + model.link_mm)) + 1e-12
        assert np.abs(bent - straight).max() <= allowed


@given(model=MODELS, seed=st.integers(0, 999), alpha=TWISTS, beta=BENDS.filter(lambda b: abs(b) > 1e-2))
def test_the_links_follow_each_other(model: ScopeModel, seed: int, alpha: float, beta: float) -> None:
    """Advanced by the length of a link on its circle, every joint is where the next one was."""
    xi = abs(beta) / model.links
    distance = xi * 0.5 * model.link_mm / math.tan(xi / 2)
    start = ScopeState(lps_from_base=some_base(seed), twist_rad=alpha, bend_rad=beta)
    before = joints(model, start.array)[0]
    after = joints(model, advanced(model, start, distance, alpha, beta).array)[0]
    np.testing.assert_allclose(after[:-1], before[1:], atol=1e-8)


@given(model=MODELS, seed=st.integers(0, 999), distance=DISTANCES, alpha=TWISTS, beta=BENDS)
def test_pulling_back_undoes_an_advance(
    model: ScopeModel, seed: int, distance: float, alpha: float, beta: float
) -> None:
    start = ScopeState(lps_from_base=some_base(seed), twist_rad=alpha, bend_rad=beta)
    there = advanced(model, start, distance, alpha, beta)
    np.testing.assert_allclose(advanced(model, there, -distance, alpha, beta).array, start.array, atol=1e-9)


def symbolic_tool(model: ScopeModel) -> casadi.Function:
    """Return the tool after Algorithm 1, its rotation and position, of (distance, alpha, beta)."""
    distance, alpha, beta = casadi.SX.sym("distance"), casadi.SX.sym("alpha"), casadi.SX.sym("beta")

    def turn(axis: str, angle: casadi.SX) -> casadi.SX:
        c, s = casadi.cos(angle), casadi.sin(angle)
        out = casadi.SX.eye(4)
        a, b = (1, 2) if axis == "x" else (0, 1)
        out[a, a], out[a, b], out[b, a], out[b, b] = c, -s, s, c
        return out

    def shift(y: casadi.SX, z: casadi.SX) -> casadi.SX:
        out = casadi.SX.eye(4)
        out[1, 3], out[2, 3] = y, z
        return out

    xi = beta / model.links
    d = 0.5 * model.link_mm / casadi.tan(0.5 * xi)
    middle = -0.5 * model.link_mm
    frame = (
        turn("z", alpha) @ shift(d, middle) @ turn("x", distance / d) @ shift(-d, 0.0) @ shift(0.0, -middle)
    )
    for _ in range(model.links):
        frame = frame @ shift(0.0, -model.link_mm) @ turn("x", xi)
    flat = casadi.vertcat(casadi.vec(frame[:3, :3]), frame[:3, 3])
    inputs = casadi.vertcat(distance, alpha, beta)
    return casadi.Function("tool", [inputs], [flat, casadi.jacobian(flat, inputs)])


def numbers_of(model: ScopeModel, values: np.ndarray) -> np.ndarray:
    state = advanced(model, ScopeState(lps_from_base=np.eye(4)), *values)
    frame = tool_frames(model, state.array)[0]
    return np.concatenate([frame[:3, :3].T.ravel(), frame[:3, 3]])


@pytest.mark.parametrize("seed", range(12))
def test_kinematics_and_derivative_agree_with_casadi(seed: int) -> None:
    """The derivative by differences of eighth order, whose error is far below 1e-9."""
    rng = np.random.default_rng(seed)
    model = ScopeModel(links=int(rng.integers(3, 25)), link_mm=float(rng.uniform(0.4, 2.0)))
    values = np.array(
        [rng.uniform(-5, 5), rng.uniform(-1.5, 1.5), rng.choice([-1, 1]) * rng.uniform(0.2, 2.0)]
    )
    flat, jacobian = symbolic_tool(model)(values)
    np.testing.assert_allclose(numbers_of(model, values), np.array(flat).ravel(), atol=1e-9)
    weights, h = (4 / 5, -1 / 5, 4 / 105, -1 / 280), 5e-3
    for column in range(3):
        step = h * np.eye(3)[column]
        slope = sum(
            w * (numbers_of(model, values + n * step) - numbers_of(model, values - n * step))
            for n, w in enumerate(weights, start=1)
        )
        np.testing.assert_allclose(slope / h, np.array(jacobian)[:, column], atol=1e-9)


def test_the_tip_looks_forward_and_the_tool_backward() -> None:
    model = ScopeModel()
    state = ScopeState(lps_from_base=np.eye(4), twist_rad=0.0, bend_rad=math.pi / 2)
    tip = tip_frames(model, state.array)[0]
    np.testing.assert_allclose(tip[:3, 2], [0.0, 1.0, 0.0], atol=1e-12)
    assert np.linalg.det(tip) == pytest.approx(1.0)
    np.testing.assert_allclose(tip[:3, 2], -tool_frames(model, state.array)[0][:3, 2], atol=1e-15)


def scope(up: float = 180.0, down: float = 130.0) -> Bronchoscope:
    return Bronchoscope(
        name="test", outer_diameter_mm=4.0, channel_diameter_mm=2.0, lumen_margin_mm=0.25,
        bend_up_deg=up, bend_down_deg=down, bending_length_mm=15.0,
        min_bending_radius_mm=8.0, min_shaft_radius_mm=10.0, bending_stiffness_n_mm2=1000.0,
    )  # fmt: skip


def test_a_device_bends_no_tighter_than_the_papers_chain() -> None:
    short, long = model_of(scope()), model_of(scope(), links=25)
    assert short.radius_mm == 2.25
    assert (short.bend_low_deg, short.bend_high_deg) == (-120.0, 120.0)
    assert (long.bend_low_deg, long.bend_high_deg) == (-130.0, 180.0)
    assert model_of(scope(up=60.0)).bend_high_deg == 60.0


@pytest.mark.parametrize(
    "wrong", [{"links": 1}, {"links": 0}, {"twist_low_deg": 5.0}, {"bend_high_deg": -1.0}, {"radius_mm": 0.0}]
)
def test_impossible_chains_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(SettingsError):
        ScopeModel(**wrong)  # type: ignore[arg-type]


def test_impossible_motions_are_refused() -> None:
    state = ScopeState(lps_from_base=np.eye(4))
    for distance, twist, bend in ((math.nan, 0.0, 0.0), (1.0, math.inf, 0.0), (1.0, 0.0, 31.5)):
        with pytest.raises(SettingsError, match="cannot move"):
            advanced(ScopeModel(), state, distance, twist, bend)
