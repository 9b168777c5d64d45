"""What a check refuses."""

from __future__ import annotations

from typing import Any

from lungaccess.checking import check
from lungaccess.plans.plan import Plan


def refusals(plan: Plan, lung: Any, **options: Any) -> set[str]:
    report = check(plan, lung, **options)
    assert report.accepted == (not report.refusals)
    return {finding.name for finding in report.refusals}
