"""Goals: names, costs, functions, and those of other packages; how large they are and which way is better."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

import lungaccess as la
from anatomy.base import plugins
from anatomy.base.errors import SettingsError
from anatomy.lung import Lung
from lungaccess.plans.plan import Plan
from lungaccess.problem import goals
from lungaccess.problem.goals import SUCCESS, WINDOW, Goal
from lungaccess.problem.request import goal_of, register_goal
from stages.needle import Objective


def tissue(plan: Plan, _lung: Lung) -> float:
    return plan.tissue_mm


DEEP = Goal(name="deep", words="way in tissue", unit="mm", larger_is_better=True, of=tissue)


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No goal of another test, and no entry point of another package that was looked up before."""
    for known in list(goals.REGISTERED):
        monkeypatch.delitem(goals.REGISTERED, known)
    plugins.registered.cache_clear()
    yield
    plugins.registered.cache_clear()


def registering(monkeypatch: pytest.MonkeyPatch, group: str, **found: Any) -> None:
    """Let another package register objects by their names; an error is raised when it is imported."""

    def load(what: Any) -> Any:
        if isinstance(what, Exception):
            raise what
        return what

    entries = [
        SimpleNamespace(name=name, value="their.module:it", load=lambda what=what: load(what))
        for name, what in found.items()
    ]
    monkeypatch.setattr(plugins, "entry_points", lambda group: entries if group == asked else [])
    asked = group


class TestNames:
    """What a user may state."""

    def test_those_of_the_package(self) -> None:
        assert goal_of("success") is SUCCESS and goal_of("window") is WINDOW
        assert goal_of(DEEP) is DEEP

    @pytest.mark.parametrize("stated", ["length", "inverse-clearance", "length=1,cost-map=0.5"])
    def test_costs(self, stated: str) -> None:
        goal = goal_of(stated)
        assert goal.objective == Objective.of(stated) == goal_of(Objective.of(stated)).objective
        assert not goal.larger_is_better and not goal.is_function

    def test_the_default_cost_weighs_a_map_only_where_there_is_one(self, small_lung: Lung) -> None:
        named, mapped = goal_of("default", small_lung).objective, replace(small_lung, cost=small_lung.labels)
        assert named is not None and not named.weighs_map
        with_map = goal_of("default", mapped).objective
        assert with_map is not None and with_map.weighs_map

    def test_functions_are_made_small_and_named_as_in_the_code(self) -> None:
        goal = goal_of(tissue)
        assert (goal.name, goal.words, goal.larger_is_better) == ("tissue", "tissue", False)
        assert goal_of(lambda _plan, _lung: 1.0).name == "function"

    def test_an_unknown_one_is_refused_with_what_there_is(self) -> None:
        with pytest.raises(SettingsError, match="success, window") as caught:
            goal_of("sucess")
        assert "Did you mean 'success'" in str(caught.value)


@pytest.mark.usefixtures("alone")
class TestRegistered:
    """Goals of users and of other packages."""

    def test_a_registered_one_is_known_by_its_name(self) -> None:
        assert register_goal(DEEP) is DEEP and goal_of("deep") is DEEP
        other = replace(DEEP, words="other")
        assert register_goal(other) is goal_of("deep") is other

    @pytest.mark.parametrize("name", ["success", "window", "length", "length_mm", "inverse-clearance", "a b"])
    def test_names_that_mean_something_else_are_refused(self, name: str) -> None:
        with pytest.raises(SettingsError, match="cannot be called"):
            register_goal(replace(DEEP, name=name))

    def test_a_package_adds_one_by_an_entry_point(self, monkeypatch: pytest.MonkeyPatch) -> None:
        registering(monkeypatch, goals.PLUGINS, deep=DEEP)
        assert goal_of("deep") is DEEP and plugins.registered("lungaccess.planners") == {}

    def test_one_that_cannot_be_imported_is_named(self, monkeypatch: pytest.MonkeyPatch) -> None:
        registering(monkeypatch, goals.PLUGINS, deep=ImportError("no module named their"))
        with pytest.raises(SettingsError, match=r"'deep'.*no module named their"):
            goal_of("deep")


class TestValues:
    """What plans state of goals."""

    def test_a_plan_without_a_statement(self, toy_plan: Plan) -> None:
        for goal in (SUCCESS, WINDOW, DEEP):
            assert goal.value(toy_plan) is None and goal.loss(toy_plan) == math.inf

    def test_costs_are_those_of_the_plan(self, toy_plan: Plan) -> None:
        goal = goal_of("inverse-clearance")
        assert goal.value(toy_plan) == goal.loss(toy_plan) == toy_plan.costs["inverse_clearance"]

    def test_a_function_is_computed_and_stated(self, toy_plan: Plan, toy_lung: Lung) -> None:
        value = DEEP.computed(toy_plan, toy_lung)
        assert value == toy_plan.tissue_mm
        stated = replace(toy_plan, goals={"deep": value})
        assert DEEP.value(stated) == value and DEEP.loss(stated) == -value
        assert replace(DEEP, larger_is_better=False).loss(stated) == value
        assert DEEP.said(value) == f"{value:.4g} mm"

    @pytest.mark.parametrize("value", [math.nan, math.inf, "much", None])
    def test_what_is_no_finite_number_is_refused(self, value: Any, toy_plan: Plan, toy_lung: Lung) -> None:
        with pytest.raises(SettingsError, match="deep"):
            replace(DEEP, of=lambda _plan, _lung: value).computed(toy_plan, toy_lung)

    def test_a_function_that_fails_is_named(self, toy_plan: Plan, toy_lung: Lung) -> None:
        def fails(_plan: Plan, _lung: Lung) -> float:
            raise KeyError("nothing")

        with pytest.raises(SettingsError, match="'fails' fails: KeyError"):
            goal_of(fails).computed(toy_plan, toy_lung)

    def test_shares_lack_what_is_left(self) -> None:
        half: Any = SimpleNamespace(chance=SimpleNamespace(share=0.5), window=SimpleNamespace(share=0.25))
        assert (SUCCESS.loss(half), WINDOW.loss(half)) == (0.5, 0.75)
        assert SUCCESS.said(0.488) == "48 of 100" and WINDOW.said(0.25) == "25 of 100"


def test_the_public_name_is_the_same() -> None:
    assert la.Goal is Goal and la.register_goal is register_goal
