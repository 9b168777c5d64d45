"""The check's own look at tubes and needle in the bent channel of the scope."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from anatomy.base.settings import override
from experiments.support.mutants import channel, load
from experiments.support.mutants.mutant import Case
from lungaccess.judging.checking import check
from lungaccess.judging.checking.findings import Findings
from lungaccess.judging.checking.outcome import check_needle_load
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
    """A toy plan that neglects its needle, with a tip that stays bent, which the tubes straighten."""
    inserted = plan.tube.outer_insertion_mm, plan.tube.inner_insertion_mm
    solid = {"needle_preloaded": False, "needle.slotted_segments": (), "needle.inner_diameter_mm": 0.0}
    alone = override(system, {"name": "own", **solid})
    bent = tools.toy_plan(lung, alone, *inserted, straightened_rad=0.02)
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


def test_what_the_needle_does_to_the_tubes_is_said_and_not_counted(case: Case) -> None:
    """The tubes bend in one plane: the tip turns by the sum of curvatures, in which stiffness shares."""
    plan, tubes = case.plan, case.plan.system.tubes
    outer_mm, inner_mm = plan.tube.outer_insertion_mm, plan.tube.inner_insertion_mm
    inner, outer = (float(tube.parts.stiffness_n_mm2[0]) for tube in tubes.nested)
    shaft = plan.system.needle_tube
    assert shaft is not None
    assert inner_mm <= tubes.inner.curved_length_mm
    turns = [
        tubes.inner.precurvature_per_mm
        * inner
        * (outer_mm / (inner + outer + needle) + (inner_mm - outer_mm) / (inner + needle))
        for needle in (0.0, shaft.bending_stiffness_n_mm2)
    ]
    (said,) = [each.detail for each in case.report.unchecked if each.name == "tube.needle_load"]
    assert f"turns by {np.degrees(turns[0] - turns[1]):.0f}°" in said


def test_a_needle_that_moves_no_tube_is_measured_and_a_neglected_one_is_not_named(case: Case) -> None:
    system = case.plan.system
    straight = replace(system.tubes.inner, curved_length_mm=0.0, precurvature_per_mm=0.0)
    soft = replace(system.needle, youngs_modulus_gpa=0.0)
    for changes, ok in (({"tubes": replace(system.tubes, inner=straight)}, [True]), ({"needle": soft}, [])):
        found = Findings()
        check_needle_load(replace(case.plan, system=replace(system, **changes)), found)
        assert [each.ok for each in found.report().findings] == ok


@pytest.mark.parametrize("mutation", channel.MUTATIONS, ids=lambda each: each.__name__)
def test_a_device_that_does_not_pass_the_scope_is_refused(mutation: Any, case: Case) -> None:
    made = [mutation(case, np.random.default_rng(seed)) for seed in range(4)]
    mutants = [each for each in made if each is not None]
    assert mutants
    for mutant in mutants:
        refused = {each.name for each in check(mutant.plan, case.lung).refusals}
        assert refused & REFUSED_BY[mutation.__name__]


@pytest.fixture(scope="module")
def loaded(plan: Plan, lung: Any, system: Any, tools: Any) -> Case:
    """The toy plan of tubes that are deployed with a flexible needle in them."""
    segment = {"length_mm": 380.0, "stiffness_factor": 0.04, "strain_factor": 0.75}
    changes = {
        "name": "own", "needle_preloaded": True, "needle.inner_diameter_mm": 0.0,
        "needle.slotted_segments": (segment,),
    }  # fmt: skip
    inserted = plan.tube.outer_insertion_mm, plan.tube.inner_insertion_mm
    made = tools.toy_plan(lung, override(system, changes), *inserted, straightened_rad=0.02)
    return Case(lung=lung, plan=made, report=check(made, lung), other=plan)


def test_the_shape_with_the_needle_in_the_tubes_is_derived_anew(loaded: Case, case: Case) -> None:
    """The needle lessens the bend, weighs on the handle, and moves nothing any more as it goes on."""
    findings = {each.name: each for each in loaded.report.findings}
    for name in ("tube.arcs", "tube.tip.derived", "tube.stable", "tube.strain", "tube.needle_load"):
        assert findings[name].ok, name
    assert findings["tube.needle_load"].value < 1e-4
    assert "tube.needle_load" not in {each.name for each in loaded.report.unchecked}
    inserted = loaded.plan.tube.outer_insertion_mm, loaded.plan.tube.inner_insertion_mm
    factor = bend_factor(loaded.plan.system, *inserted)
    shaft = loaded.plan.system.needle_tube
    assert shaft is not None
    share = shaft.parts.stiffness_n_mm2[0] / loaded.plan.system.scope.bending_stiffness_n_mm2
    assert factor == pytest.approx(bend_factor(case.plan.system, *inserted) + share)
    bend = abs(float(loaded.plan.scope.states[-1, 2]))
    assert findings["scope.handle"].value == pytest.approx(factor * bend)


@pytest.mark.parametrize("mutation", load.MUTATIONS, ids=lambda each: each.__name__)
def test_a_shape_that_does_not_bear_its_needle_is_refused(mutation: Any, loaded: Case, case: Case) -> None:
    for each in (loaded, case):
        mutant = mutation(each, np.random.default_rng(1))
        if mutant is None:
            assert each is case and mutation is not load.needle_left_out_of_shape
            continue
        refused = {finding.name for finding in check(mutant.plan, each.lung).refusals}
        assert refused & {"tube.arcs", "tube.tip.derived", "tube.needle_load"}
        assert "tube.needle_load" in refused
