"""Objectives: their weights, the maps they refuse, and the least cost of a mm."""

from __future__ import annotations

import math
from dataclasses import fields

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anatomy.base.errors import SettingsError
from anatomy.base.typed import Float32
from anatomy.grid import Volume
from anatomy.structures import VESSEL
from stages.needle.device import Needle
from stages.needle.environment import NeedleEnvironment, environment_of_labels
from stages.needle.kernels import cost as kernel
from stages.needle.objective import DEFAULT, NO_MAP, SHORTEST, TERMS, Objective, Term
from tests.stages.scenes import Canvas

NAMES = [field.name for field in fields(Objective)]


def a_map(low: float = 0.25) -> Float32:
    values = np.random.default_rng(0).uniform(low, 1.0, (30, 30, 30)).astype(np.float32, order="F")
    values[0, 0, 0] = low
    return np.asfortranarray(values)


@pytest.fixture(scope="module")
def environment() -> NeedleEnvironment:
    canvas = Canvas.empty([-15] * 3, [15] * 3, 1.0)
    canvas.add(canvas.ball([6, 0, 0], 2.0), VESSEL)
    return environment_of_labels(
        canvas.labels,
        canvas.grid,
        Needle(diameter_mm=1.0, max_curvature_per_mm=0.05),
        required_clearance_mm=0.5,
        cost_map=Volume(grid=canvas.grid, array=a_map()),
    )


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("weight", [-1e-9, math.nan, math.inf])
def test_a_weight_is_a_finite_number_of_0_or_more(name: str, weight: float) -> None:
    with pytest.raises(SettingsError, match="weights of an objective"):
        Objective(**{name: weight, "length" if name != "length" else "cost_map": 1.0})


def test_an_objective_weighs_something() -> None:
    with pytest.raises(SettingsError, match="one of them more than 0"):
        Objective()


@pytest.mark.parametrize("term", TERMS, ids=lambda term: term.key)
def test_a_single_cost_is_named_by_its_key(term: Term) -> None:
    for name in (term.key, term.option, term.weight, f"{term.option} = 1"):
        objective = Objective.of(name)
        assert objective == Objective(**{term.weight: 1.0})
        assert str(objective) == term.key
        assert objective.words == term.words_with_unit


def test_the_default_weighs_clearance_and_map() -> None:
    assert str(Objective.of(DEFAULT)) == "inverse_clearance=1,cost_map=1"
    assert str(Objective.of(DEFAULT).without_map) == "inverse_clearance"


def test_every_weight_has_a_cost() -> None:
    assert sorted(term.weight for term in TERMS) == sorted(NAMES)


def test_a_sum_is_written_with_its_weights() -> None:
    objective = Objective.of("length=1,cost-map=0.5")
    assert objective == Objective(length=1.0, cost_map=0.5)
    assert str(objective) == "cost_map=0.5,length_mm=1"
    assert objective.words == "0.5 x cost map along the path + length of the path"
    assert Objective.of(objective) is objective


@given(
    st.lists(
        st.just(0.0) | st.floats(0.0, 1e9, allow_subnormal=False), min_size=len(NAMES), max_size=len(NAMES)
    ).filter(any)
)
def test_a_text_restores_every_weight(weights: list[float]) -> None:
    objective = Objective(**dict(zip(NAMES, weights, strict=True)))
    assert Objective.of(str(objective)) == objective


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("lenght", "Did you mean 'length'"),
        ("beauty", "a weighted sum such as length=1,cost-map=0.5"),
        ("", "There is no objective ''"),
        ("length=1,,cost-map=1", "There is no objective ''"),
        ("length,length_mm=2", "names length_mm twice"),
        ("length=much", "'much' in the objective 'length=much' is not a number"),
        ("length=", "is not a number"),
        ("length=-1", "weights of 0 or more"),
        ("length=inf", "weights of 0 or more"),
        ("length=0", "one of them more than 0"),
    ],
)
def test_a_wrong_text_is_explained(text: str, said: str) -> None:
    with pytest.raises(SettingsError) as caught:
        Objective.of(text)
    assert said in str(caught.value)


def test_the_total_is_the_weighted_sum() -> None:
    costs = {"inverse_clearance": 2.0, "cost_map": math.inf, "voxel_sum": 7.0, "length_mm": 30.0}
    assert Objective(inverse_clearance=3.0, length=0.5).total(costs) == 21.0
    assert Objective(cost_map=1.0).total(costs) == math.inf
    stated = Objective(inverse_clearance=3.0, length=0.5).stated(costs)
    assert stated == {**costs, "inverse_clearance=3,length_mm=0.5": 21.0}
    assert SHORTEST.stated(costs) == costs


