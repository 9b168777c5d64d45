"""Goals that are functions of the plan: what it states of them is what they say of it now."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lungaccess.judging.checking.findings import Findings
from lungaccess.plans.plan import Plan
from lungaccess.problem.goals import goals

if TYPE_CHECKING:
    from anatomy.lung import Lung

ROUNDING = 1e-9
"""A function of the same plan may differ by this share of its value on another machine."""


def check_functions(plan: Plan, lung: Lung, found: Findings) -> None:
    """Compute every function that the plan states a value of, where it is known here."""
    known = goals()
    for name, stated in plan.goals.items():
        goal = known.get(name)
        if goal is None or not goal.is_function:
            found.unchecked(f"goals.{name}", "no such goal is known here: import the code that registers it")
            continue
        value = goal.computed(plan, lung)
        found.agrees(f"goals.{name}", stated, value, ROUNDING * abs(value), goal.unit)
