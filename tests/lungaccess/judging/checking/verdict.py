"""What a check refuses."""

from __future__ import annotations

from typing import Any

from lungaccess.judging.checking import Checker
from lungaccess.plans.plan import Plan

_last: dict[str, Any] = {}
"""The lung that was asked about last, and its checker: many plans of one lung are checked in a row."""


def refusals(plan: Plan, lung: Any, **options: Any) -> set[str]:
    if _last.get("lung") is not lung:
        _last.update(lung=lung, checker=Checker(lung))
    report = _last["checker"].check(plan, **options)
    assert report.accepted == (not report.refusals)
    return {finding.name for finding in report.refusals}
