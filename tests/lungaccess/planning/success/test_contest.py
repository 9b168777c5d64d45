"""The contest: its winner is no worse than what takes part to the end, and what is shown becomes better."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import pytest

import lungaccess as la
from anatomy.lung import Lung
from lungaccess.planning.success import finder, ratings
from lungaccess.planning.success.ratings import ChanceRating, Rounds
from lungaccess.plans.plan import Plan
from lungaccess.problem.error_files import load_errors
from lungaccess.problem.goals import Goal
from lungaccess.problem.request import Request
from lungaccess.problem.target import Target
from tests.lungaccess.planning.coupled.planning import KUNTZ_SEED, KUNTZ_TARGET, SYSTEM, TARGET, same_run

ERRORS = load_errors("gated-ct")
RADIUS_MM = 5.0
BY_COST = 30


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Contests with few contenders and few draws."""
    monkeypatch.setattr(finder, "BY_COST", BY_COST)
    rounds = {
        "OPEN_LOOP": Rounds(pool=20, of_a_tip=4, draws=(64, 192, 768), kept=(8, 3), fresh=2000),
        "MEASURED": Rounds(pool=3, of_a_tip=1, draws=(4, 8), kept=(2,), fresh=16),
        "SCREENING": Rounds(pool=6, of_a_tip=2, draws=(64, 128), kept=(4,), fresh=0),
        "EXACT": Rounds(pool=20, of_a_tip=4, draws=(1,), kept=(), fresh=0),
    }
    for name, each in rounds.items():
        monkeypatch.setattr(ratings, name, each)


@pytest.fixture(scope="module")
def target(small_lung: Lung) -> Target:
    return la.resolve_target(small_lung, TARGET)


@pytest.fixture
def asked(small_lung: Lung, small_atlas: la.Atlas, target: Target) -> dict[str, Any]:
    """What most searches are asked; the errors are those of a procedure that corrects nothing."""
    return {
        "lung": small_lung, "system": SYSTEM, "target": target, "atlas": small_atlas, "errors": ERRORS,
        "procedure": la.load_procedure("open-loop"), "radius_mm": RADIUS_MM, "iterations": 6,
    }  # fmt: skip


def gained(plan: Plan, asked: dict[str, Any]) -> float:
    """Return the successes of a plan in the draws of a whole contest."""
    fields = {name: value for name, value in asked.items() if name != "atlas"}
    rating = ChanceRating(Request.of(**fields))
    scorer = rating.scorer(plan)
    return sum(scorer(batch, draws, 1.0) for batch, draws in enumerate(rating.rounds.draws))


def share(plan: Plan) -> float:
    assert plan.chance is not None
    return plan.chance.share


