"""Plans for the chance of success: better than those of least cost, proved, honest about their chance."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lungaccess as la
from anatomy.base.typed import Int
from anatomy.lung import Lung
from lungaccess.planning.coupled.search.direct_arcs import DirectArcs
from lungaccess.planning.procedure.spread import Spread
from lungaccess.planning.success.ratings import OPEN_LOOP
from lungaccess.plans.assemble import assemble
from lungaccess.plans.plan import Plan
from lungaccess.problem.error_files import load_errors
from lungaccess.problem.errors import ErrorModel
from lungaccess.problem.procedures import load_procedure
from lungaccess.problem.target import Target
from lungaccess.problem.task import Task
from lungaccess.uncertainty.risk import RiskAssessor
from stages.needle import Objective

SYSTEM = la.load_system("lung-default", fissures_allowed=True)
MANY = 20
ERRORS = load_errors("gated-ct")
RADIUS_MM = 5.0
ITERATIONS = 30


@pytest.fixture(scope="module")
def atlas(small_lung: Lung) -> la.Atlas:
    return la.build_atlas(small_lung, SYSTEM)


@pytest.fixture(scope="module")
def targets(small_lung: Lung, atlas: la.Atlas) -> list[Target]:
    """Two targets in the periphery, each with many clear arcs."""
    points = [la.point_target(small_lung, point) for point in la.peripheral_targets(small_lung, 8, 0)]
    return [each for each in points if len(direct_arcs(small_lung, atlas, each).clear()) > MANY][:2]


def found(lung: Lung, atlas: la.Atlas, target: Target, **options: Any) -> list[Plan]:
    asked = {"iterations": ITERATIONS, "procedure": load_procedure("open-loop"), "errors": ERRORS, **options}
    return list(la.plan(lung, SYSTEM, target, radius_mm=RADIUS_MM, atlas=atlas, **asked))


def chance(plan: Plan, lung: Lung, seed: int, samples: int = 10_000) -> float:
    assessor = RiskAssessor(plan, lung, radius_mm=RADIUS_MM)
    return assessor.success(assessor.draws(samples, seed), ERRORS).value


def spread_of(atlas: la.Atlas, entries: Int, target: Target, errors: ErrorModel) -> Spread:
    chosen = atlas.deployments.only(entries)
    tips = atlas.motions.tips[chosen.site]
    return Spread(atlas.lung, SYSTEM, tips, chosen, target.lps_mm, errors, load_procedure(), RADIUS_MM)


def direct_arcs(lung: Lung, atlas: la.Atlas, target: Target) -> DirectArcs:
    objective = Objective.of("length_mm")
    task = Task(lung=lung, system=SYSTEM, target=target, objective=objective, method="atlas", seed=0)
    return DirectArcs(task, atlas)


@pytest.mark.slow
def test_it_succeeds_more_often_than_the_plan_of_least_cost(
    small_lung: Lung, atlas: la.Atlas, targets: list[Target]
) -> None:
    gains = []
    for target in targets:
        best = found(small_lung, atlas, target)[-1]
        cheapest = list(la.plan(small_lung, SYSTEM, target, atlas=atlas, iterations=100, goal="default"))[-1]
        gains.append(chance(best, small_lung, 99) - chance(cheapest, small_lung, 99))
        report = la.check(best, small_lung, SYSTEM)
        assert report.accepted, [str(each) for each in report.refusals]
        stated = best.chance
        assert stated is not None and stated.samples == OPEN_LOOP.fresh
        assert abs(chance(best, small_lung, 100) - stated.share) < 0.025
        assert (stated.errors, stated.procedure) == ("gated-ct", "open-loop")
    assert len(gains) == 2 and min(gains) > -0.01 and max(gains) > 0.05


@pytest.mark.slow
def test_a_search_without_time_estimates_its_plan_with_few_draws(
    small_lung: Lung, atlas: la.Atlas, targets: list[Target]
) -> None:
    first, last = found(small_lung, atlas, targets[0], iterations=None, time_s=0.0)
    assert first.tube.rotation_rad == last.tube.rotation_rad
    assert first.chance is None and last.chance is not None and last.chance.samples == 250


@pytest.mark.slow
def test_a_diverse_set_trades_success_for_length_and_clearance(
    small_lung: Lung, atlas: la.Atlas, targets: list[Target]
) -> None:
    several = la.alternatives(
        small_lung, SYSTEM, targets[0], errors=ERRORS, procedure=load_procedure("open-loop"),
        radius_mm=RADIUS_MM, atlas=atlas, count=4, iterations=3,
    )  # fmt: skip
    assert len(several) > 1
    best = max(several, key=lambda each: each.criteria["success"])
    assert best.on_front and best is several[0], "the plan that was searched for comes first"
    for each in several:
        assert la.check(each.plan, small_lung, SYSTEM).accepted
        stated = each.plan.chance
        assert stated is not None and stated.share == each.criteria["success"]
        assert stated.share == chance(each.plan, small_lung, stated.seed, stated.samples)
        better = [
            other.criteria["success"] > stated.share
            and other.criteria["length_in_tissue_mm"] < each.criteria["length_in_tissue_mm"]
            and other.criteria["clearance_mm"] > each.criteria["clearance_mm"]
            for other in several
        ]
        assert not (each.on_front and any(better))


@pytest.mark.slow
def test_the_estimate_of_first_order_tells_who_hits_the_goal(
    small_lung: Lung, atlas: la.Atlas, targets: list[Target]
) -> None:
    from scipy.stats import spearmanr

    for target in targets:
        arcs = direct_arcs(small_lung, atlas, target)
        clear = arcs.clear()
        some = clear[:: max(1, len(clear) // 30)]
        spread = spread_of(atlas, some, target, ERRORS)
        assert ((spread.chances >= 0.0) & (spread.chances <= 1.0)).all()
        counted = []
        for entry in some.tolist():
            candidate = arcs.proved(entry)
            assert candidate is not None
            plan = assemble(arcs.task, candidate, iteration=0, timing={})
            assessor = RiskAssessor(plan, small_lung, radius_mm=RADIUS_MM)
            outcomes = assessor.outcomes(assessor.draws(2000, 3).deviations(ERRORS))
            counted.append(np.mean(outcomes.miss_mm <= RADIUS_MM))
        assert spearmanr(spread.goal_chances, counted)[0] > 0.7
        assert np.abs(spread.goal_chances - counted).max() < 0.2


@pytest.mark.slow
def test_without_errors_every_candidate_is_certain(
    small_lung: Lung, atlas: la.Atlas, targets: list[Target]
) -> None:
    target = targets[0]
    clear = direct_arcs(small_lung, atlas, target).clear()
    spread = spread_of(atlas, clear, target, ErrorModel())
    assert np.allclose(spread.chances, 1.0, atol=1e-6)


@pytest.mark.slow
def test_where_there_is_no_plan_it_says_why(small_lung: Lung, targets: list[Target]) -> None:
    short = replace(SYSTEM, name="short", needle=replace(SYSTEM.needle, max_length_mm=1.0))
    with pytest.raises(la.NoPlan) as failure:
        next(la.plan(small_lung, short, targets[0], counterfactuals=False))
    assert failure.value.reasons
