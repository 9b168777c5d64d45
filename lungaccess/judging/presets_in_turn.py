"""Planning with several systems: the least invasive that reaches the target, and why each other failed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

from anatomy.base.errors import SettingsError
from anatomy.base.kernel_clock import working_s
from anatomy.base.records import frozen_record
from anatomy.lung import Lung
from lungaccess.judging.checking import Checker, CheckReport
from lungaccess.planning.coupled.atlas import Atlas, build_atlas
from lungaccess.planning.coupled.planner import plan
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.plan import Plan
from lungaccess.problem.preset_order import least_invasive_first, presets_by_invasiveness
from lungaccess.problem.system import System
from lungaccess.problem.target import Target
from stages.needle import OMPL_PLANNERS


@frozen_record
class Attempt:
    """What became of one system that was tried.

    Parameters
    ----------
    plan : Plan or None
        The first plan found, whether or not the check accepts it.
    report : CheckReport or None
        What the independent check says of that plan.
    failure : NoPlan or None
        Why there is none.
    """

    system: System
    plan: Plan | None = None
    report: CheckReport | None = None
    failure: NoPlan | None = None

    @property
    def succeeded(self) -> bool:
        """Whether there is a plan that the independent check accepts."""
        return self.report is not None and self.report.accepted

    @property
    def why(self) -> str:
        """What became of it, in words."""
        if self.failure is not None:
            return f"no plan: {self.failure.main_reason}"
        if self.report is None:
            return "a plan was found, not checked"
        if self.succeeded:
            return "a plan was found, and the independent check accepts it"
        return f"the independent check refuses the plan: {self.report.refusals[0].name}"


def plan_with_presets(
    lung: Lung,
    target: Target,
    *,
    systems: Sequence[System] = (),
    time_s: float | None = None,
    atlas_of: Callable[[System], Atlas] | None = None,
    on_attempt: Callable[[System], None] | None = None,
    **options: Any,
) -> Iterator[Plan]:
    """Plan with the least invasive system that reaches the target; yield better and better plans.

    The systems are tried one after the other, the least invasive first; see
    `lungaccess.problem.preset_order`.  The first one with a plan that the independent check accepts is
    chosen, and the search goes on with it alone.  `Plan.system_choice` says which were tried and why each
    failed.

    Parameters
    ----------
    systems : sequence of System
        In any order; the presets that ship with the package if empty.
    time_s : float, optional
        Planning time in all, without that of the atlases and of getting kernels.  A system without a plan
        gets an equal share of what is left, so that each one is tried.
    atlas_of : callable, optional
        Returns the deployment atlas of a system; `build_atlas` if None.
    on_attempt : callable, optional
        Told each system before it is tried.
    options
        Those of `lungaccess.planning.coupled.planner.plan`; with `iterations` the same input gives the same
        plans.

    Raises
    ------
    NoPlan
        If no system reaches the target; `attempts` says why, system by system.
    SettingsError
        If two systems have the same name, or the needle planner is one of OMPL.
    """
    ordered = least_invasive_first(systems) if systems else presets_by_invasiveness()
    if options.get("needle_planner") in OMPL_PLANNERS:
        raise SettingsError(
            f"{options['needle_planner']} is to plan with {len(ordered)} systems, one after the other",
            expected="one system: OMPL can be seeded once in a process",
            remedy="Name the system, or choose another needle planner",
        )
    if len({system.name for system in ordered}) < len(ordered):
        raise SettingsError("Two systems have the same name", expected="a name of its own for each")
    checker = Checker(lung)
    failed: list[Attempt] = []
    left_s = math.inf if time_s is None else time_s
    for number, system in enumerate(ordered):
        if on_attempt:
            on_attempt(system)
        atlas = atlas_of(system) if atlas_of else build_atlas(lung, system)
        began = working_s()
        plans = plan(
            lung,
            system,
            target,
            atlas=atlas,
            time_s=None if time_s is None else left_s,
            first_plan_s=None if time_s is None else left_s / (len(ordered) - number),
            counterfactuals=False,
            **options,
        )
        attempt = first_attempt(plans, system, checker)
        if attempt.plan is not None and attempt.succeeded:
            choice = choice_in_words(failed, system, ordered)
            yield replace(attempt.plan, system_choice=choice)
            yield from (replace(better, system_choice=choice) for better in plans)
            return
        failed.append(attempt)
        left_s = max(left_s - (working_s() - began), 0.0)
    raise none_reaches(failed)


def first_attempt(plans: Iterator[Plan], system: System, checker: Checker) -> Attempt:
    """Return the first plan of a search with its check, or why there is none."""
    try:
        found = next(plans)
    except NoPlan as failure:
        return Attempt(system=system, failure=failure)
    return Attempt(system=system, plan=found, report=checker.check(found, system))


def choice_in_words(failed: Sequence[Attempt], chosen: System, systems: Sequence[System]) -> tuple[str, ...]:
    """Say which systems were tried, why each failed, and why one was chosen, in one sentence each."""
    untried = [system.name for system in systems[len(failed) + 1 :]]
    rest = f"; more invasive and not tried: {', '.join(untried)}" if untried else ""
    return (
        *(f"{attempt.system.name}: {attempt.why}." for attempt in failed),
        f"{chosen.name} was chosen: the least invasive of {len(systems)} systems with a plan that the "
        f"independent check accepts{rest}.",
    )


def none_reaches(failed: Sequence[Attempt]) -> NoPlan:
    """Return the `NoPlan` of several systems that all failed."""
    names = ", ".join(attempt.system.name for attempt in failed)
    return NoPlan(
        f"No plan to the target with any of {len(failed)} systems ({names})",
        reasons={
            f"{attempt.system.name}: {reason}": count
            for attempt in failed
            if attempt.failure is not None
            for reason, count in attempt.failure.reasons.items()
        },
        main_reason="; ".join(f"{attempt.system.name}: {attempt.why}" for attempt in failed),
        attempts={attempt.system.name: attempt.why for attempt in failed},
    )
