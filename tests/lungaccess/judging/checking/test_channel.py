"""The check's own look at tubes and needle in the bent channel of the scope."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from experiments.support.mutants import channel
from experiments.support.mutants.mutant import Case
from lungaccess.judging.checking import check
from lungaccess.plans.plan import Plan
from lungaccess.problem.channel import bend_factor
from stages.scope import ScopeMotion

REFUSED_BY = {
    "limit_lower": {"tube.strain.outer", "tube.strain.inner", "tube.channel"},
    "slots_stripped": {"tube.strain.outer", "tube.strain.inner"},
    "handle_weaker": {"scope.handle"},
    "section_softer": {"scope.handle"},
}


@pytest.fixture(scope="module")
def case(plan: Plan, lung: Any, system: Any, tools: Any) -> Case:
    """The toy plan with a tip that stays bent, so that the tubes have something to straighten."""
    inserted = plan.tube.outer_insertion_mm, plan.tube.inner_insertion_mm
    bent = tools.toy_plan(lung, system, *inserted, straightened_rad=0.02)
    report = check(bent, lung)
    assert not {each.name for each in report.refusals} & set.union(*REFUSED_BY.values())
    return Case(lung=lung, plan=bent, report=report, other=plan)


def test_strain_and_handle_agree_with_the_planner_s(case: Case) -> None:
    plan = case.plan
    found = {each.name: each.value for each in case.report.findings}
    section = plan.system.scope.bending_length_mm
    motion = ScopeMotion(
        lps_from_entry=plan.scope.lps_from_entry, states=plan.scope.states, bending_length_mm=section
    )
    inserted = plan.tube.outer_insertion_mm, plan.tube.inner_insertion_mm
    parts, pieces = plan.system.tubes.inner.parts, motion.pieces
    far = np.cumsum(pieces[::-1, 0])[::-1]
    curvature = np.where(parts.begin_mm <= inserted[1] + far[:, None], np.abs(pieces[:, 2:]), 0.0)
    strain = (curvature + parts.curvature_per_mm) * parts.strained_radius_mm
    assert found["tube.strain.inner"] == pytest.approx(strain.max(), abs=1e-9)
    assert found["tube.channel"] == pytest.approx(np.abs(motion.pieces[:, 2]).max())
    factor = bend_factor(plan.system, *inserted)
    assert factor > 1.5, "tubes straighten the section"
    assert found["scope.handle"] == pytest.approx(factor * abs(plan.scope.states[-1, 2]))


@pytest.mark.parametrize("mutation", channel.MUTATIONS, ids=lambda each: each.__name__)
def test_a_device_that_does_not_pass_the_scope_is_refused(mutation: Any, case: Case) -> None:
    made = [mutation(case, np.random.default_rng(seed)) for seed in range(4)]
    mutants = [each for each in made if each is not None]
    assert mutants
    for mutant in mutants:
        refused = {each.name for each in check(mutant.plan, case.lung).refusals}
        assert refused & REFUSED_BY[mutation.__name__]
