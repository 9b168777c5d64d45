"""Answers to requests: plans with one system, or with the least invasive of several that can."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

from anatomy.base.kernel_clock import working_s
from anatomy.base.records import frozen_record
from anatomy.lung import Lung
from lungaccess.judging.checking import Checker, CheckReport
from lungaccess.planning.coupled.atlas import Atlas, build_atlas
from lungaccess.planning.diverse_plans import COUNT, SEPARATION_MM, Alternative
from lungaccess.planning.diverse_plans import alternatives as find_alternatives
from lungaccess.planning.driver import ProgressEvent
from lungaccess.planning.one_system import run
from lungaccess.planning.searches import require_method
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.plan import Plan
from lungaccess.problem.request import Request
from lungaccess.problem.system import System
from lungaccess.problem.target import Target


@frozen_record
class Attempt:
    """What became of one system that was tried: the first plan found, and what the check says of it."""

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


def answer(
    request: Request,
    *,
    atlas_of: Callable[[System], Atlas] | None = None,
    counterfactuals: bool = True,
    on_attempt: Callable[[System], None] | None = None,
    on_progress: Callable[[ProgressEvent], None] | None = None,
) -> Iterator[Plan]:
    """Answer a request; yield each plan that is better than the one before.

    Of several systems the first whose plan the independent check accepts is chosen, and the search goes on
    with it alone.  `Plan.system_choice` says which were tried and why each failed.

    Args:
        atlas_of: Returns the deployment atlas of a system; made here if None.
        counterfactuals, on_progress: See `lungaccess.planning.driver.run`.
        on_attempt: Told each of several systems before it is tried.

    Raises:
        NoPlan: If no system reaches the target; `attempts` says why, system by system.
        SettingsError, TargetError: See `lungaccess.planning.driver.run`.
    """
    require_method(request)
    if len(request.systems) == 1:
        atlas = None if atlas_of is None else atlas_of(request.system)
        return run(request, atlas=atlas, counterfactuals=counterfactuals, on_progress=on_progress)
    return _in_turn(request, atlas_of, on_attempt or (lambda _system: None), on_progress)


def _in_turn(
    request: Request,
    atlas_of: Callable[[System], Atlas] | None,
    on_attempt: Callable[[System], None],
    on_progress: Callable[[ProgressEvent], None] | None,
) -> Iterator[Plan]:
    """Yield the plans of the first system that reaches the target; each gets a share of the time left."""
    checker, limits, ordered = Checker(request.lung), request.limits, request.systems
    failed: list[Attempt] = []
    left_s = math.inf if limits.time_s is None else limits.time_s
    for number, system in enumerate(ordered):
        on_attempt(system)
        atlas = atlas_of(system) if atlas_of else build_atlas(request.lung, system)
        began = working_s()
        timed = limits.time_s is not None
        share = replace(
            limits,
            time_s=left_s if timed else None,
            first_plan_s=left_s / (len(ordered) - number) if timed else limits.first_plan_s,
        )
        plans = run(
            replace(request.with_system(system), limits=share), atlas=atlas, counterfactuals=False,
            on_progress=on_progress,
        )  # fmt: skip
        attempt = first_attempt(plans, system, checker)
        if attempt.plan is not None and attempt.succeeded:
            choice = _choice_in_words(failed, system, ordered)
            yield replace(attempt.plan, system_choice=choice)
            yield from (replace(better, system_choice=choice) for better in plans)
            return
        failed.append(attempt)
        left_s = max(left_s - (working_s() - began), 0.0)
    raise _none_reaches(failed)


def plan(
    lung: Lung,
    system: System | str | Sequence[System | str],
    target: Target,
    *,
    atlas: Atlas | None = None,
    counterfactuals: bool = True,
    on_progress: Callable[[ProgressEvent], None] | None = None,
    **asked: Any,
) -> Iterator[Plan]:
    """Plan all stages; yield each plan that is better than the one before.

    At the end comes the best one again, with fewer motions of the scope to the same tip where they are found.

    The goal is the chance of success if none is stated: under the errors of the preset `breath-hold`, and a
    procedure that measures the tip of the tubes and plans again.  The first clear plan comes at once, without
    its chance.

    Args:
        system (System, str, or sequence of them): Devices, the name of a preset, the path of a file, "auto"
            for all presets; of several the least invasive that reaches the target is chosen.
        atlas: Of one system, made with `build_atlas` beforehand; made here if None.
        counterfactuals, on_progress: See `lungaccess.planning.driver.run`.
        **asked: Goal, constraints, search and limits: see `lungaccess.problem.request.Request.of`.

    Raises:
        NoPlan, SettingsError, TargetError: See `answer` and `lungaccess.problem.request.Request`.
    """
    request = Request.of(lung, system, target, **asked)
    atlas_of = None if atlas is None else lambda _system: atlas
    return answer(request, atlas_of=atlas_of, counterfactuals=counterfactuals, on_progress=on_progress)


def alternatives(
    lung: Lung,
    system: System | str | Sequence[System | str],
    target: Target,
    *,
    count: int = COUNT,
    separation_mm: float = SEPARATION_MM,
    atlas: Atlas | None = None,
    counterfactuals: bool = True,
    on_progress: Callable[[ProgressEvent], None] | None = None,
    **asked: Any,
) -> tuple[Alternative, ...]:
    """Return a diverse plan set, the best plan first, with its Pareto front.

    Parameters and errors are those of `plan` and of `lungaccess.planning.diverse_plans.alternatives`.
    """
    return answer_with_several(
        Request.of(lung, system, target, **asked), count=count, separation_mm=separation_mm,
        atlas_of=None if atlas is None else lambda _system: atlas,
        counterfactuals=counterfactuals, on_progress=on_progress,
    )  # fmt: skip


def answer_with_several(
    request: Request,
    *,
    count: int = COUNT,
    separation_mm: float = SEPARATION_MM,
    atlas_of: Callable[[System], Atlas] | None = None,
    counterfactuals: bool = True,
    on_progress: Callable[[ProgressEvent], None] | None = None,
) -> tuple[Alternative, ...]:
    """Return a diverse plan set of a request; of several systems the first whose best plan the check accepts.

    Parameters and errors are those of `answer` and `alternatives`.
    """
    require_method(request)
    checker = Checker(request.lung)
    failed: list[Attempt] = []
    several = len(request.systems) > 1
    for each in request.systems:
        atlas = None if atlas_of is None else atlas_of(each)
        try:
            found = find_alternatives(
                request.with_system(each), count=count, separation_mm=separation_mm, atlas=atlas,
                counterfactuals=counterfactuals and not several, on_progress=on_progress,
            )  # fmt: skip
        except NoPlan as failure:
            if not several:
                raise
            failed.append(Attempt(system=each, failure=failure))
            continue
        if not several:
            return found
        best = found[0].plan
        attempt = Attempt(system=each, plan=best, report=checker.check(best, each))
        if attempt.succeeded:
            choice = _choice_in_words(failed, each, request.systems)
            return tuple(replace(one, plan=replace(one.plan, system_choice=choice)) for one in found)
        failed.append(attempt)
    raise _none_reaches(failed)


def first_attempt(plans: Iterator[Plan], system: System, checker: Checker) -> Attempt:
    """Return the first plan of a search with its check, or why there is none."""
    try:
        found = next(plans)
    except NoPlan as failure:
        return Attempt(system=system, failure=failure)
    return Attempt(system=system, plan=found, report=checker.check(found, system))


def _choice_in_words(failed: Sequence[Attempt], chosen: System, systems: Sequence[System]) -> tuple[str, ...]:
    """Say which systems were tried, why each failed, and why one was chosen, in one sentence each."""
    untried = [system.name for system in systems[len(failed) + 1 :]]
    rest = f"; more invasive and not tried: {', '.join(untried)}" if untried else ""
    return (
        *(f"{attempt.system.name}: {attempt.why}." for attempt in failed),
        f"{chosen.name} was chosen: the least invasive of {len(systems)} systems with a plan that the "
        f"independent check accepts{rest}.",
    )


def _none_reaches(failed: Sequence[Attempt]) -> NoPlan:
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
