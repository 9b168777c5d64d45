"""The coupled planner: what decides a run, what ends it, and what it refuses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import lungaccess as la
from anatomy.base.errors import SettingsError, TargetError
from anatomy.lung import Lung
from lungaccess.planning import ProgressEvent, searches
from lungaccess.planning.coupled import DirectArcs
from lungaccess.planning.coupled.search.atlas_search import AtlasSearch
from lungaccess.planning.coupled.search.base import Incumbent, SearchSettings, Step, evaluated_step
from lungaccess.plans.plan import Plan
from lungaccess.problem.target import Target
from lungaccess.problem.task import Task
from tests.lungaccess.planning.coupled.planning import KUNTZ_SEED, KUNTZ_TARGET, SYSTEM, plans_of, same_run
from tests.lungaccess.points import FAR_TARGET
from tests.lungaccess.resample import problems


def test_the_best_of_a_short_search_is_accepted_by_the_check(
    small_lung: Lung, target: Target, atlas: la.Atlas
) -> None:
    best = plans_of(small_lung, target, atlas, iterations=20)[-1]
    assert la.check(best, small_lung).accepted


class TestRepeatability:
    """Iterations, not time, decide."""

    @pytest.mark.parametrize(
        ("method", "iterations"), [("atlas", 150), pytest.param("kuntz2015", 3000, marks=pytest.mark.slow)]
    )
    def test_the_same_seed_gives_the_same_bytes(
        self, small_lung: Lung, atlas: la.Atlas, method: str, iterations: int
    ) -> None:
        target = la.resolve_target(small_lung, KUNTZ_TARGET)
        first, again = (
            plans_of(small_lung, target, atlas, seed=KUNTZ_SEED, method=method, iterations=iterations)
            for _ in range(2)
        )
        assert len(first) >= 2
        assert same_run(first) == same_run(again)
        assert [p.digest for p in first] == [p.digest for p in again]

    @pytest.mark.slow
    def test_the_atlas_made_inside_gives_the_same_plans(
        self, small_lung: Lung, target: Target, atlas: la.Atlas
    ) -> None:
        inside = list(la.plan(small_lung, SYSTEM, target, iterations=20, goal="default"))
        assert same_run(inside) == same_run(plans_of(small_lung, target, atlas, iterations=20))

    def test_more_iterations_continue_the_same_run(
        self, small_lung: Lung, target: Target, atlas: la.Atlas
    ) -> None:
        short, long = (plans_of(small_lung, target, atlas, iterations=n) for n in (40, 160))
        assert same_run(long)[: len(short) - 1] == same_run(short)[:-1], "the last has a simple motion"
        assert long[-1].costs["inverse_clearance"] <= short[-1].costs["inverse_clearance"]
        assert all(plan.iterations <= 40 for plan in short)

    def test_another_seed_refines_differently(
        self, small_lung: Lung, target: Target, atlas: la.Atlas
    ) -> None:
        first, other = (plans_of(small_lung, target, atlas, seed=seed) for seed in (0, 1))
        assert first[-1].digest != other[-1].digest
        direct = [[p for p in plans if p.iterations == 0] for plans in (first, other)]
        assert [p.costs for p in direct[0]] == [p.costs for p in direct[1]]


class TestBudget:
    """What ends a search."""

    def test_no_iterations_leave_the_direct_arcs(
        self, small_lung: Lung, target: Target, atlas: la.Atlas
    ) -> None:
        plans = plans_of(small_lung, target, atlas, iterations=0)
        assert plans and all(plan.iterations == 0 and len(plan.needle.arcs) == 1 for plan in plans)

    def test_no_time_still_gives_the_first_direct_arc(
        self, small_lung: Lung, target: Target, atlas: la.Atlas
    ) -> None:
        plan, _simple = la.plan(small_lung, SYSTEM, target, atlas=atlas, time_s=0.0, goal="default")
        assert plan.iterations == 0
        assert plan.digest == plans_of(small_lung, target, atlas, iterations=0)[0].digest

    def test_time_that_is_over_ends_the_search(
        self, small_lung: Lung, target: Target, atlas: la.Atlas
    ) -> None:
        with pytest.raises(la.NoPlan, match="after 1 iterations"):
            list(
                la.plan(
                    small_lung, SYSTEM, target, atlas=atlas, method="kuntz2015", time_s=0.0, goal="default"
                )
            )

    def test_the_caller_may_stop_at_any_time(self, small_lung: Lung, target: Target, atlas: la.Atlas) -> None:
        plans = la.plan(small_lung, SYSTEM, target, atlas=atlas, goal="default")
        costs = [next(plans).costs["inverse_clearance"] for _ in range(3)]
        plans.close()  # type: ignore[attr-defined]
        assert costs[0] > costs[1] > costs[2]

    def test_tubes_that_are_all_refused_do_not_hold_up_the_search(
        self, small_lung: Lung, target: Target, atlas: la.Atlas, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The atlas has tubes on the edge of a limit that the validation refuses."""
        tried: list[int] = []
        monkeypatch.setattr(DirectArcs, "candidate", lambda _self, entry: tried.append(entry))
        with pytest.raises(la.NoPlan, match="after 0 iterations"):
            plans_of(small_lung, target, atlas, iterations=0)
        assert len(tried) > len(set(tried)) > 1

    @pytest.mark.slow
    def test_a_futile_search_without_budget_ends(self, small_lung: Lung, atlas: la.Atlas) -> None:
        far = la.resolve_target(small_lung, FAR_TARGET)
        with pytest.raises(la.NoPlan, match="outside the needle's workspace"):
            list(la.plan(small_lung, SYSTEM, far, atlas=atlas, goal="default"))

    @pytest.mark.slow
    def test_progress(self, small_lung: Lung, target: Target, atlas: la.Atlas) -> None:
        told: list[ProgressEvent] = []
        list(la.plan(small_lung, SYSTEM, target, time_s=0.6, on_progress=told.append, goal="default"))
        assert {"atlas"} < {event.phase for event in told}
        searching = [event for event in told if event.phase != "atlas"]
        assert [e.elapsed_s for e in searching] == sorted(e.elapsed_s for e in searching)
        assert [e.iteration for e in searching] == sorted(e.iteration for e in searching)
        best = [e.best_cost for e in searching if e.best_cost is not None]
        assert best == sorted(best, reverse=True) and best


