"""Settings refuse every wrong value with an error that names key, value and what is allowed."""

from __future__ import annotations

import dataclasses
import json
import math
import pickle
from typing import Annotated

import pytest
from hypothesis import given
from hypothesis import strategies as st

from anatomy.base.errors import SettingsError
from anatomy.base.settings import impossible, override, parse, quantity, settings, switch, text, to_mapping
from anatomy.margins import Margins


@settings
class Wheel:
    diameter_mm: Annotated[float, quantity("outer diameter", above=0.0, at_most=100.0)]
    hub_mm: Annotated[float, quantity("diameter of the hub", at_least=0.0, below=50.0)] = 1.0

    def __post_init__(self) -> None:
        if self.hub_mm >= self.diameter_mm:
            raise impossible("hub_mm", self.hub_mm, f"less than diameter_mm = {self.diameter_mm:g}")


@settings
class Cart:
    name: Annotated[str, text("what people call it")]
    wheel: Wheel
    sources: tuple[str, ...] = ()
    braked: Annotated[bool, switch("whether it has a brake")] = False
    offsets_mm: tuple[Annotated[float, quantity("offset of a wheel", at_least=-5.0, at_most=5.0)], ...] = ()


CART = {"name": "a", "wheel": {"diameter_mm": 10}, "sources": ["x", "y"]}


def test_plain_values_become_typed_ones() -> None:
    cart = parse(Cart, CART, "cart.toml")
    assert cart == Cart(name="a", wheel=Wheel(diameter_mm=10.0, hub_mm=1.0), sources=("x", "y"))
    assert isinstance(cart.wheel.diameter_mm, float)
    assert hash(cart) == hash(parse(Cart, CART, ""))


@pytest.mark.parametrize(
    ("path", "value", "found", "allowed"),
    [
        ("wheel.diameter_mm", math.nan, "wheel.diameter_mm = nan", "a finite number above 0 and at most 100"),
        ("wheel.diameter_mm", math.inf, "wheel.diameter_mm = inf", "a finite number above 0 and at most 100"),
        ("wheel.diameter_mm", -1.0, "wheel.diameter_mm = -1.0", "a finite number above 0 and at most 100"),
        ("wheel.diameter_mm", 0, "wheel.diameter_mm = 0", "above 0"),
        ("wheel.diameter_mm", 101.0, "wheel.diameter_mm = 101.0", "at most 100 (outer diameter)"),
        ("wheel.diameter_mm", "10", "wheel.diameter_mm = '10'", "a finite number"),
        ("wheel.diameter_mm", True, "wheel.diameter_mm = True", "a finite number"),
        ("wheel.hub_mm", 50.0, "wheel.hub_mm = 50.0", "at least 0 and below 50"),
        ("offsets_mm", [0, 9], "offsets_mm.1 = 9", "a finite number at least -5 and at most 5 (offset"),
        ("offsets_mm", 9, "offsets_mm = 9", "a list"),
        ("wheel.hub_mm", 10.0, "wheel.hub_mm = 10.0", "less than diameter_mm = 10"),
        ("wheel.diametr_mm", 1.0, "wheel.diametr_mm is not a setting", "did you mean diameter_mm?"),
        ("colour", "red", "colour is not a setting", "one of name, wheel, sources, braked"),
        ("wheel", 3, "wheel = 3", "a table"),
        ("name", "", "name = ''", "a text that is not empty (what people call it)"),
        ("name", 3, "name = 3", "a text"),
        ("sources", "x", "sources = 'x'", "a list of texts"),
        ("sources", [1], "sources.0 = 1", "a list of texts"),
        ("braked", 1, "braked = 1", "true or false"),
    ],
)
def test_wrong_values_are_refused(path: str, value: object, found: str, allowed: str) -> None:
    with pytest.raises(SettingsError) as caught:
        override(parse(Cart, CART, ""), {path: value}, "cart.toml")
    assert caught.value.found.startswith("cart.toml: ")
    assert found in caught.value.found
    assert allowed in caught.value.expected


def test_every_fault_is_reported_at_once() -> None:
    with pytest.raises(SettingsError) as caught:
        parse(Cart, {"wheel": {"diameter_mm": -1, "hub_mm": math.nan}}, "cart.toml")
    for path in ("name is missing", "wheel.diameter_mm = -1", "wheel.hub_mm = nan"):
        assert path in caught.value.found


def test_constructor_and_replace_check_too() -> None:
    with pytest.raises(SettingsError, match=r"Wheel: diameter_mm = -1\.0"):
        Wheel(diameter_mm=-1.0)
    with pytest.raises(SettingsError, match="hub_mm = 20"):
        dataclasses.replace(Wheel(diameter_mm=10.0), hub_mm=20.0)
    with pytest.raises(SettingsError, match="diameter_mm is missing"):
        Wheel()  # type: ignore[call-arg]


def test_settings_cannot_be_changed() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        Wheel(diameter_mm=10.0).hub_mm = 2.0  # type: ignore[misc]


@pytest.mark.parametrize("path", ["name.first", "wheel.diameter_mm.x"])
def test_override_refuses_a_path_through_a_value(path: str) -> None:
    with pytest.raises(SettingsError, match="is not a setting"):
        override(parse(Cart, CART, ""), {path: 1.0})


def test_override_checks_changes_together() -> None:
    wheel = Wheel(diameter_mm=10.0, hub_mm=9.0)
    assert override(wheel, {"diameter_mm": 5.0, "hub_mm": 4.0}) == Wheel(diameter_mm=5.0, hub_mm=4.0)
    assert wheel.diameter_mm == 10.0


@given(
    name=st.text(min_size=1),
    diameter=st.floats(1.5, 100.0),
    hub=st.sampled_from((-0.0, 0.0)) | st.floats(1e-15, 1.4),
    sources=st.lists(st.text()),
    braked=st.booleans(),
)
def test_settings_survive_json_and_pickle(
    name: str, diameter: float, hub: float, sources: list[str], braked: bool
) -> None:
    wheel = Wheel(diameter_mm=diameter, hub_mm=hub)
    cart = Cart(name=name, wheel=wheel, sources=tuple(sources), braked=braked)
    assert parse(Cart, json.loads(json.dumps(to_mapping(cart), allow_nan=False)), "") == cart
    assert pickle.loads(pickle.dumps(cart)) == cart


def test_equal_settings_are_written_alike() -> None:
    minus, plus = Wheel(diameter_mm=2.0, hub_mm=-0.0), Wheel(diameter_mm=2.0, hub_mm=0.0)
    assert minus == plus
    assert json.dumps(to_mapping(minus)) == json.dumps(to_mapping(plus))


def test_margins_add_up() -> None:
    assert Margins().total_mm == 0.5
    assert Margins(segmentation_margin_mm=0.25, registration_margin_mm=1.0).total_mm == 1.25
    with pytest.raises(SettingsError, match="registration_margin_mm = -0.1"):
        Margins(registration_margin_mm=-0.1)


@pytest.mark.parametrize("value", [5e-324, -1e-300, 1e308, float("nan"), float("inf")])
def test_no_number_is_without_bounds(value):
    @settings
    class Open:
        size: Annotated[float, quantity("size")]

    with pytest.raises(SettingsError, match="size"):
        Open(size=value)
    assert Open(size=0.0).size == 0.0


def test_a_long_value_is_shown_in_short():
    with pytest.raises(SettingsError) as caught:
        parse(Wheel, {"diameter_mm": [1.0] * 200_000}, "a.toml")
    assert len(str(caught.value)) < 1000
