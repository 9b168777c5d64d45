"""The driver: what ends a search, what is yielded of it, and what it tells meanwhile."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lungaccess as la
from anatomy.base.errors import TargetError
from anatomy.lung import Lung
from lungaccess.planning import driver
from lungaccess.planning.driver import ProgressEvent, Turn, drive
from lungaccess.plans.plan import Plan
from lungaccess.problem.request import Request, StatedPlace
from lungaccess.problem.target import Target
from tests.lungaccess.planning.coupled.planning import SYSTEM, TARGET, same_run

FOUND_AT = (0, 3, 6)


class Clock:
    """One second of either clock a look."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, step_s: float = 1.0, cpu_step_s: float = 1.0) -> None:
        wall, cpu = itertools.count(0.0, step_s), itertools.count(0.0, cpu_step_s)
        monkeypatch.setattr(driver, "working_s", lambda: next(wall))
        monkeypatch.setattr(driver, "working_cpu_s", lambda: next(cpu))


class Numbered:
    """A finder without end, which has a better plan in some of its iterations."""

    def __init__(self, plan: Plan, found_at: tuple[int, ...] = FOUND_AT, met_at: int | None = None) -> None:
        self._plan, self._found_at, self._met_at = plan, found_at, met_at
        self.asked: list[int] = []

    def turns(self) -> Iterator[Turn]:
        for iteration in range(1000):
            self.asked.append(iteration)
            make: Callable[[float], Plan] | None = None
            if iteration in self._found_at:
                make = lambda elapsed_s, n=iteration: self.made(n, elapsed_s)  # noqa: E731
            yield Turn(iteration=iteration, phase="counting", make=make)

    def made(self, iteration: int, elapsed_s: float) -> Plan:
        tube = self._plan.tube
        exit_at = replace(tube.exit, point_lps=tube.exit.point_lps + np.array([0.0, 0.0, float(iteration)]))
        return replace(
            self._plan,
            iterations=iteration,
            costs={"inverse_clearance": 10.0 - iteration},
            tube=replace(tube, exit=exit_at),
            timing={"planning_s": elapsed_s},
        )

    def is_met(self, best: Plan, iteration: int) -> bool:
        return self._met_at is not None and iteration >= self._met_at

    def last(self, best: Plan, iteration: int, elapsed_s: float) -> Plan | None:
        return None

    def no_plan(self, iteration: int) -> la.NoPlan:
        return la.NoPlan(f"nothing in {iteration}", reasons={})


@pytest.fixture(scope="module")
def target(small_lung: Lung) -> Target:
    return la.resolve_target(small_lung, TARGET)


@pytest.fixture
def asked(toy_lung: Lung, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Request]:
    """Searches whose best plan has the simplest motion from the start."""
    monkeypatch.setattr(driver, "with_simplest_motion", lambda plan, _lung: plan)

    def of(**options: Any) -> Request:
        target = Target(lps_mm=np.zeros(3), origin="point")
        return Request.of(toy_lung, SYSTEM, target, **{"goal": "inverse-clearance", **options})

    return of


def found(finder: Any, request: Request, told: list[ProgressEvent] | None = None) -> list[int]:
    return [each.iterations for each in drive(finder, request, [].append if told is None else told.append)]


