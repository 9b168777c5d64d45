"""Search for a plan, check it, write and show it: what the commands `plan` and `demo` do."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from anatomy.base.files import write_text
from anatomy.base.records import frozen_value
from lungaccess.cli import plan_tables, terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.options import PatientOptions, SearchOptions, StatedPlace
from lungaccess.cli.progress import SearchDisplay, progress
from stages.needle import Objective

if TYPE_CHECKING:
    from anatomy.lung import Lung
    from lungaccess.judging.appraisal import Appraisal
    from lungaccess.planning.coupled import Atlas, ProgressEvent
    from lungaccess.planning.procedure import Procedure
    from lungaccess.plans.plan import Plan
    from lungaccess.problem.system import System
    from lungaccess.problem.target import StatedTarget, Target
    from lungaccess.showing.report import CostPoint
    from lungaccess.uncertainty.risk import ErrorModel

PLAN_FILE, HISTORY_FILE = "plan.json", "cost_over_time.csv"
"""The plan, saved as soon as there is one and again when there is a better one; how its cost fell."""
SUMMARY_FILE = "summary.json"
"""What `--json` prints: headline, limits, costs.  The plan's own file states only the plan."""
FAILURE = "chance of failure"
"""What a search for success makes small."""
OUTSIDE = "share of the breath outside the window"
"""What a search for the widest window makes small."""
PICTURES = ("overview.png", "tree.png", "cost_over_time.png")
"""Pictures of a found plan, unless the user wants none."""


class Display(AbstractContextManager[Any], Protocol):
    """What a search is shown on."""

    def update(self, description: str, elapsed_s: float, iteration: int, best_cost: float | None) -> None:
        """Show the state of the search."""

    def better(self, elapsed_s: float, cost: float) -> None:
        """Show that a better plan was found."""

    def interrupted(self) -> None:
        """Show that the user ended the search."""


@frozen_value
class Found:
    """A plan that a search found, and how much of what it makes small is left."""

    plan: Plan
    cost: float


class CostHistory:
    """Collects how the best cost falls while a search runs; its clock is that of the planner."""

    def __init__(self, display: Display) -> None:
        from lungaccess.showing.report import CostPoint

        self._point = CostPoint
        self._display = display
        self._iteration = 0
        self._best: float | None = None
        self.points: list[CostPoint] = []

    def on_progress(self, event: ProgressEvent) -> None:
        """Take over what the planner says about itself."""
        self._iteration = event.iteration
        self._append(event.elapsed_s)
        self._display.update(event.message or event.phase, event.elapsed_s, event.iteration, self._best)

    def on_plan(self, found: Found) -> None:
        """Take over a better plan."""
        self._best, self._iteration = found.cost, found.plan.iterations
        elapsed_s = float(found.plan.timing["planning_s"])
        self._append(elapsed_s)
        self._display.better(elapsed_s, found.cost)

    def _append(self, elapsed_s: float) -> None:
        self.points.append(self._point(elapsed_s=elapsed_s, iteration=self._iteration, best_cost=self._best))


@frozen_value
class PlanRequest:
    """What to plan and where to; of several systems the least invasive that reaches the target is chosen.

    For success the chance that the procedure succeeds is made large, instead of a cost small; for the widest
    window its share of the breath.  Phases are those that the window of the plan has to hold.  A place is
    where the tubes have to leave the airway, or the tip of the scope has to stand.
    """

    systems: tuple[System, ...]
    target: StatedTarget
    search: SearchOptions
    errors: ErrorModel
    out: Path
    output: PatientOptions
    pictures: bool = True
    procedure: Procedure | None = None
    for_success: bool = False
    phases: tuple[float, float] | None = None
    widest: bool = False
    place: StatedPlace | None = None

    @property
    def made_small(self) -> str:
        """What the search makes small, in words, where it is not a cost."""
        return FAILURE if self.for_success else OUTSIDE if self.widest else ""

    @property
    def files(self) -> tuple[str, ...]:
        """Names of the files that a found plan leaves in the folder."""
        return (PLAN_FILE, SUMMARY_FILE, HISTORY_FILE, *(PICTURES if self.pictures else ()))


def run_search(
    lung: Lung, target: Target, request: PlanRequest, display: Display
) -> tuple[Found, list[CostPoint]]:
    """Search until the budget is spent and return the best plan and the history of its cost.

    The first plan is saved as soon as it is found, and the best one at the end, whatever happens after.  An
    interruption from the keyboard ends the search early; the best plan so far is kept.

    Raises
    ------
    lungaccess.plans.no_plan.NoPlan
        If no plan was found.
    """
    from lungaccess.plans.no_plan import NoPlan

    history = CostHistory(display)
    best: Found | None = None
    with display:
        try:
            for found in _plans(lung, target, request, history):
                first, best = best is None, found
                if first:
                    found.plan.save(request.out / PLAN_FILE)
                history.on_plan(found)
        except KeyboardInterrupt:
            if best is None:
                raise
            display.interrupted()
    if best is None:
        raise NoPlan("The search ended without a plan", reasons={}, advice="Give it more time")
    best.plan.save(request.out / PLAN_FILE)
    return best, history.points


