"""Plans for the chance of success: better than those of least cost, proved, honest about their chance."""

from __future__ import annotations

import numpy as np
import pytest

import lungaccess as la
from anatomy.errors import SettingsError
from anatomy.lung import Lung
from lungaccess.coupled.search.direct_arcs import DirectArcs
from lungaccess.plans.assemble import assemble
from lungaccess.plans.plan import Plan
from lungaccess.problem.target import Target
from lungaccess.problem.task import Task
from lungaccess.procedure import load_procedure
from lungaccess.risk import ErrorModel, RiskAssessor, load_errors
from lungaccess.success import PlannedSuccess, plan_for_success
from lungaccess.success.spread import Spread
from stages.needle import Objective

SYSTEM = la.load_system("tight-inner", fissures_allowed=True)
TARGETS = ("lps:-45.6,47.0,-65.1", "lps:-81.25,51,-33.5")
ERRORS = load_errors("gated-ct")
RADIUS_MM = 5.0
ITERATIONS = 30


@pytest.fixture(scope="module")
def atlas(small_lung: Lung) -> la.Atlas:
    return la.build_atlas(small_lung, SYSTEM)


def found(lung: Lung, atlas: la.Atlas, target: Target, iterations: int = ITERATIONS) -> list[PlannedSuccess]:
    return list(
        plan_for_success(
            lung, SYSTEM, target, errors=ERRORS, radius_mm=RADIUS_MM, atlas=atlas, iterations=iterations
        )
    )


def chance(plan: Plan, lung: Lung, seed: int, errors: ErrorModel = ERRORS) -> float:
    assessor = RiskAssessor(plan, lung, radius_mm=RADIUS_MM)
    return assessor.success(assessor.draws(10_000, seed), errors).value


@pytest.mark.parametrize("where", TARGETS)
def test_it_succeeds_more_often_than_the_plan_of_least_cost(
    small_lung: Lung, atlas: la.Atlas, where: str
) -> None:
    target = la.resolve_target(small_lung, where)
    best = found(small_lung, atlas, target)[-1]
    cheapest = list(la.plan(small_lung, SYSTEM, target, atlas=atlas, iterations=100))[-1]
    assert chance(best.plan, small_lung, 99) > chance(cheapest, small_lung, 99) - 0.01
    low, high = best.succeeds.interval
    assert low - 0.01 < chance(best.plan, small_lung, 100) < high + 0.01
    report = la.check(best.plan, small_lung, SYSTEM)
    assert report.accepted, [str(each) for each in report.refusals]
    assert (best.errors, best.procedure) == ("gated-ct", "open-loop")


def test_one_target_gains_much(small_lung: Lung, atlas: la.Atlas) -> None:
    gains = []
    for where in TARGETS:
        target = la.resolve_target(small_lung, where)
        cheapest = list(la.plan(small_lung, SYSTEM, target, atlas=atlas, iterations=100))[-1]
        best = found(small_lung, atlas, target)[-1]
        gains.append(chance(best.plan, small_lung, 5) - chance(cheapest, small_lung, 5))
    assert max(gains) > 0.05


def test_the_same_seed_gives_the_same_plans(small_lung: Lung, atlas: la.Atlas) -> None:
    target = la.resolve_target(small_lung, TARGETS[0])
    one, other = (
        [(each.plan.tube.rotation_rad, each.plan.needle.end_lps.tolist(), each.succeeds) for each in plans]
        for plans in (found(small_lung, atlas, target, 10), found(small_lung, atlas, target, 10))
    )
    assert one == other


def test_the_estimate_of_first_order_ranks_candidates(small_lung: Lung, atlas: la.Atlas) -> None:
    """Its order is that of counted successes, well enough to prune by."""
    from scipy.stats import spearmanr

    ranks = []
    for where in TARGETS:
        target = la.resolve_target(small_lung, where)
        task = Task(
            lung=small_lung, system=SYSTEM, target=target, objective=Objective.of("length_mm"), method="x", seed=0
        )
        arcs = DirectArcs(task, atlas)
        clear = arcs.clear()
        some = clear[:: max(1, len(clear) // 40)]
        spread = Spread(atlas, some, target.lps_mm, ERRORS, load_procedure(), RADIUS_MM)
        counted = []
        for entry in some.tolist():
            candidate = arcs.proved(entry)
            assert candidate is not None
            counted.append(chance(assemble(task, candidate, iteration=0, timing={}), small_lung, 3))
        assert ((spread.chances >= 0.0) & (spread.chances <= 1.0)).all()
        if np.ptp(counted) > 0.05:
            ranks.append(spearmanr(spread.chances, counted)[0])
    assert ranks and max(ranks) > 0.5


def test_without_errors_every_candidate_is_certain(small_lung: Lung, atlas: la.Atlas) -> None:
    target = la.resolve_target(small_lung, TARGETS[0])
    task = Task(
        lung=small_lung, system=SYSTEM, target=target, objective=Objective.of("length_mm"), method="x", seed=0
    )
    clear = DirectArcs(task, atlas).clear()
    spread = Spread(atlas, clear, target.lps_mm, ErrorModel(), load_procedure(), RADIUS_MM)
    assert np.allclose(spread.chances, 1.0, atol=1e-6)


def test_where_there_is_no_plan_it_says_why(small_lung: Lung, atlas: la.Atlas) -> None:
    with pytest.raises(la.NoPlan) as failure:
        found(small_lung, atlas, la.resolve_target(small_lung, nodule=3))
    assert failure.value.reasons


def test_tubes_alone_are_refused(small_lung: Lung) -> None:
    target = la.resolve_target(small_lung, TARGETS[0])
    with pytest.raises(SettingsError, match="needle"):
        next(plan_for_success(small_lung, la.load_system("tubes-only"), target))