class TestLimits:
    """Each ends a search by itself."""

    def test_iterations(self, toy_plan: Plan, asked: Any) -> None:
        finder = Numbered(toy_plan)
        assert found(finder, asked(iterations=3)) == [0, 3]
        assert finder.asked[-1] == 4

    def test_no_iterations_leave_what_comes_before_them(self, toy_plan: Plan, asked: Any) -> None:
        assert found(Numbered(toy_plan), asked(iterations=0)) == [0]

    @pytest.mark.parametrize("name", ["time_s", "cpu_s"])
    def test_seconds(self, name: str, toy_plan: Plan, asked: Any, monkeypatch: pytest.MonkeyPatch) -> None:
        other = {"time_s": "cpu_step_s", "cpu_s": "step_s"}[name]
        Clock(monkeypatch, **{other: 0.0})
        finder = Numbered(toy_plan)
        assert found(finder, asked(**{name: 4.0})) != list(FOUND_AT)
        assert len(finder.asked) < 7

    def test_seconds_without_a_plan_let_the_first_iteration_be_tried(
        self, toy_plan: Plan, asked: Any, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        Clock(monkeypatch)
        for limits in ({"time_s": 0.0}, {"cpu_s": 0.0}, {"first_plan_s": 0.0}):
            with pytest.raises(la.NoPlan, match="nothing in 1"):
                found(Numbered(toy_plan, ()), asked(**limits))
            assert found(Numbered(toy_plan), asked(**limits, iterations=1)) == [0]

    def test_time_for_the_first_plan_leaves_the_others_theirs(
        self, toy_plan: Plan, asked: Any, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        Clock(monkeypatch)
        assert found(Numbered(toy_plan), asked(time_s=100.0, first_plan_s=1.0)) == list(FOUND_AT)

    def test_what_is_good_enough(self, toy_plan: Plan, asked: Any) -> None:
        finder = Numbered(toy_plan, met_at=4)
        assert found(finder, asked()) == [0, 3] and finder.asked[-1] == 4
        assert found(Numbered(toy_plan, (2,), met_at=0), asked()) == [2]


class TestPlans:
    """What is yielded."""

    def test_only_plans_through_the_stated_place(self, toy_plan: Plan, asked: Any) -> None:
        at = toy_plan.tube.exit.point_lps + np.array([0.0, 0.0, 4.0])
        place = StatedPlace(kind="exit", lps_mm=at, within_mm=2.0)
        assert found(Numbered(toy_plan), asked(place=place, iterations=9)) == [3, 6]

    @pytest.mark.parametrize(
        ("kind", "said"), [("exit", "leaves the airway"), ("scope tip", "its scope tip")]
    )
    def test_where_all_miss_it_that_is_said(self, kind: Any, said: str, toy_plan: Plan, asked: Any) -> None:
        place = StatedPlace(kind=kind, lps_mm=np.full(3, 900.0), within_mm=2.0)
        with pytest.raises(la.NoPlan, match=f"{said} within 2 mm of the stated {kind}"):
            found(Numbered(toy_plan), asked(place=place, iterations=9))

    def test_none_is_explained_by_the_finder(self, toy_plan: Plan, asked: Any) -> None:
        with pytest.raises(la.NoPlan, match="nothing in 7"):
            found(Numbered(toy_plan, ()), asked(iterations=7))

    def test_what_comes_at_the_end(self, toy_plan: Plan, asked: Any, monkeypatch: pytest.MonkeyPatch) -> None:
        finder = Numbered(toy_plan)
        monkeypatch.setattr(finder, "last", lambda best, n, _s: replace(best, iterations=100 * n))
        assert found(finder, asked(iterations=4)) == [0, 3, 400]


def test_progress_is_told_now_and_then_and_never_of_an_unknown_value(
    toy_plan: Plan, asked: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    Clock(monkeypatch, step_s=driver.PROGRESS_EVERY_S / 4.0)
    told: list[ProgressEvent] = []
    found(Numbered(toy_plan, (3,)), asked(iterations=12), told)
    assert 1 < len(told) < 12
    assert [each.elapsed_s for each in told] == sorted(each.elapsed_s for each in told)
    assert {each.best_cost for each in told} == {None, 7.0}
    told.clear()
    found(Numbered(toy_plan), asked(goal="success", iterations=12), told)
    assert told and {each.best_cost for each in told} == {None}


class TestWholeSearches:
    """The same with a real finder."""

    def test_processor_time_that_is_over_leaves_the_first_arc(
        self, small_lung: Lung, small_atlas: la.Atlas, target: Target
    ) -> None:
        only, simple = la.plan(small_lung, SYSTEM, target, goal="default", atlas=small_atlas, cpu_s=0.0)
        first = next(la.plan(small_lung, SYSTEM, target, goal="default", atlas=small_atlas))
        assert only.digest == first.digest and only.iterations == 0
        assert replace(simple, scope=only.scope).digest == only.digest
        assert len(simple.scope.states) < len(only.scope.states)
        assert la.check(simple, small_lung, SYSTEM).accepted

    @pytest.mark.parametrize("kind", ["exit", "scope tip"])
    def test_all_plans_go_through_the_place_and_repeat(
        self, small_lung: Lung, small_atlas: la.Atlas, target: Target, kind: Any
    ) -> None:
        options: dict[str, Any] = {"goal": "default", "atlas": small_atlas, "iterations": 40}
        *_, free = la.plan(small_lung, SYSTEM, target, **options)
        lines = list(la.plan(small_lung, SYSTEM, target, **options))
        at = {"exit": lines[0].tube.exit.point_lps, "scope tip": lines[0].scope.lps_from_scope_tip[:3, 3]}[
            kind
        ]
        place = StatedPlace(kind=kind, lps_mm=at, within_mm=2.0)
        one, again = (list(la.plan(small_lung, SYSTEM, target, place=place, **options)) for _ in range(2))
        assert same_run(one) == same_run(again) and one[-1].cost >= free.cost
        for each in one:
            point = each.tube.exit.point_lps if kind == "exit" else each.scope.lps_from_scope_tip[:3, 3]
            assert np.linalg.norm(point - at) <= 2.0
        assert la.check(one[-1], small_lung, SYSTEM).accepted

    @pytest.mark.parametrize("kind", ["exit", "scope tip"])
    def test_a_place_that_nothing_comes_near(
        self, small_lung: Lung, small_atlas: la.Atlas, target: Target, kind: Any
    ) -> None:
        place = StatedPlace(kind=kind, lps_mm=np.full(3, 900.0), within_mm=2.0)
        with pytest.raises(TargetError, match="within 2 mm"):
            next(la.plan(small_lung, SYSTEM, target, goal="default", atlas=small_atlas, place=place))
