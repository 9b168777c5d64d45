"""Estimates of risk and checks of any outcome, for tests of what is made of them."""

from __future__ import annotations

from types import MappingProxyType
from typing import Any

import pytest

from lungaccess.judging.checking import CheckReport, Finding
from lungaccess.plans.plan import Plan
from lungaccess.problem.error_files import load_errors
from lungaccess.problem.errors import ErrorModel
from lungaccess.problem.system import System
from lungaccess.uncertainty.risk.assessment import RiskReport
from lungaccess.uncertainty.risk.statistics import Share

TOUCHES = ("vessel", "pleura", "airway", "stays in the airway")


def make_risk(
    succeeds: int,
    draws: int = 2000,
    *,
    reaches: int | None = None,
    model: ErrorModel | None = None,
    **touches: int,
) -> RiskReport:
    """Return an estimate of so many successes, as many of which reach the goal unless stated otherwise."""

    def share(count: int) -> Share:
        return Share(count=count, samples=draws)

    return RiskReport(
        model=model or load_errors(),
        samples=draws,
        seed=0,
        radius_mm=2.5,
        radius_origin="given",
        succeeds=share(succeeds),
        reaches=share(succeeds if reaches is None else reaches),
        touches=MappingProxyType({name: share(touches.get(name, 0)) for name in TOUCHES}),
        forbidden=TOUCHES,
        miss_mm=MappingProxyType({0.5: 1.0}),
        alone=MappingProxyType({}),
    )


def make_check(accepted: bool) -> CheckReport:
    """Return a check with one finding."""
    finding = Finding(
        name="needle.clearance.vessel",
        ok=accepted,
        value=2.6 if accepted else 0.4,
        limit=1.0,
        side="at least",
        unit="mm",
        detail="why",
    )
    return CheckReport(accepted=accepted, findings=(finding,))


def appraise_as_told(monkeypatch: pytest.MonkeyPatch, seen: dict[str, Any]) -> None:
    """Let every check come out as `seen["accepted"]` and every estimate be `seen["risk"]`."""

    def judge(_: object, plan: Plan, system: System | None = None, *, target_lps: Any = None) -> CheckReport:
        seen["judged_with"] = system
        return make_check(seen["accepted"])

    def estimate(*_: Any, errors: ErrorModel | None = None, **options: Any) -> RiskReport:
        seen["errors"] = errors
        return seen["risk"]

    monkeypatch.setattr("lungaccess.judging.checking.checker.Checker.__init__", lambda *_: None)
    monkeypatch.setattr("lungaccess.judging.checking.checker.Checker.check", judge)
    monkeypatch.setattr("lungaccess.judging.appraisal.appraiser.estimate_success", estimate)
