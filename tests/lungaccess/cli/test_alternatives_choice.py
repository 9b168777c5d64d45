"""`alternatives --system auto` takes the first system whose plan the check accepts, and says why."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

import lungaccess as la
from lungaccess.cli.commands.alternatives import _of_the_least_invasive
from lungaccess.planning import Alternative
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import System

SYSTEMS = la.presets_by_invasiveness()


def searched(toy_plan: Plan, monkeypatch: pytest.MonkeyPatch, accepted: set[str]) -> tuple[Alternative, ...]:
    """Search with all presets: the first has no plan, the check accepts those of some others."""

    class Checker:
        def __init__(self, _lung: Any) -> None:
            pass

        def check(self, _plan: Plan, system: System) -> Any:
            refusals = [SimpleNamespace(name="needle.clearance.vessel")]
            return SimpleNamespace(accepted=system.name in accepted, refusals=refusals)

    def search(system: System) -> tuple[Alternative, ...]:
        if system is SYSTEMS[0]:
            raise la.NoPlan("No", reasons={}, main_reason="too far")
        made = replace(toy_plan, method=system.name)
        return (Alternative(plan=made, criteria={}, on_front=True),) * 2

    monkeypatch.setattr("lungaccess.judging.checking.Checker", Checker, raising=False)
    return _of_the_least_invasive(None, SYSTEMS, search)  # type: ignore[arg-type]


def test_a_refused_plan_is_passed_over(toy_plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    found = searched(toy_plan, monkeypatch, {each.name for each in SYSTEMS[2:]})
    assert [each.plan.method for each in found] == [SYSTEMS[2].name] * 2
    choice = found[0].plan.system_choice
    assert choice[0] == f"{SYSTEMS[0].name}: no plan: too far."
    assert "refuses the plan: needle.clearance.vessel" in choice[1]
    assert choice[2].startswith(f"{SYSTEMS[2].name} was chosen") and SYSTEMS[3].name in choice[2]


def test_where_none_is_accepted_there_is_no_plan(toy_plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(la.NoPlan) as caught:
        searched(toy_plan, monkeypatch, set())
    assert list(caught.value.attempts) == [each.name for each in SYSTEMS]
