"""Planning with several systems: the least invasive that does is chosen, and the plan says why."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from html import escape
from types import SimpleNamespace
from typing import Any

import pytest
from numba.core.compiler_lock import global_compiler_lock

import lungaccess as la
from anatomy.base import kernel_clock
from anatomy.base.errors import SettingsError
from anatomy.lung import Lung
from lungaccess.judging import answer, answering
from lungaccess.judging.checking import Checker
from lungaccess.problem.request import Request
from lungaccess.problem.system import System
from lungaccess.showing.report.html.tables import provenance_section

SYSTEM = replace(la.load_system("ultrathin"), name="does")
SHORT = replace(SYSTEM, name="too short", needle=replace(SYSTEM.needle, max_length_mm=5.0, diameter_mm=0.7))
MORE = replace(SYSTEM, name="more invasive", needle=replace(SYSTEM.needle, diameter_mm=0.85))


@pytest.fixture(scope="module")
def atlas_of(small_atlas: la.Atlas) -> Callable[[System], la.Atlas]:
    """The atlas of all three systems, which differ in their needles alone."""
    return lambda system: replace(small_atlas, system=system)


def planned(
    lung: Lung, systems: list[System], time_s: float | None = None, goal: str = "default", **options: Any
) -> list[la.Plan]:
    asked = Request.of(lung, systems, la.resolve_target(lung), goal=goal, iterations=5, time_s=time_s)
    return list(answer(asked, **options))


def test_the_first_that_does_is_chosen_and_the_plan_says_why(small_lung: Lung, atlas_of: Any) -> None:
    tried: list[System] = []
    found = planned(small_lung, [MORE, SYSTEM, SHORT], atlas_of=atlas_of, on_attempt=tried.append)[-1]
    assert found.system == SYSTEM
    assert tried == [SHORT, SYSTEM]
    assert found.system_choice[0].startswith("too short: no plan: ")
    assert "does was chosen: the least invasive of 3 systems" in found.system_choice[1]
    assert "not tried: more invasive" in found.system_choice[1]
    assert la.check(found, small_lung, SYSTEM).accepted


def test_the_plan_is_that_of_the_system_alone(small_lung: Lung, atlas_of: Any) -> None:
    """Only the words about the choice are added, and they survive in the file."""
    chosen = planned(small_lung, [SHORT, SYSTEM], atlas_of=atlas_of)[-1]
    alone = list(
        la.plan(
            small_lung,
            SYSTEM,
            la.resolve_target(small_lung),
            iterations=5,
            atlas=atlas_of(SYSTEM),
            goal="default",
        )
    )[-1]
    assert replace(chosen, system_choice=()).digest == alone.digest != chosen.digest
    assert la.Plan.from_json(chosen.to_json()).system_choice == chosen.system_choice
    assert "system_choice" not in alone.to_json()
    assert any(name == "choice of the system" for name, _value in chosen.figures())
    page = provenance_section(chosen, small_lung)
    assert all(escape(sentence) in page for sentence in chosen.system_choice)


def test_what_the_check_refuses_is_not_chosen(
    small_lung: Lung, atlas_of: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Strict(Checker):
        def check(self, plan: Any, system: System | None = None, **options: Any) -> Any:
            # A check against other devices than the plan's: it has to refuse.
            return super().check(plan, MORE if plan.system == SYSTEM else system, **options)

    monkeypatch.setattr(answering, "Checker", Strict)
    found = planned(small_lung, [SYSTEM, MORE], atlas_of=atlas_of)[-1]
    assert found.system == MORE
    assert found.system_choice[0].startswith("does: the independent check refuses the plan")


def test_none_does(small_lung: Lung, atlas_of: Any) -> None:
    other = replace(SHORT, name="too short, too")
    with pytest.raises(la.NoPlan) as caught:
        planned(small_lung, [SHORT, other], atlas_of=atlas_of)
    assert list(caught.value.attempts) == ["too short", "too short, too"]
    assert "any of 2 systems" in str(caught.value)
    assert any(reason.startswith("too short, too: needle:") for reason in caught.value.reasons)


def test_systems_of_one_name_are_refused(small_lung: Lung) -> None:
    with pytest.raises(SettingsError, match="same name"):
        planned(small_lung, [SYSTEM, replace(MORE, name="does")])


def test_getting_kernels_takes_nothing_from_the_time_of_the_next_system(
    small_lung: Lung, atlas_of: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, given = {"s": 0.0}, []
    fake = SimpleNamespace(perf_counter=lambda: clock["s"], process_time=lambda: 0.0)
    monkeypatch.setattr(kernel_clock, "time", fake)

    def run(request: Request, **_: Any) -> Iterator[la.Plan]:
        given.append((request.limits.time_s, request.limits.first_plan_s))
        with global_compiler_lock:
            clock["s"] += 1000.0
        clock["s"] += 2.0
        raise la.NoPlan("No", reasons={})
        yield

    monkeypatch.setattr(answering, "run", run)
    with pytest.raises(la.NoPlan):
        planned(small_lung, [SHORT, SYSTEM, MORE], atlas_of=atlas_of, time_s=10.0)
    times, first = zip(*given, strict=True)
    assert times == pytest.approx([10.0, 8.0, 6.0])
    assert first == pytest.approx([10.0 / 3.0, 4.0, 6.0])
