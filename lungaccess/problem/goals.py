"""Goals: what a plan is to be good at, each stated in one place.

A goal is a cost or a weighted sum of costs, the chance of success, the window of the breath, or a function of
the plan that a user writes.  Searches, the check, tables, studies and pages ask the goal alone what it is
called, which way is better and how large it is.
"""

import math
from collections.abc import Callable
from typing import Any

from anatomy.base.errors import SettingsError
from anatomy.base.plugins import registered
from anatomy.base.records import frozen_record
from anatomy.base.words import of_hundred

PlanFunction = Callable[[Any, Any], float]
"""A number of a `lungaccess.plans.plan.Plan` in a `anatomy.lung.Lung`."""


@frozen_record
class Goal:
    """What is made small, or large.

    Args:
        of: Returns its value of a plan in a lung, finite; the plan states it, and the check computes it
            again.  None for costs, success and windows, which a plan states by itself.
        objective: The costs that it weighs, where it is a cost.
    """

    name: str
    words: str
    unit: str = ""
    larger_is_better: bool = False
    of: PlanFunction | None = None
    objective: Any = None

    @classmethod
    def of_costs(cls, objective: Any) -> "Goal":
        """Return the goal to make a weighted sum of costs small: a `stages.needle.Objective`."""
        return cls(name=str(objective), words=objective.words, objective=objective)

    @property
    def is_function(self) -> bool:
        """Whether it is a function that is written in Python."""
        return self.of is not None

    @property
    def is_share(self) -> bool:
        """Whether it is a share, of procedures or of the breath, which is read as a number of 100."""
        return self.name in (SUCCESS.name, WINDOW.name)

    @property
    def words_with_unit(self) -> str:
        """The words for figures and tables."""
        return f"{self.words} ({self.unit})" if self.unit else self.words

    def value(self, plan: Any) -> float | None:
        """Return what a plan states of it; None where it states nothing."""
        if self.is_function:
            stated: dict[str, float] = plan.goals
            return stated.get(self.name)
        if self.name == SUCCESS.name:
            return None if plan.chance is None else float(plan.chance.share)
        if self.name == WINDOW.name:
            return None if plan.window is None else float(plan.window.share)
        return None if self.objective is None else plan.costs.get(str(self.objective))

    def computed(self, plan: Any, lung: Any) -> float:
        """Return the value of its function of a plan; SettingsError if that fails or is no finite number."""
        try:
            value = float(self.of(plan, lung)) if self.of is not None else math.nan
        except Exception as error:
            raise SettingsError(
                f"The function of the goal {self.name!r} fails: {type(error).__name__}: {error}",
                expected="a function of a plan and its lung that returns a number",
                remedy="Mend the function",
            ) from error
        if not math.isfinite(value):
            raise SettingsError(f"The goal {self.name!r} is {value}", expected="a finite number")
        return value

    def loss(self, plan: Any) -> float:
        """Return what is left to improve of a plan, which falls: the cost, or what a share lacks of 1."""
        value = self.value(plan)
        if value is None:
            return math.inf
        if self.is_function:
            return -value if self.larger_is_better else value
        return 1.0 - value if self.larger_is_better else value

    def said(self, value: float) -> str:
        """Return a value as people read it: shares of a hundred, other numbers with their unit."""
        if self.is_share:
            return f"{of_hundred(value)} of 100"
        return f"{value:.4g} {self.unit}".rstrip()


SUCCESS = Goal(name="success", words="chance of success", larger_is_better=True)
"""The chance that the procedure ends well under the stated errors: the goal of whoever states none."""
WINDOW = Goal(name="window", words="share of the breath in which the plan is proved", larger_is_better=True)
"""The widest window of the breath."""
PLUGINS = "lungaccess.goals"
"""The group of entry points by which packages add goals."""
REGISTERED: dict[str, Goal] = {}
"""The goals that this process has registered; see `lungaccess.problem.request.register_goal`."""


def goals() -> dict[str, Goal]:
    """Return all goals but costs, by their names: those of the package, of other packages, and registered."""
    return {each.name: each for each in (SUCCESS, WINDOW)} | registered(PLUGINS) | REGISTERED