@pytest.mark.slow
class TestChances:
    """Contests by draws in open loop."""

    def test_the_winner_is_no_worse_than_the_first_and_the_cheapest(
        self, asked: dict[str, Any], small_lung: Lung
    ) -> None:
        plans = list(la.plan(**asked))
        *_, cheapest = la.plan(**asked | {"goal": "default", "iterations": BY_COST})
        assert gained(plans[-1], asked) >= max(gained(plans[0], asked), gained(cheapest, asked))
        assert la.check(plans[-1], small_lung, SYSTEM).accepted

    def test_the_first_plan_comes_without_a_chance_and_the_stated_ones_rise(
        self, asked: dict[str, Any]
    ) -> None:
        first, *stated, simple = la.plan(**asked | {"iterations": 40})
        by_cost = next(la.plan(**asked | {"goal": "default"}))
        assert first.chance is None and first.costs == by_cost.costs
        assert stated and all(later > sooner for sooner, later in pairwise(map(share, stated)))
        assert share(simple) == share(stated[-1])
        for each in stated:
            assert each.chance is not None and each.chance.samples == ratings.OPEN_LOOP.fresh
            assert (each.chance.errors, each.chance.procedure) == ("gated-ct", "open-loop")

    def test_the_same_seed_gives_the_same_plans(self, asked: dict[str, Any]) -> None:
        one, again, other = (list(la.plan(**asked | {"seed": seed})) for seed in (3, 3, 4))
        assert same_run(one) == same_run(again) != same_run(other)

    def test_more_iterations_continue_the_same_search(self, asked: dict[str, Any]) -> None:
        short, long = (list(la.plan(**asked | {"iterations": count})) for count in (2, 12))
        assert same_run(long)[: len(short) - 1] == same_run(short)[:-1], "the last has a simple motion"

    def test_a_search_that_ends_at_once_states_what_it_has(self, asked: dict[str, Any]) -> None:
        first, last = la.plan(**asked | {"iterations": None, "time_s": 0.0})
        assert first.tube.rotation_rad == last.tube.rotation_rad
        assert first.chance is None and last.chance is not None

    def test_the_search_ends_where_little_is_left_to_gain(
        self, asked: dict[str, Any], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        challenges: list[finder.Contender] = []

        def noted(self: finder.ContestFinder, best: finder.Contender, other: finder.Contender) -> Any:
            challenges.append(other)
            return beats(self, best, other)

        beats = finder.ContestFinder._beats
        monkeypatch.setattr(finder.ContestFinder, "_beats", noted)
        *_, sure = la.plan(**asked | {"errors": ERRORS.scaled(0.05)})
        assert share(sure) > finder.OFTEN_ENOUGH and not challenges
        *_, unsure = la.plan(**asked)
        assert share(unsure) < finder.OFTEN_ENOUGH and challenges

    def test_where_hardly_a_draw_succeeds_smaller_errors_tell(
        self, asked: dict[str, Any], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        factors: list[float] = []

        def noted(*counted: Any) -> float:
            factors.append(found(*counted))
            return factors[-1]

        found = finder._factor
        monkeypatch.setattr(finder, "_factor", noted)
        list(la.plan(**asked | {"iterations": 0}))
        assert not factors, "ordinary errors stay as they are"
        rare = asked | {"errors": ERRORS.scaled(8.0), "radius_mm": 1.0, "iterations": 0}
        plans = list(la.plan(**rare))
        assert factors and all(0.0 < factor < 1.0 for factor in factors)
        assert share(plans[-1]) < 0.2
        *_, cheapest = la.plan(**asked | {"goal": "default", "iterations": BY_COST})
        assert gained(plans[-1], rare) >= max(gained(plans[0], rare), gained(cheapest, rare))

    def test_the_search_of_the_paper_takes_part_as_any_other(
        self, asked: dict[str, Any], small_lung: Lung
    ) -> None:
        there = la.resolve_target(small_lung, KUNTZ_TARGET)
        plans = la.plan(
            **asked | {"target": there, "method": "kuntz2015", "seed": KUNTZ_SEED, "iterations": 3000}
        )
        first, stated = next(plans), next(plans)
        assert first.chance is None and 0.0 <= share(stated) <= 1.0
        assert gained(stated, asked | {"target": there}) >= gained(first, asked | {"target": there})
        assert la.check(stated, small_lung, SYSTEM).accepted

    def test_all_plans_keep_the_stated_place(self, asked: dict[str, Any]) -> None:
        *_, free = la.plan(**asked | {"goal": "default"})
        place = la.StatedPlace(kind="exit", lps_mm=free.tube.exit.point_lps, within_mm=3.0)
        for each in la.plan(**asked | {"place": place}):
            away = each.tube.exit.point_lps - place.lps_mm
            assert math.hypot(*away.tolist()) <= 3.0


@pytest.mark.slow
def test_a_procedure_that_measures_is_the_one_of_whoever_states_none(asked: dict[str, Any]) -> None:
    first, *stated = la.plan(**asked | {"procedure": None, "iterations": 1})
    assert first.chance is None and stated
    for each in stated:
        assert each.chance is not None
        assert (each.chance.procedure, each.chance.samples) == ("measured-tip", ratings.MEASURED.fresh)


def depth(plan: Plan, _lung: Lung) -> float:
    return plan.tissue_mm


@pytest.mark.slow
class TestFunctions:
    """Contests by a function of the plan, which is certain."""

    @pytest.mark.parametrize("larger", [False, True])
    def test_a_function_becomes_small_or_large(
        self, larger: bool, asked: dict[str, Any], small_lung: Lung
    ) -> None:
        goal = Goal(name="depth", words="way in tissue", unit="mm", larger_is_better=larger, of=depth)
        first, *stated, simple = la.plan(**asked | {"goal": goal, "iterations": 20})
        assert not first.goals and stated
        values = [each.goals["depth"] for each in stated]
        assert values == [depth(each, small_lung) for each in stated]
        assert all((later > sooner) if larger else (later < sooner) for sooner, later in pairwise(values))
        *_, cheapest = la.plan(**asked | {"goal": "default", "iterations": BY_COST})
        for other in (first, cheapest):
            value = depth(other, small_lung)
            assert (values[-1] >= value) if larger else (values[-1] <= value)
        assert la.check(simple, small_lung, SYSTEM).accepted
        assert Plan.from_json(simple.to_json()).goals == simple.goals == stated[-1].goals

    def test_a_plain_function_is_made_small(self, asked: dict[str, Any]) -> None:
        named = Goal(name="depth", words="depth", of=depth)
        one, other = (list(la.plan(**asked | {"goal": goal})) for goal in (depth, named))
        assert same_run(one) == same_run(other)
