"""The headline of a plan says the worse of its two parts; its limits are those that the check measured."""

from __future__ import annotations

import json
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import lungaccess as la
from anatomy.base.errors import SettingsError
from anatomy.base.words import of_hundred
from anatomy.lung import Lung
from lungaccess.cli.plan_search import GRADE_STYLES
from lungaccess.judging.appraisal import Appraisal, Appraiser, Geometry, Grade, Headline, limits_of
from lungaccess.judging.appraisal.headline import FAIR_FROM, GOOD_FROM, grade_of_chance
from lungaccess.judging.checking import Finding
from lungaccess.plans.plan import Plan
from lungaccess.problem.error_files import load_errors
from lungaccess.problem.errors import ErrorModel
from lungaccess.showing.report.html import words
from lungaccess.uncertainty.risk import Share
from tests.lungaccess.appraisals import make_check, make_risk

SYSTEM = la.load_system("ultrathin")
KEYS = {
    "text",
    "grade",
    "verdict",
    "geometry",
    "fissures_unknown",
    "fissure_chance",
    "needle_load",
    "success",
    "stated_by_plan",
    "without_measuring",
    "most_frequent_failure",
    "failures",
    "draws",
    "seed",
    "counts_as_success",
    "goal_radius_mm",
    "goal_radius_origin",
    "procedure",
    "errors",
    "errors_assumed",
}


@pytest.fixture(scope="module")
def plan(small_lung: Lung, small_atlas: la.Atlas) -> Plan:
    *_, best = la.plan(
        small_lung, SYSTEM, la.resolve_target(small_lung), atlas=small_atlas, iterations=60, goal="default"
    )
    return best


@pytest.fixture(scope="module")
def appraiser(small_lung: Lung) -> Appraiser:
    return Appraiser(small_lung, draws=300)


@pytest.fixture(scope="module")
def appraisal(plan: Plan, appraiser: Appraiser) -> Appraisal:
    return appraiser.appraise(plan)


# The headline ------------------------------------------------------------------------------------


def test_a_good_plan_is_good_news() -> None:
    headline = Headline.of(make_check(True), make_risk(2000))
    assert (headline.grade, headline.verdict) == (Grade.GOOD, "likely to succeed")
    assert headline.text == (
        "Estimated to succeed in 100 of 100 procedures (95 % interval 99.8 to 100); none of them failed. "
        "Procedure 'open-loop', errors of 'breath-hold'. Geometry proved and checked."
    )


def test_a_risky_plan_says_what_fails_before_its_geometry_reassures() -> None:
    headline = Headline.of(make_check(True), make_risk(60, reaches=700, vessel=1220, airway=300))
    assert (headline.grade, headline.verdict) == (Grade.POOR, "likely to fail")
    assert headline.text.startswith(
        "Estimated to succeed in 3 of 100 procedures (95 % interval 2.3 to 3.9); fails most because it ends "
        "more than 2.5 mm from the target (65 of 100) and touches a vessel (61 of 100)."
    )
    touched = Headline.of(make_check(True), make_risk(1200, reaches=1900, vessel=700))
    assert (touched.grade, touched.verdict) == (Grade.FAIR, "may fail")
    assert "; fails most because it touches a vessel (35 of 100). " in touched.text


def test_a_refused_plan_has_no_chance() -> None:
    headline = Headline.of(make_check(False), None)
    assert (headline.grade, headline.verdict) == (Grade.POOR, "refused: do not use")
    assert headline.text == ("Refused by the independent check (1 finding). Chance of success not computed.")
    assert headline.to_mapping()["success"] is None


def test_what_was_not_looked_at_is_never_good() -> None:
    assert Headline.of(None, None).text == "Chance of success not computed. Geometry not checked."
    for headline in (Headline.of(None, make_risk(2000)), Headline.of(make_check(True), None)):
        assert (headline.grade, headline.verdict) == (Grade.UNKNOWN, "not known to succeed")


def test_without_a_fissure_mask_a_plan_is_never_good_news() -> None:
    unknown = Finding(name="patient.fissures", ok=None, detail="no fissure mask")
    check = make_check(True)
    blind = replace(check, findings=(*check.findings, unknown))
    headline = Headline.of(blind, make_risk(1980))
    assert Headline.of(check, make_risk(1980)).grade == Grade.GOOD
    assert (headline.grade, headline.verdict) == (Grade.UNKNOWN, "not known to succeed")
    assert "fissures not checked: no fissure mask" in headline.text
    assert headline.to_mapping()["fissures_unknown"] is True


