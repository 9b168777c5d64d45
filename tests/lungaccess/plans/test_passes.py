"""Several passes as one plan: planned together, proved each, counted with what they have in common."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lungaccess as la
from anatomy.base.errors import SettingsError
from anatomy.lung import Lung
from lungaccess.judging.advice import advise
from lungaccess.judging.appraisal import appraise
from lungaccess.judging.checking import check
from lungaccess.planning.one_system import run
from lungaccess.planning.procedure import simulate_procedure
from lungaccess.plans.kernels.tissue import taken_at
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.plan import Plan, redirection_mm
from lungaccess.plans.tissue import own_nodule, wanted_of
from lungaccess.plans.view import best_view_words, bronchus_sign, radial_views, view_words
from lungaccess.problem.error_files import load_errors
from lungaccess.problem.procedures import load_procedure
from lungaccess.problem.request import Request
from lungaccess.problem.system import system_fingerprint, with_tool
from lungaccess.problem.tools import load_tool
from lungaccess.showing.report.html.tables import plan_name, shown_name
from lungaccess.uncertainty.risk import assess
from lungaccess.uncertainty.risk.assessor import RiskAssessor, drawn_anew
from lungaccess.uncertainty.risk.statistics import share_of

CORE = with_tool(la.load_system("ultrathin"), load_tool("core"))
MODEL = load_errors("breath-hold")
PASSES = 3


@pytest.fixture(scope="module")
def plans(small_lung: Lung, small_atlas: la.Atlas) -> tuple[Plan, Plan]:
    """Return the plans of one pass and of three."""
    found = []
    for passes in (1, PASSES):
        request = Request.of(
            small_lung, CORE, la.resolve_target(small_lung), passes=passes, iterations=0,
            procedure=load_procedure("open-loop"),
        )  # fmt: skip
        found.append(list(run(request, atlas=small_atlas))[-1])
    return found[0], found[1]


def test_passes_planned_together_take_tissue_more_often(plans: tuple[Plan, Plan], small_lung: Lung) -> None:
    one, several = plans
    assert len(one.passes) == 1 and len(several.passes) == PASSES
    same = one.with_further([one] * (PASSES - 1))
    shares = [
        assess(each, small_lung, seed=9, each_kind=False).succeeds.value for each in (one, same, several)
    ]
    assert shares[1] >= shares[0] + 0.08 and shares[2] >= shares[0] + 0.15
    assert shares[2] >= shares[1] + 0.02, "passes are spread over the nodule"
    assert several.chance.share == pytest.approx(shares[2], abs=0.02)


def test_every_pass_is_checked_and_kept_in_the_file(plans: tuple[Plan, Plan], small_lung: Lung) -> None:
    several = plans[1]
    report = check(several, small_lung)
    assert report.accepted, report.refusals
    names = {each.name for each in report.findings}
    assert {"tool.tissue", "pass_2.tool.tissue", "pass_3.needle.clearance.vessel"} <= names
    again = Plan.from_json(several.to_json())
    assert again.digest == several.digest and len(again.passes) == PASSES
    last = several.further[-1]
    beside = replace(last, end_lps=np.asarray(last.end_lps) + [0.0, 0.0, 1.0])
    assert {each.ok for each in report.findings if each.name.endswith("tool.tissue")} == {True}
    few = with_tool(CORE, replace(load_tool("core"), least=12.0))
    stated = replace(several, system=few, system_fingerprint=system_fingerprint(few))
    assert "tool.tissue" in {each.name for each in check(stated, small_lung).refusals}, (
        "the first takes enough"
    )
    broken = check(replace(several, further=(*several.further[:-1], beside)), small_lung)
    assert not broken.accepted and {each.name.split(".")[0] for each in broken.refusals} == {"pass_3"}


def test_the_chance_is_that_of_draws_laid_together(plans: tuple[Plan, Plan], small_lung: Lung) -> None:
    several = plans[1]
    there = RiskAssessor(several, small_lung)
    errors = there.draws(4000, 5).deviations(MODEL)
    taken, touched = np.zeros(4000), np.zeros(4000, dtype=bool)
    for one, own in zip(several.passes, (errors, *errors.further), strict=True):
        alone = RiskAssessor(one, small_lung)
        found = alone.outcomes(replace(own, further=()))
        taken += found.taken
        touched |= ~alone.touches_nothing(found.touched)
    truth = (taken >= there.wanted.least) & ~touched
    assert truth.tolist() == there.successes(errors).tolist()
    assert share_of(truth).count == assess(several, small_lung, samples=4000, seed=5).succeeds.count


def test_passes_have_in_common_what_does_not_move(plans: tuple[Plan, Plan], small_lung: Lung) -> None:
    one = plans[0]
    same = one.with_further([one])
    first = RiskAssessor(same, small_lung).draws(500, 1).deviations(MODEL)
    (second,) = first.further
    for name in ("scope_mm", "tilt_rad", "rotation_rad", "insertion_mm", "target_mm"):
        assert (getattr(first, name) == getattr(second, name)).all()
    assert (first.roll_rad != second.roll_rad).all()
    # What is wrong with a needle in one patient stays wrong in all passes.
    both = np.corrcoef(
        np.log(first.factor[first.factor > 0]), np.log(np.maximum(second.factor, 1e-9))[first.factor > 0]
    )
    term = MODEL.needle_curvature
    if term.patient and not term.straight_share:
        assert both[0, 1] == pytest.approx(term.patient**2 / term.size**2, abs=0.1)
    other = replace(one, tube=replace(one.tube, rotation_rad=one.tube.rotation_rad + 0.1))
    assert [each["tube_rotation"] for each in drawn_anew(one.with_further([other, one, other]))] == [
        0,
        1,
        0,
        1,
    ]
    alone = RiskAssessor(one, small_lung).draws(500, 1).deviations(MODEL)
    assert (alone.roll_rad == first.roll_rad).all(), "further passes leave the numbers of the first alone"


def test_procedures_of_passes_at_one_point_fail_less(plans: tuple[Plan, Plan], small_lung: Lung) -> None:
    one, asked = plans[0], {"errors": MODEL, "procedure": load_procedure("measured-tip"), "samples": 150}
    same = one.with_further([one] * 2)
    alone, together = (simulate_procedure(each, small_lung, **asked) for each in (one, same))
    assert together.succeeds.count > alone.succeeds.count
    assert simulate_procedure(same, small_lung, **asked).succeeds.count == together.succeeds.count


def test_hands_are_told_what_to_do_between_passes(plans: tuple[Plan, Plan]) -> None:
    one, several = plans
    needle = one.needle
    assert redirection_mm(one, one) == pytest.approx((needle.arcs[-1].length_mm,) * 2)
    same = one.with_further([one])
    back = f"withdraw the needle by {needle.arcs[-1].length_mm:.1f} mm, and steer it"
    assert same.redirections[0].startswith(back) and same.redirections[0].endswith("from the same tubes")
    assert len(several.redirections) == PASSES - 1 and one.redirections == ()
    names = [curve.name for curve in several.shown_curves()]
    assert names[:3] == ["scope", "tubes", "needle"] and {"needle_2", "needle_3"} <= set(names)


def test_pictures_number_the_passes_and_tables_tell_them_from_the_whole() -> None:
    assert [shown_name(n, 3) for n in (0, 2, 3)] == [
        ("Pass 1", "1"),
        ("Pass 3", "3"),
        ("Alternative 1", "A1"),
    ]
    assert [plan_name(n, 3) for n in (0, 2)] == ["All 3 passes of the plan", "Pass 3 alone"]
    assert [shown_name(n, 1) for n in (0, 2)] == [("The plan", "0"), ("Alternative 2", "2")]


def test_passes_leave_tubes_that_are_turned(plans: tuple[Plan, Plan], small_lung: Lung) -> None:
    several = plans[1]
    ends = np.array([each.end_lps for each in several.passes])
    assert np.linalg.norm(ends - ends[0], axis=1).max() > 1.0, "they end apart"
    assert max(several.same_tubes) > 0, "a needle so short cannot bend so far from the same tubes"


def test_passes_need_a_tool_and_the_chance(small_lung: Lung) -> None:
    target = la.resolve_target(small_lung)
    with pytest.raises(SettingsError, match="without a tool"):
        Request.of(small_lung, "ultrathin", target, passes=2)
    with pytest.raises(SettingsError, match="goal"):
        Request.of(small_lung, CORE, target, passes=2, goal="length")
    with pytest.raises(SettingsError, match="9 passes"):
        Request.of(small_lung, CORE, target, passes=9)


def test_more_passes_are_advised(plans: tuple[Plan, Plan], small_lung: Lung, small_atlas: la.Atlas) -> None:
    plan = plans[0]
    found = advise(plan, small_lung, appraise(plan, small_lung), atlas_of=lambda _: small_atlas, time_s=60.0)
    of_passes = {each.options: each.success.value for each in found if each.options[0] == "--passes"}
    assert of_passes[("--passes", "3")] > plan.chance.share + 0.03


def test_a_probe_in_a_nodule_sees_it_all_round(plans: tuple[Plan, Plan], small_lung: Lung) -> None:
    target = np.asarray(la.resolve_target(small_lung).lps_mm)
    ahead = [0.0, 0.0, 1.0, 1.0, 0.0, 0.0]
    inside = small_lung.grid.lps(own_nodule(small_lung, target))
    right = inside[inside[:, 0].argmax()]
    edge, far = right + [2.0, 0.0, 0.0], right + [9.0, 0.0, 0.0]
    tips = np.array([[*target, *ahead], [*edge, *ahead], [*far, *ahead]])
    assert radial_views(small_lung, target, tips) == ["concentric", "eccentric", "absent"]
    assert best_view_words(small_lung, target, tips[1:]).startswith("expected eccentric at the best")
    assert "scope / tubes: absent / absent" in view_words(plans[0], small_lung)
    beside = small_lung.tree.points_lps[0]
    assert bronchus_sign(small_lung, beside) == best_view_words(small_lung, beside, tips) == ""
    assert bronchus_sign(small_lung, target) in {
        "a bronchus leads into the nodule", "no bronchus leads into the nodule"
    }  # fmt: skip


def test_the_rest_of_a_plan_goes_on_until_the_tool_is_at_the_target(
    plans: tuple[Plan, Plan], small_lung: Lung
) -> None:
    plan, target = plans[0], la.resolve_target(small_lung)
    wanted = wanted_of(small_lung, target.lps_mm, CORE.tool)
    for found in (
        la.replan_from_tube(small_lung, CORE, plan.tube.lps_from_tip, target),
        la.replan_from_scope(small_lung, CORE, plan.scope.lps_from_scope_tip, target, tries=0),
    ):
        last = found.path.frames()[-1]
        assert taken_at(wanted, last) >= wanted.least
        middle = last[:3, 3] - CORE.tool.beyond_mm * last[:3, 2]
        assert np.linalg.norm(middle - target.lps_mm) < 1.0
        assert found.needle.end_lps.tolist() == last[:3, 3].tolist()
    small = with_tool(CORE, replace(load_tool("core"), least=14.9))
    with pytest.raises(NoPlan, match="as measured"):
        la.replan_from_tube(small_lung, small, plan.tube.lps_from_tip, target)