def test_without_a_map_only_the_other_costs_are_weighed() -> None:
    assert Objective(cost_map=1.0, voxel_sum=2.0).without_map == SHORTEST
    assert Objective(cost_map=1.0, length=2.0).without_map == Objective(length=2.0)


@pytest.mark.parametrize("name", ["cost_map", "voxel_sum"])
def test_what_weighs_a_map_needs_one(name: str) -> None:
    objective = Objective(**{name: 1.0})
    assert objective.weighs_map
    with pytest.raises(SettingsError, match="has none"):
        objective.arrays(None, 1.0)


@pytest.mark.parametrize("name", ["cost_map", "voxel_sum"])
@pytest.mark.parametrize("wrong", [-0.5, math.nan, -math.inf])
def test_costs_are_not_negative(name: str, wrong: float) -> None:
    values = a_map()
    values[3, 4, 5] = wrong
    with pytest.raises(SettingsError, match="least cost of the cost map"):
        Objective(**{name: 1.0}).arrays(values, 1.0)
    SHORTEST.arrays(values, 1.0)


def test_a_map_of_obstacles_alone_is_refused() -> None:
    with pytest.raises(SettingsError, match="some of them finite"):
        Objective(cost_map=1.0).arrays(np.full((3, 3, 3), math.inf, dtype=np.float32), 1.0)


def test_the_kernels_see_one_type_of_map() -> None:
    """Else they would be compiled twice."""
    given_map = Objective(cost_map=1.0).arrays(a_map(), 1.0).cost_map
    none = SHORTEST.arrays(None, 1.0).cost_map
    not_looked_at = SHORTEST.arrays(a_map(), 1.0).cost_map
    assert numba.typeof(given_map) == numba.typeof(none) == numba.typeof(not_looked_at)
    assert none is NO_MAP and not_looked_at is NO_MAP
    converted = Objective(voxel_sum=1.0).arrays(a_map().astype(np.float64, order="C"), 1.0).cost_map
    assert numba.typeof(converted) == numba.typeof(NO_MAP) and np.array_equal(converted, a_map())


def test_the_least_cost_of_a_mm() -> None:
    def least(objective: Objective) -> float:
        return objective.arrays(a_map(0.25), 1.0).least_rate

    assert least(Objective(length=2.0)) == 2.0
    assert least(Objective(cost_map=3.0)) == pytest.approx(0.75)
    assert least(Objective(inverse_clearance=1.0)) == pytest.approx(1 / 256)
    assert least(Objective(voxel_sum=1.0)) == 0.0
    assert least(Objective(length=2.0, cost_map=3.0, voxel_sum=5.0)) == pytest.approx(2.75)


WEIGHTS = st.tuples(*[st.sampled_from([0.0, 0.3, 1.0, 7.0])] * len(NAMES)).filter(any)
PLACES = st.tuples(*[st.floats(-9.0, 9.0)] * 3)


@given(weights=WEIGHTS, place=PLACES, angle=st.floats(0, math.pi), length=st.floats(1e-6, 30.0),
       curvature=st.floats(0, 0.2), first=st.booleans())  # fmt: skip
@settings(max_examples=300)
def test_no_arc_costs_less(
    environment: NeedleEnvironment,
    weights: tuple[float, ...],
    place: tuple[float, ...],
    angle: float,
    length: float,
    curvature: float,
    first: bool,
) -> None:
    """Of whatever length, however many voxels it enters."""
    objective = environment.objective_arrays(Objective(**dict(zip(NAMES, weights, strict=True))))
    pose = (*place, math.cos(angle), 0.0, math.sin(angle))
    bend = (curvature, 0.0, 1.0, 0.0)
    cost = kernel.cost_of_arc(environment.obstacles, objective, 0.5, pose, bend, length, first)
    assert cost >= objective.least_rate * length * (1.0 - 1e-12)


def test_weights_add_up(environment: NeedleEnvironment) -> None:
    pose, bend = (1.0, -3.0, -9.0, 0.0, 0.0, 1.0), (0.03, 0.6, 0.8, 0.0)

    def cost(**weights: float) -> float:
        arrays = environment.objective_arrays(Objective(**weights))
        return float(kernel.cost_of_arc(environment.obstacles, arrays, 0.5, pose, bend, 17.0, True))

    weights = dict(zip(NAMES, (2.0, 3.0, 5.0, 7.0, 11.0), strict=True))
    assert cost(**weights) == pytest.approx(sum(w * cost(**{name: 1.0}) for name, w in weights.items()))
    assert cost(length=1.0) == 17.0