def _plans(lung: Lung, target: Target, request: PlanRequest, history: CostHistory) -> Iterator[Found]:
    """Yield better and better plans with the request's system, or with the one that is chosen of several."""
    from lungaccess.judging import plan_with_presets
    from lungaccess.planning.coupled import atlas_event, open_atlas, plan, plan_for_window
    from lungaccess.planning.one_stage import plan_near_exit, plan_near_scope_tip
    from lungaccess.planning.success import plan_for_success

    def atlas_of(system: System) -> Atlas:
        def on_share(share: float) -> None:
            history.on_progress(atlas_event(share))

        return open_atlas(lung, system, cache=request.output.cache, progress=on_share)

    search, system = request.search, request.systems[0]
    limits: dict[str, Any] = {
        "seed": search.seed,
        "iterations": search.iterations,
        "time_s": search.time_s,
        "on_progress": history.on_progress,
    }
    if request.for_success:
        for each in plan_for_success(
            lung, system, target, errors=request.errors, procedure=request.procedure,
            atlas=atlas_of(system), counterfactuals=False, **limits,
        ):  # fmt: skip
            yield Found(plan=each.plan, cost=1.0 - each.succeeds.value)
        return
    if request.phases is not None or request.widest:
        for made in plan_for_window(
            lung, system, target, request.phases, widest=request.widest, objective=search.objective,
            atlas=atlas_of(system), **limits,
        ):  # fmt: skip
            outside = 1.0 - (0.0 if made.window is None else made.window.share)
            yield Found(plan=made, cost=outside if request.widest else made.cost)
        return
    options = limits | {
        "objective": search.objective,
        "method": search.method,
        "needle_planner": search.needle_planner or "",
        "processes": search.processes,
        "gap": search.gap,
    }
    if request.place is not None:
        near = plan_near_exit if request.place.option == "--exit" else plan_near_scope_tip
        plans = near(
            lung, system, target, request.place.lps_mm, within_mm=request.place.within_mm,
            atlas=atlas_of(system), counterfactuals=False, **options,
        )  # fmt: skip
    elif len(request.systems) > 1:
        plans = plan_with_presets(lung, target, systems=request.systems, atlas_of=atlas_of, **options)
    else:
        plans = plan(lung, system, target, atlas=atlas_of(system), counterfactuals=False, **options)
    yield from (Found(plan=each, cost=each.cost) for each in plans)


def plan_and_report(lung: Lung, request: PlanRequest) -> ExitCode:
    """Search, appraise, show headline, limits and plan, draw it, and return the exit code.

    What is known is saved and shown before anything slower begins: the first plan, then the best one with its
    check and its chance of success, then the pictures.

    Raises
    ------
    lungaccess.plans.no_plan.NoPlan
        If no plan was found.
    """
    target, search = request.target.resolve(lung), request.search
    display = SearchDisplay(search.time_s, search.iterations, request.made_small or "cost")
    best, history = run_search(lung, target, request, display)
    # After the search: the first plan does not wait for these.
    from lungaccess.judging.appraisal import appraise, plan_record
    from lungaccess.uncertainty.breathing.window import with_window

    found = best.plan if best.plan.window is not None else with_window(best.plan, lung)
    if found is not best.plan:
        best = replace(best, plan=found)
        found.save(request.out / PLAN_FILE)

    with progress("checking the plan and its chance"):
        appraisal = appraise(
            found,
            lung,
            errors=None if found.chance else request.errors,
            procedure=None if found.chance else request.procedure,
            system=system_of(found, request.systems),
            target_lps=target.lps_mm,
        )
    record = plan_record(found, lung, appraisal, request.out, request.files)
    write_text(request.out / SUMMARY_FILE, terminal.json_text(record))
    if not request.output.json:
        show_plan(found, lung, appraisal)
    write_history(best, history, lung, appraisal, request)
    if request.output.json:
        terminal.show_json(record)
    else:
        terminal.say(f"Written to {request.out}: {', '.join(request.files)}")
    return ExitCode.of(appraisal.accepted)


def system_of(plan: Plan, systems: Sequence[System]) -> System:
    """Return the one of several systems by whose name a plan goes; the first if there is none."""
    return {each.name: each for each in systems}.get(plan.system.name, systems[0])


def show_plan(plan: Plan, lung: Lung, appraisal: Appraisal) -> None:
    """Print headline and limits of a plan, then the plan."""
    plan_tables.show_appraisal(appraisal)
    if plan.window is not None:
        terminal.say(plan.window.words)
    if plan.gap is not None:
        terminal.say(plan.gap_in_words)
    if plan.system_choice:
        terminal.say(" ".join(plan.system_choice))
    terminal.show(plan_tables.plan_tables(plan, lung))
    terminal.show_warnings(lung.warnings)


def write_history(
    found: Found, history: list[CostPoint], lung: Lung, appraisal: Appraisal, request: PlanRequest
) -> None:
    """Write how the cost fell, and the pictures if they are wanted."""
    from lungaccess.showing.report import cost_over_time_csv

    cost_over_time_csv(history, request.out / HISTORY_FILE)
    if request.pictures:
        with progress("drawing the plan"):
            draw_plan(found.plan, history, lung, appraisal, request)


def draw_plan(
    plan: Plan, history: list[CostPoint], lung: Lung, appraisal: Appraisal, request: PlanRequest
) -> None:
    """Write the pictures of a plan and of its search into the request's folder."""
    from lungaccess.showing.report import cost_over_time_png, overview_png, tree_png

    words, out = request.made_small or Objective.of(plan.objective).words, request.out
    overview_png(plan, lung, out / "overview.png", appraisal)
    tree_png(lung, out / "tree.png")
    cost_over_time_png(history, out / "cost_over_time.png", words)
