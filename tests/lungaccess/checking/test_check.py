"""The check accepts a plan that is right, and says how it looked."""

from __future__ import annotations

from typing import Any

from lungaccess.checking import check
from lungaccess.plans import Plan


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
