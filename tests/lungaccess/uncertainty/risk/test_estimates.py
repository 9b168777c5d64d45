"""Sensitivities and rare events: known answers, and agreement with counting."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy.stats import chi, chi2, norm

import lungaccess as la
from anatomy.lung import Lung
from lungaccess.plans.plan import Plan
from lungaccess.problem.error_files import load_errors
from lungaccess.problem.errors import ErrorModel, PositionError
from lungaccess.uncertainty.risk import assess, rare_share, rare_touch
from lungaccess.uncertainty.risk.assessment import Luck, Sensitivity, sensitivities
from lungaccess.uncertainty.risk.assessor import RiskAssessor


@pytest.fixture(scope="module")
def plan(small_lung: Lung, small_atlas: la.Atlas) -> Plan:
    target = la.resolve_target(small_lung)
    *_, best = la.plan(
        small_lung, small_atlas.system, target, atlas=small_atlas, iterations=30, goal="default"
    )
    return best


EVENTS = {
    "one side": (lambda z: 0.6 * z[:, 0] + 0.8 * z[:, 1] > 4.0, norm.sf(4.0)),
    "four sides": (
        lambda z: (np.abs(z[:, 0]) > 4.0) | (np.abs(z[:, 3]) > 4.0),
        1.0 - (1.0 - 2.0 * norm.sf(4.0)) ** 2,
    ),
    "all around": (lambda z: (z[:, :3] ** 2).sum(axis=1) > 16.0, chi2.sf(16.0, 3)),
}


@pytest.mark.parametrize("name", list(EVENTS))
def test_rare_events_have_their_known_probabilities(name: str) -> None:
    happens, truth = EVENTS[name]
    found = [rare_share(happens, 12, 10_000, seed) for seed in range(20)]
    assert np.mean([each.value for each in found]) == pytest.approx(truth, rel=0.03)
    inside = sum(each.interval[0] <= truth <= each.interval[1] for each in found)
    # Of 20 intervals of 95 %, fewer than 16 hold the truth in 3 of 1000 cases.
    assert inside >= 16
    assert all(each.is_exact for each in found)
    assert found[0] == rare_share(happens, 12, 10_000, 0)


def test_what_never_happens_is_not_claimed_to_be_known() -> None:
    never = rare_share(lambda z: np.zeros(len(z), dtype=bool), 5, 500, 0)
    assert (never.value, never.centres, never.is_exact) == (0.0, 0, False)
    always = rare_share(lambda z: np.ones(len(z), dtype=bool), 5, 500, 0)
    assert always.value == pytest.approx(1.0, abs=0.2)


def test_a_rare_miss_of_the_target_has_a_known_probability(plan: Plan, small_lung: Lung) -> None:
    """With an error of the target alone the miss is Maxwell distributed."""
    there = RiskAssessor(plan, small_lung, radius_mm=4.5)
    model = ErrorModel(target_position=PositionError(attempt_mm=1.0))
    luck = Luck(lambda count: there.draws(count, 0), model)
    event = luck.event(lambda draws: ~there.successes(draws.deviations(model)))
    found = rare_share(event, luck.dimensions, 10_000, 0)
    assert luck.dimensions == 3
    assert found.interval[0] <= chi.sf(4.5, 3) <= found.interval[1]


def test_weights_agree_with_counts(plan: Plan, small_lung: Lung) -> None:
    there, model = RiskAssessor(plan, small_lung), load_errors()
    shares = assess(plan, small_lung, samples=20_000, each_kind=False).touches
    common = [name for name, share in shares.items() if 0.002 < share.value < 0.2]
    assert common
    for name in common:
        low, high = shares[name].interval
        found = rare_touch(there, model, name, 20_000, 1)
        assert found.interval[0] <= high + 0.1 * high and found.interval[1] >= low - 0.1 * low


def sensitivities_of(there: RiskAssessor, model: ErrorModel, samples: int) -> tuple[Sensitivity, ...]:
    draws = there.draws(samples, 0)
    alone = {kind: there.success(draws, model.only(kind)) for kind in there.kinds}
    return sensitivities(there, model, samples, 0, alone)


def test_errors_of_one_kind_explain_everything(plan: Plan, small_lung: Lung) -> None:
    there = RiskAssessor(plan, small_lung, radius_mm=2.0)
    (only,) = sensitivities_of(there, ErrorModel(target_position=PositionError(attempt_mm=1.5)), 20_000)
    share = chi.cdf(2.0 / 1.5, 3)
    assert only.alone.value == pytest.approx(share, abs=0.015)
    assert only.total == pytest.approx(1.0, abs=0.03)
    assert only.first_order == pytest.approx(1.0, abs=0.05)


def test_two_errors_share_the_variance_as_computed(plan: Plan, small_lung: Lung) -> None:
    """The target lies within its radius where the sum of two independent squares is small."""
    there = RiskAssessor(plan, small_lung, radius_mm=2.0)
    model = ErrorModel(
        target_position=PositionError(attempt_mm=1.0), needle_insertion=PositionError(attempt_mm=1.5)
    )
    found = {each.kind: each for each in sensitivities_of(there, model, 40_000)}
    rng = np.random.default_rng(0)
    end = there.plan.needle
    assert end is not None
    first, second = rng.normal(size=(2, 400_000, 3)), 1.5 * rng.normal(size=(2, 400_000))

    def within(target: np.ndarray, along: np.ndarray) -> np.ndarray:
        return np.hypot(np.hypot(target[:, 0], target[:, 1]), target[:, 2] - along) <= 2.0

    base = within(first[0], second[0])
    changes = {
        "target_position": np.mean(base != within(first[1], second[0])),
        "needle_insertion": np.mean(base != within(first[0], second[1])),
    }
    variance = base.mean() * (1.0 - base.mean())
    for kind, change in changes.items():
        # The needle is nearly straight over a few millimetres, and meets nothing there.
        assert found[kind].total == pytest.approx(0.5 * change / variance, abs=0.06)
    for kind, other in itertools.permutations(found):
        assert found[kind].first_order <= found[kind].total + 0.03
        assert found[kind].first_order + found[other].total == pytest.approx(1.0, abs=0.06)


def test_without_errors_nothing_is_sensitive(plan: Plan, small_lung: Lung) -> None:
    there = RiskAssessor(plan, small_lung)
    assert sensitivities_of(there, ErrorModel(), 100) == ()
    report = assess(plan, small_lung, samples=500)
    assert {each.kind for each in report.sensitivity} <= set(there.kinds)
    totals = [each.total for each in report.sensitivity]
    assert totals == sorted(totals, reverse=True) and not any(map(math.isnan, totals))
