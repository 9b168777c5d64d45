"""The check accepts a plan that is right, and says how it looked."""

from __future__ import annotations

import json
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from anatomy import structures
from anatomy.base.settings import override
from lungaccess.cli.plan_search import check_tables
from lungaccess.judging.checking import Finding, check
from lungaccess.judging.checking.findings import Findings
from lungaccess.plans.plan import Plan
from lungaccess.showing.report.html import tables
from lungaccess.showing.slicer.export import readme

LIMITS = {
    "tube.sweep.limit": "at most",
    "tube.sweep.stated_limit": "at most",
    "tube.exit.angle.limit": "at least",
    "scope.fits": "at least",
    "scope.margin.limit": "at least",
    "scope.bend.up": "at most",
    "scope.bend.down": "at most",
    "scope.bend.radius": "at most",
    "scope.shaft.radius": "at most",
    "scope.tip.off_axis": "at most",
    "scope.tip.forward": "at most",
    "needle.curvature": "at most",
    "needle.length.limit": "at most",
    "needle.turn.limit": "at most",
    "needle.angle.limit": "at most",
    "exemption.length": "at most",
    **{f"tube.clearance.{name}": "at least" for name in ("vessel", "outside", "fissure", "airway")},
    **{
        f"needle.clearance.{name}": "at least"
        for name in ("vessel", "outside", "fissure", "airway", "other_airway", "lumen")
    },
}


def test_the_plan_made_by_hand_is_accepted(plan: Plan, lung: Any, system: Any) -> None:
    report = check(plan, lung, system, target_lps=plan.target_lps)
    assert report.accepted, str(report)
    assert report.refusals == ()


def test_findings_name_every_part(plan: Plan, lung: Any) -> None:
    parts = {finding.name.split(".")[0] for finding in check(plan, lung).findings}
    assert {
        "record",
        "patient",
        "system",
        "clearance",
        "scope",
        "tube",
        "exemption",
        "needle",
        "target",
        "costs",
    } <= parts


def test_every_limit_of_the_devices_has_a_value_a_side_and_a_margin(plan: Plan, lung: Any) -> None:
    found = {finding.name: finding for finding in check(plan, lung).findings}
    assert {name: found[name].side for name in LIMITS} == LIMITS
    for name in LIMITS:
        assert found[name].margin is not None
        assert found[name].detail


def test_verdict_follows_from_margin_and_tolerance(plan: Plan, lung: Any) -> None:
    for finding in check(plan, lung).findings:
        assert (finding.margin is None) == (finding.limit is None) == (finding.side is None)
        if finding.margin is not None:
            assert finding.ok == (finding.margin >= -finding.tolerance)


NUMBER = st.floats(-1e6, 1e6)


@given(value=NUMBER, limit=NUMBER, tolerance=st.floats(0.0, 1.0))
def test_margin_is_positive_inside(value: float, limit: float, tolerance: float) -> None:
    found = Findings()
    found.at_least("a.least", value, limit, "mm", tolerance=tolerance)
    found.at_most("a.most", value, limit, "mm", tolerance=tolerance)
    least, most = found.report().findings
    assert least.margin == value - limit
    assert most.margin == limit - value
    assert least.ok == (value >= limit - tolerance)
    assert most.ok == (value <= limit + tolerance)


def test_clearances_are_distances_from_the_axis(plan: Plan, lung: Any, tools: Any) -> None:
    """Against brute force; the limit is what the plan requires, of the tube with its sideways sweep."""
    found = {finding.name: finding for finding in check(plan, lung).findings}
    frames, _ = tools.follow(
        plan.needle.lps_from_start,
        [(a.length_mm, a.roll_rad, a.curvature_per_mm) for a in plan.needle.arcs],
        0.05,
    )
    for name, bit in (("vessel", structures.VESSEL), ("fissure", structures.FISSURE)):
        finding = found[f"needle.clearance.{name}"]
        wanted = float(tools.brute_distance(lung, (lung.labels & bit) != 0, frames[:, :3, 3]).min())
        assert finding.value == pytest.approx(min(wanted, 20.0), abs=0.03)
        assert finding.limit == pytest.approx(plan.required_clearance_mm["needle"], abs=1e-4)


def test_fissures_that_may_be_crossed_are_measured_all_the_same(
    plan: Plan, lung: Any, system: Any, tools: Any
) -> None:
    crossing = override(system, {"fissures_allowed": True, "name": "own"})
    allowed = tools.changed(
        tools.toy_plan(lung, crossing, plan.tube.outer_insertion_mm, plan.tube.inner_insertion_mm),
        fissures_are_obstacles=False,
    )
    found = {finding.name: finding for finding in check(allowed, lung).findings}
    for stage in ("tube", "needle"):
        finding = found[f"{stage}.clearance.fissure"]
        assert finding.ok and finding.value is not None and finding.limit is None
        assert "may be crossed" in finding.detail


def test_without_a_fissure_mask_fissures_are_not_checked_and_never_ok(
    plan: Plan, lung: Any, system: Any, tools: Any
) -> None:
    blind = SimpleNamespace(**{**vars(lung), "has_fissures": False})
    free = tools.changed(plan, fissures_are_obstacles=False)
    stated = {stage: {k: v for k, v in d.items() if k != "fissure"} for stage, d in free.clearance_mm.items()}
    report = check(tools.changed(free, clearance_mm=stated), blind)
    names = ["needle.clearance.fissure", "patient.fissures", "tube.clearance.fissure"]
    assert sorted(report.to_mapping()["not_checked"]) == names  # type: ignore[call-overload]
    # The plan's cost counts its distance from the fissure; nothing else is wrong without the mask.
    assert [each.name for each in report.refusals] == ["costs.inverse_clearance"]
    for finding in report.unchecked:
        assert finding.value is None and finding.cells()[0] == "not checked"
        assert finding.to_mapping()["ok"] is None and str(finding).startswith("not checked")
    shown = [row for table in check_tables(report) for row in table.columns[0].cells]
    assert sum("not checked" in str(cell) for cell in shown) == len(names)
    page = tables.check_section(report)
    assert page.count("? not checked") == len(names) and "3 things could not be checked" in page
    assert "not checked patient.fissures" in readme(plan, report, ("plan.json",))
    # A distance from fissures that nobody knows is no statement of a plan.
    assert "patient.fissures" in {each.name for each in check(free, blind).refusals}


def test_report_as_json(plan: Plan, lung: Any, tools: Any) -> None:
    wrong = tools.changed(plan, needle__end_lps=plan.needle.end_lps + [0.0, 1.0, 0.0])
    report = check(wrong, lung)
    text = json.loads(json.dumps(report.to_mapping(), allow_nan=False))
    assert text["accepted"] is False
    assert [each["name"] for each in text["findings"] if each["ok"] is False] == ["needle.end"]
    (finding,) = report.refusals
    assert next(each for each in text["findings"] if each["name"] == "needle.end") == {
        "name": "needle.end",
        "stage": "needle",
        "ok": False,
        "side": "at most",
        "value": finding.value,
        "limit": 0.001,
        "margin": finding.margin,
        "tolerance": 0.0,
        "unit": "mm",
        "detail": finding.detail,
    }


def test_a_number_that_is_not_finite_has_no_place_in_json() -> None:
    made = Finding(name="a.b", ok=False, value=math.inf, limit=1.0, side="at most")
    assert made.to_mapping()["value"] is None and made.to_mapping()["margin"] is None
    assert made.to_mapping()["limit"] == 1.0
    assert np.isneginf(made.margin)