@pytest.fixture(scope="module")
def kuntz_plans(small_lung: Lung, atlas: la.Atlas) -> list[Plan]:
    target = la.resolve_target(small_lung, KUNTZ_TARGET)
    return plans_of(small_lung, target, atlas, method="kuntz2015", seed=KUNTZ_SEED, iterations=3000)


class TestKuntz2015:
    """Algorithm 1 of the paper."""

    def test_it_finds_better_and_better_plans(self, kuntz_plans: list[Plan]) -> None:
        assert len(kuntz_plans) >= 2 and all(plan.method == "kuntz2015" for plan in kuntz_plans)
        assert max(len(plan.needle.arcs) for plan in kuntz_plans) >= 2
        costs = [plan.costs["inverse_clearance"] for plan in kuntz_plans]
        assert costs == sorted(costs, reverse=True)

    def test_they_are_valid(self, kuntz_plans: list[Plan], small_lung: Lung) -> None:
        for plan in kuntz_plans:
            report = la.check(plan, small_lung, SYSTEM)
            assert report.accepted, [f.name for f in report.findings if not f.ok]
            assert problems(plan, small_lung) == []


class NearestArcs:
    """A search of a user: the direct arcs of the nearest deployments, one a step."""

    def __init__(self, task: Task, atlas: la.Atlas) -> None:
        self._arcs = DirectArcs(task, atlas)
        self.blocked = self._arcs.evaluator.blocked

    def steps(self) -> Iterator[Step]:
        incumbent = Incumbent()
        for iteration, entry in enumerate(self._arcs.in_workspace.tolist(), start=1):
            candidate = self._arcs.candidate(entry)
            step = evaluated_step(self._arcs.evaluator, "nearest arcs", candidate, iteration)
            yield incumbent.improved(step)