def test_a_needle_that_bends_its_tubes_away_is_never_good_news() -> None:
    check = make_check(True)
    load = Finding(name="tube.needle_load", ok=None, detail="the tip moves by 9 mm")
    headline = Headline.of(replace(check, findings=(*check.findings, load)), make_risk(1980))
    assert (headline.grade, headline.verdict) == (Grade.UNKNOWN, "not known to succeed")
    assert "geometry proved and checked, needle's load not counted: the tip moves by 9 mm" in (
        headline.geometry_words
    )
    assert headline.not_counted == ("needle's load",)
    assert headline.to_mapping()["needle_load"] == "the tip moves by 9 mm"


def test_the_model_is_named_and_its_sizes_are_stated(tmp_path: Path) -> None:
    default = Headline.of(make_check(True), make_risk(5)).details
    assert any("Errors of 'breath-hold': scope tip 1.3 mm and 2°" in each for each in default)
    assert any("Assumed, with no published source: scope direction, tube" in each for each in default)
    (tmp_path / "measured.toml").write_text("[scope_position]\nattempt_mm = 0.25\n")
    of_file = load_errors(tmp_path / "measured.toml")
    assert of_file.label == "measured.toml"
    details = Headline.of(make_check(True), make_risk(5, model=of_file)).details
    assert any(each.startswith("Errors of 'measured.toml': scope tip 0.25 mm") for each in details)
    (tmp_path / "named.toml").write_text('name = "expiration"\n[scope_position]\nattempt_mm = 0.25\n')
    assert load_errors(tmp_path / "named.toml").label == "expiration"
    assert ErrorModel().label == "stated"


@given(
    count=st.integers(0, 3000),
    more=st.integers(0, 3000),
    checked=st.sampled_from([None, True, False]),
    estimated=st.booleans(),
)
def test_nothing_is_green_unless_it_is_accepted_and_likely(
    count: int, more: int, checked: bool | None, estimated: bool
) -> None:
    """The colours of terminal, page and picture are green only where both parts are good."""
    draws = count + more + 1
    report = None if checked is None else make_check(checked)
    headline = Headline.of(report, make_risk(count, draws) if estimated else None)
    good = GRADE_STYLES[headline.grade.key] == "green"
    assert good == ("grade-good" in words.headline(headline)) == ("✓" in words.headline(headline))
    assert good == (headline.grade.colour == Grade.GOOD.colour)
    if good:
        assert checked and estimated and count / draws >= GOOD_FROM
    if headline.grade == Grade.FAIR:
        assert checked and estimated and count / draws >= FAIR_FROM
    if headline.geometry == Geometry.REFUSED:
        assert GRADE_STYLES[headline.grade.key] == "red"
    json.dumps(headline.to_mapping(), allow_nan=False)


@given(st.floats(0.0, 1.0))
def test_a_share_of_a_hundred_is_never_stated_as_better_than_it_is(probability: float) -> None:
    low, high = float(of_hundred(probability)), float(of_hundred(probability, up=True))
    assert low - 1e-6 <= 100.0 * probability <= high + 1e-6
    assert high - low <= 1.0 + 1e-9
    if probability < 1.0 - 1e-7:
        assert low < 100.0


def test_few_draws_make_no_grade_better() -> None:
    assert grade_of_chance(Share(count=10, samples=10)) == Grade.FAIR
    assert grade_of_chance(Share(count=1000, samples=1000)) == Grade.GOOD


# Limits ------------------------------------------------------------------------------------------


def test_limits_are_those_of_the_check_nearest_first(appraisal: Appraisal) -> None:
    findings = {each.name: each for each in appraisal.check.findings}
    used = [each.used for each in appraisal.limits]
    assert used == sorted(used, reverse=True) and len(used) >= 15
    for each in appraisal.limits:
        found = findings[each.finding]
        if each.unit == "mm" and "radius of curvature" not in each.what:
            assert (each.value, each.bound, each.side) == (found.value, found.limit, found.side)
        if each.stated is not None:
            # A plan states a lower bound of what the check measures; the tube's begins at the exit.
            device = each.finding.split(".")[0]
            assert each.value is not None and (
                device == "tube" or min(each.stated, 19.0) <= each.value + 0.05
            )
    bounds = {each.what: each.bound for each in appraisal.limits if "radius of curvature" in each.what}
    assert all(each.side == "at least" for each in appraisal.limits if each.what in bounds)
    assert SYSTEM.tubes.max_channel_curvature_per_mm is not None
    assert bounds == {
        "scope radius of curvature": pytest.approx(1.0 / SYSTEM.tubes.max_channel_curvature_per_mm),
        "needle radius of curvature": pytest.approx(SYSTEM.needle.min_radius_of_curvature_mm),
    }


