"""Appraise plans: check them, estimate their chance of success, and list their limits."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from html import escape
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_value
from anatomy.lung import Lung
from lungaccess.judging.appraisal.headline import Headline
from lungaccess.judging.appraisal.limits import LIMITS_TITLE, SHOWN_LIMITS, Limit, limits_of
from lungaccess.judging.checking import Checker, CheckReport
from lungaccess.planning.success import Estimate, chance_of, estimate_success
from lungaccess.plans.costs import known_costs
from lungaccess.plans.plan import Plan
from lungaccess.plans.record import picked
from lungaccess.plans.scope_steps import motion_record
from lungaccess.problem.error_files import load_errors
from lungaccess.problem.errors import ErrorModel
from lungaccess.problem.procedures import DEFAULT_PROCEDURE, Procedure, load_procedure
from lungaccess.problem.system import System
from lungaccess.uncertainty.risk import Share, assess

DRAWS = 2000
"""A share of one half is then known to 2 % with 95 % confidence, within a tenth of a second."""
MEASURED_DRAWS = 120
"""A procedure that plans again on its way takes some 15 ms; one half is known to 9 % from so many."""
SEED = 0
"""The same draws for every plan, so that two plans differ by themselves and not by luck."""


@frozen_value
class Appraisal:
    """What is said of a plan before anything else.

    Args:
        risk: The estimate of success, or what the plan states of one; None for a refused plan and where no
            draws were asked for.
        without_measuring: How often it succeeds in open loop, where the estimate is of a procedure that
            measures.
    """

    check: CheckReport
    risk: Estimate | None
    limits: tuple[Limit, ...]
    without_measuring: Share | None = None

    @property
    def headline(self) -> Headline:
        """Chance of success and verdict of the check, together."""
        return Headline.of(self.check, self.risk, self.without_measuring)

    @property
    def accepted(self) -> bool:
        """Whether the check accepts the plan; says nothing of its chance of success."""
        return self.check.accepted

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the headline and the nearest limits."""
        from anatomy.display import table

        headline, limits = self.headline, self.limits[:SHOWN_LIMITS]
        said = escape(f"{headline.grade.mark} {headline.verdict}: {headline.text}")
        details = "".join(f"<div><small>{escape(each)}</small></div>" for each in headline.details)
        rows = [(each.what, f"{each.found_words}, {each.bound_words}") for each in limits]
        first = f'<div style="color:{headline.grade.colour}"><b>{said}</b></div>'
        return f"{first}{details}{table(rows, LIMITS_TITLE)}"

    def to_mapping(self) -> dict[str, object]:
        """Return headline and limits as plain JSON values."""
        return {
            "accepted": self.accepted,
            "headline": self.headline.to_mapping(),
            "limits": [each.to_mapping() for each in self.limits],
        }


class Appraiser:
    """Appraises many plans of one lung: what the check needs of the lung is prepared once.

    A plan that states its own chance of success is not estimated again if none of these is given.

    Args:
        errors: The errors of devices and target; the preset `breath-hold` if None.
        procedure: What is measured and planned again on the way; the preset `open-loop` if None.
        draws: Number of deviated plans or procedures of an estimate; `DRAWS` if None, or `MEASURED_DRAWS` of
            procedures that measure, and 0 for no estimate.

    Raises:
        SettingsError: If the number of draws is negative.
    """

    def __init__(
        self,
        lung: Lung,
        errors: ErrorModel | None = None,
        *,
        procedure: Procedure | None = None,
        draws: int | None = None,
        seed: int | None = None,
    ) -> None:
        if draws is not None and draws < 0:
            raise SettingsError(f"The number of draws is {draws}", expected="at least 0; 0 for no estimate")
        self._takes_stated = all(given is None for given in (errors, procedure, draws, seed))
        self._errors, self._procedure = errors or load_errors(), procedure or load_procedure()
        usual = DRAWS if self._procedure.is_open_loop else MEASURED_DRAWS
        self._draws, self._seed = usual if draws is None else draws, SEED if seed is None else seed
        self._lung, self._checker = lung, Checker(lung)

    def appraise(
        self,
        plan: Plan,
        system: System | None = None,
        *,
        target_lps: ArrayLike | None = None,
        each_kind: bool = False,
    ) -> Appraisal:
        """Appraise one plan; see `appraise`."""
        report = self._checker.check(plan, system, target_lps=target_lps)
        risk = self._estimated(plan, each_kind) if report.accepted else None
        return Appraisal(
            check=report, risk=risk, limits=limits_of(report.findings, plan),
            without_measuring=self._without_measuring(plan, risk),
        )  # fmt: skip

    def _without_measuring(self, plan: Plan, risk: Estimate | None) -> Share | None:
        """Return how often a plan succeeds in open loop; None where its estimate says that already."""
        if risk is None or chance_of(risk).procedure == DEFAULT_PROCEDURE:
            return None
        return assess(
            plan, self._lung, model=self._errors, samples=DRAWS, seed=self._seed, each_kind=False
        ).succeeds

    def _estimated(self, plan: Plan, each_kind: bool) -> Estimate | None:
        """Return the estimate of a plan, or what it states of one."""
        if self._takes_stated and plan.chance is not None:
            return plan.chance
        if not self._draws:
            return None
        return estimate_success(
            plan, self._lung, errors=self._errors, procedure=self._procedure, samples=self._draws,
            seed=self._seed, each_kind=each_kind,
        )  # fmt: skip


def appraise(
    plan: Plan,
    lung: Lung,
    *,
    errors: ErrorModel | None = None,
    procedure: Procedure | None = None,
    system: System | None = None,
    target_lps: ArrayLike | None = None,
    draws: int | None = None,
    seed: int | None = None,
    each_kind: bool = False,
) -> Appraisal:
    """Check a plan, estimate how likely it succeeds, and list how near it comes to its limits.

    A plan that the check refuses has no chance of success: it must not be used, so none is estimated.

    Args:
        system, target_lps: What was asked for; see `lungaccess.judging.checking.check`.
        each_kind: Whether success under errors of one kind only is estimated, too.
    """
    appraiser = Appraiser(lung, errors, procedure=procedure, draws=draws, seed=seed)
    return appraiser.appraise(plan, system, target_lps=target_lps, each_kind=each_kind)


def plan_record(
    plan: Plan,
    lung: Lung,
    appraisal: Appraisal,
    folder: Path,
    files: tuple[str, ...],
    advice: Sequence[Mapping[str, Any]] = (),
) -> dict[str, Any]:
    """Return what a search for a plan found and wrote; lengths in mm, times in s."""
    return {
        "found": True,
        **appraisal.to_mapping(),
        "refusals": [each.to_mapping() for each in appraisal.check.refusals],
        "not_checked": [each.name for each in appraisal.check.unchecked],
        "folder": str(folder),
        "files": list(files),
        "advice": list(advice),
        **picked(plan, "digest objective cost"),
        "cost_bound": plan.cost_bound or None,
        "gap": plan.gap,
        "costs": known_costs(plan.costs, has_map=lung.cost is not None),
        "system": plan.system.name,
        "system_choice": list(plan.system_choice),
        "clearance_mm": {device: dict(values) for device, values in plan.clearance_mm.items()},
        "iterations": plan.iterations,
        "timing": dict(plan.timing),
        "scope_motion": motion_record(plan, lung),
        "warnings": list(lung.warnings),
        "checks": [asdict(each) for each in lung.findings],
    }