class TestOwnSearch:
    """A search that is added to those of the package."""

    @pytest.mark.slow
    def test_it_becomes_a_method_of_the_planner(
        self, small_lung: Lung, target: Target, atlas: la.Atlas, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setitem(searches._OWN, "nearest", NearestArcs)
        plans = plans_of(small_lung, target, atlas, method="nearest", iterations=200)
        assert plans and {plan.method for plan in plans} == {"nearest"}
        assert all(la.check(plan, small_lung).accepted for plan in plans[-2:])
        with pytest.raises(SettingsError, match="processes"):
            plans_of(small_lung, target, atlas, method="nearest", processes=2)
        far = la.resolve_target(small_lung, FAR_TARGET)
        with pytest.raises(la.NoPlan, match="outside the needle's workspace"):
            plans_of(small_lung, far, atlas, method="nearest")


class TestSearchSettings:
    """Settings of the search over the atlas."""

    def test_other_settings_give_other_plans(
        self, small_lung: Lung, target: Target, atlas: la.Atlas, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        few = SearchSettings(starts=1, rungs=2, samplings=1, needle_searches=0)
        monkeypatch.setitem(searches._OWN, "few", partial(AtlasSearch, settings=few))
        plans = plans_of(small_lung, target, atlas, method="few")
        assert plans[-1].digest != plans_of(small_lung, target, atlas)[-1].digest

    def test_absurd_ones_are_refused(self) -> None:
        for name in ("rungs", "samplings", "starts"):
            with pytest.raises(SettingsError, match=name):
                SearchSettings(**{name: 0})


class TestBadInput:
    """Typed errors, before any work."""

    @pytest.mark.parametrize("option", [{"goal": "speed"}, {"method": "magic"}])
    def test_unknown_words(self, small_lung: Lung, target: Target, option: dict[str, str]) -> None:
        with pytest.raises(SettingsError, match="one of"):
            la.plan(small_lung, SYSTEM, target, **{"goal": "default", **option})

    def test_an_atlas_of_another_device_or_patient(
        self, small_lung: Lung, target: Target, atlas: la.Atlas
    ) -> None:
        other = replace(SYSTEM, name="other", scope=replace(SYSTEM.scope, outer_diameter_mm=2.5))
        with pytest.raises(SettingsError, match="build_atlas"):
            la.plan(small_lung, other, target, atlas=atlas, goal="default")
        with pytest.raises(SettingsError, match="build_atlas"):
            la.plan(replace(small_lung, key="other"), SYSTEM, target, atlas=atlas, goal="default")

    def test_a_target_of_another_patient(self, small_lung: Lung, atlas: la.Atlas) -> None:
        far = Target(lps_mm=np.array([900.0, 0.0, 0.0]), origin="point")
        with pytest.raises(TargetError, match="outside the images"):
            la.plan(small_lung, SYSTEM, far, atlas=atlas, goal="default")


@pytest.mark.slow
class TestProcesses:
    """Several processes at once."""

    def test_same_plans_every_time_and_all_valid(
        self, small_lung: Lung, target: Target, atlas: la.Atlas
    ) -> None:
        one, two = (plans_of(small_lung, target, atlas, processes=2, iterations=200) for _ in range(2))
        assert same_run(one) == same_run(two)
        costs = [plan.costs["inverse_clearance"] for plan in one]
        assert costs == sorted(costs, reverse=True)
        assert la.check(one[-1], small_lung).accepted
        alone = plans_of(small_lung, target, atlas, iterations=0)
        assert costs[-1] <= alone[-1].costs["inverse_clearance"]

    def test_bad_numbers(self, small_lung: Lung, target: Target, atlas: la.Atlas) -> None:
        for options in ({"processes": 0}, {"processes": -2}):
            with pytest.raises(SettingsError, match="processes"):
                plans_of(small_lung, target, atlas, **options)