def test_every_distance_stands_once(appraisal: Appraisal) -> None:
    names = [each.what for each in appraisal.limits]
    assert len(names) == len(set(names))


@given(value=st.floats(1e-3, 1e3), limit=st.floats(1e-3, 1e3), side=st.sampled_from(["at least", "at most"]))
def test_a_limit_is_used_up_exactly_where_it_is_broken(value: float, limit: float, side: Any) -> None:
    margin = value - limit if side == "at least" else limit - value
    finding = Finding(name="tube.extension", ok=margin >= 0, value=value, limit=limit, side=side, unit="mm")
    (row,) = limits_of([finding])
    assert (row.used > 1.0) == (margin < 0.0)
    assert (row.used_words == "100 %") <= (row.used >= 1.0)


def test_a_broken_limit_comes_first_and_a_straight_needle_has_no_radius() -> None:
    broken = Finding(
        name="needle.clearance.vessel", ok=False, value=0.0, limit=1.0, side="at least", unit="mm"
    )
    straight = Finding(name="needle.curvature", ok=True, value=0.0, limit=0.01, side="at most", unit="1/mm")
    tight = Finding(name="tube.extension", ok=True, value=60.0, limit=60.0, side="at most", unit="mm")
    first, second, third = limits_of([straight, tight, broken])
    assert (first.what, first.used, first.ok) == ("needle to vessel", np.inf, False)
    assert second.words == "extension beyond scope 60.0 mm, at most 60.0 mm" and second.used_words == "100 %"
    assert third.words == "needle radius of curvature straight, at least 100.0 mm" and third.value is None
    json.dumps([each.to_mapping() for each in (first, second, third)], allow_nan=False)


def test_a_fissure_that_may_be_crossed_limits_nothing() -> None:
    finding = Finding(name="needle.clearance.fissure", ok=True, value=0.3, unit="mm")
    assert limits_of([finding]) == ()


# Appraisals --------------------------------------------------------------------------------------


def test_an_appraisal_joins_check_and_estimate(
    plan: Plan, appraisal: Appraisal, appraiser: Appraiser, small_lung: Lung
) -> None:
    assert appraisal.accepted and appraisal.headline.geometry == Geometry.PROVED
    report = la.assess(plan, small_lung, samples=300)
    assert appraisal.headline.success == report.succeeds
    assert dict(report.failures)["misses the goal"].count == 300 - report.reaches.count
    assert appraiser.appraise(plan).to_mapping() == appraisal.to_mapping()
    mapping = appraisal.to_mapping()
    assert set(mapping) == {"accepted", "headline", "limits"}
    assert set(mapping["headline"]) == KEYS  # type: ignore[call-overload]
    json.dumps(mapping, allow_nan=False)


def test_a_notebook_shows_headline_and_limits(appraisal: Appraisal) -> None:
    shown = appraisal._repr_html_()
    assert appraisal.headline.text.replace("'", "&#x27;") in shown
    assert all(escape(each.what) in shown for each in appraisal.limits[:10])
    assert (Grade.GOOD.colour in shown) == (appraisal.headline.grade == Grade.GOOD)


def test_every_key_of_the_summary_is_documented(appraisal: Appraisal) -> None:
    page = (Path(__file__).parents[4] / "docs/reference/command_line.md").read_text(encoding="utf-8")
    mapping: dict[str, Any] = appraisal.to_mapping()
    headline = [line.split("|")[1] for line in page.splitlines() if line.startswith("| `headline.")]
    keys = [word.removeprefix("headline.") for line in headline for word in line.split("`")[1::2]]
    assert keys == list(dict.fromkeys(keys)) and set(mapping["headline"]) <= set(keys)
    (row,) = [line for line in page.splitlines() if line.startswith("| `limits`")]
    for key in mapping["limits"][0]:
        assert f"`{key}`" in row


def test_a_plan_of_another_lung_is_refused_without_an_estimate(plan: Plan, appraiser: Appraiser) -> None:
    refused = appraiser.appraise(replace(plan, lung_key="other"))
    assert not refused.accepted and refused.risk is None
    assert refused.headline.geometry == Geometry.REFUSED


def test_no_draws_are_no_estimate(plan: Plan, small_lung: Lung) -> None:
    assert la.appraise(plan, small_lung, draws=0).headline.grade == Grade.UNKNOWN
    with pytest.raises(SettingsError, match="draws"):
        Appraiser(small_lung, draws=-1)
