"""`alternatives --system auto` takes the first system whose plan the check accepts, and says why."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import lungaccess as la
from anatomy.lung import Lung
from lungaccess.judging import answer_with_several, answering
from lungaccess.planning import Alternative
from lungaccess.plans.plan import Plan
from lungaccess.problem.request import Request
from lungaccess.problem.system import System
from lungaccess.problem.target import Target

SYSTEMS = la.presets_by_invasiveness()


@pytest.fixture
def searched(toy_lung: Lung, toy_plan: Plan, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Search with all presets: the first has no plan, the check accepts those of some others."""

    def search(request: Request, **_: Any) -> tuple[Alternative, ...]:
        if request.system == SYSTEMS[0]:
            raise la.NoPlan("No", reasons={}, main_reason="too far")
        made = replace(toy_plan, method=request.system.name)
        return (Alternative(plan=made, criteria={}, on_front=True),) * 2

    def with_accepted(accepted: set[str]) -> tuple[Alternative, ...]:
        class Checker:
            def __init__(self, _lung: Any) -> None:
                pass

            def check(self, _plan: Plan, system: System) -> Any:
                refusals = [SimpleNamespace(name="needle.clearance.vessel")]
                return SimpleNamespace(accepted=system.name in accepted, refusals=refusals)

        monkeypatch.setattr(answering, "Checker", Checker)
        monkeypatch.setattr(answering, "find_alternatives", search)
        target = Target(lps_mm=np.zeros(3), origin="point")
        return answer_with_several(Request.of(toy_lung, "auto", target, goal="length"))

    return with_accepted


def test_a_refused_plan_is_passed_over(searched: Any) -> None:
    found = searched({each.name for each in SYSTEMS[2:]})
    assert [each.plan.method for each in found] == [SYSTEMS[2].name] * 2
    choice = found[0].plan.system_choice
    assert choice[0] == f"{SYSTEMS[0].name}: no plan: too far."
    assert "refuses the plan: needle.clearance.vessel" in choice[1]
    assert choice[2].startswith(f"{SYSTEMS[2].name} was chosen") and SYSTEMS[3].name in choice[2]


def test_where_none_is_accepted_there_is_no_plan(searched: Any) -> None:
    with pytest.raises(la.NoPlan) as caught:
        searched(set())
    assert list(caught.value.attempts) == [each.name for each in SYSTEMS]
