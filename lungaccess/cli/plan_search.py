"""Search for a plan, check it, write and show it: what the commands `plan` and `demo` do."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from anatomy.records import frozen_value
from lungaccess.cli import plan_tables, terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.options import PatientOptions, SearchOptions
from lungaccess.cli.progress import SearchDisplay, progress
from stages.needle import Objective

if TYPE_CHECKING:
    from anatomy.lung import Lung
    from lungaccess.coupled import ProgressEvent
    from lungaccess.plans.plan import Plan
    from lungaccess.problem.system import System
    from lungaccess.problem.target import StatedTarget, Target
    from lungaccess.report import CostPoint

WRITTEN = ("plan.json", "overview.png", "tree.png", "cost_over_time.png", "cost_over_time.csv")
"""Files that a found plan leaves in its folder."""


class Display(AbstractContextManager[Any], Protocol):
    """What a search is shown on."""

    def update(self, description: str, elapsed_s: float, iteration: int, best_cost: float | None) -> None:
        """Show the state of the search."""

    def better(self, elapsed_s: float, cost: float) -> None:
        """Show that a better plan was found."""

    def interrupted(self) -> None:
        """Show that the user ended the search."""


class CostHistory:
    """Collects how the best cost falls while a search runs; its clock is that of the planner."""

    def __init__(self, display: Display) -> None:
        from lungaccess.report import CostPoint

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

    def on_plan(self, plan: Plan) -> None:
        """Take over a better plan."""
        self._best, self._iteration = plan.cost, plan.iterations
        elapsed_s = float(plan.timing["planning_s"])
        self._append(elapsed_s)
        self._display.better(elapsed_s, plan.cost)

    def _append(self, elapsed_s: float) -> None:
        self.points.append(self._point(elapsed_s=elapsed_s, iteration=self._iteration, best_cost=self._best))


@frozen_value
class PlanRequest:
    """What to plan, and the folder for the files."""

    system: System
    target: StatedTarget
    search: SearchOptions
    out: Path
    output: PatientOptions


def run_search(
    lung: Lung, target: Target, request: PlanRequest, display: Display
) -> tuple[Plan, list[CostPoint]]:
    """Search until the budget is spent and return the best plan and the history of its cost.

    An interruption from the keyboard ends the search early; the best plan so far is kept.

    Raises
    ------
    lungaccess.plans.no_plan.NoPlan
        If no plan was found.
    """
    from lungaccess.coupled import atlas_event, open_atlas, plan
    from lungaccess.plans.no_plan import NoPlan

    history, search, system = CostHistory(display), request.search, request.system
    best: Plan | None = None
    with display:
        atlas = open_atlas(
            lung,
            system,
            cache=request.output.cache,
            progress=lambda share: history.on_progress(atlas_event(share)),
        )
        plans = plan(
            lung,
            system,
            target,
            objective=search.objective,
            method=search.method,
            seed=search.seed,
            iterations=search.iterations,
            time_s=search.time_s,
            atlas=atlas,
            processes=search.processes,
            on_progress=history.on_progress,
        )
        try:
            for best in plans:
                history.on_plan(best)
        except KeyboardInterrupt:
            if best is None:
                raise
            display.interrupted()
    if best is None:
        raise NoPlan("The search ended without a plan", reasons={}, advice="Give it more time")
    return best, history.points


def plan_and_report(lung: Lung, request: PlanRequest) -> ExitCode:
    """Search, check, write everything to the request's folder, show it, and return the exit code.

    Raises
    ------
    lungaccess.plans.no_plan.NoPlan
        If no plan was found.
    """
    from lungaccess.checking import check
    from lungaccess.report import cost_over_time_csv, cost_over_time_png, overview_png, tree_png

    target, search, out = request.target.resolve(lung), request.search, request.out
    found, history = run_search(lung, target, request, SearchDisplay(search.time_s, search.iterations))
    found.save(out / "plan.json")
    with progress("checking and drawing the plan"):
        report = check(found, lung, system=request.system, target_lps=target.lps_mm)
        overview_png(found, lung, out / "overview.png")
        tree_png(lung, out / "tree.png")
        cost_over_time_csv(history, out / "cost_over_time.csv")
        words = Objective.of(found.objective).words
        cost_over_time_png(history, out / "cost_over_time.png", words)
    if request.output.json:
        terminal.show_json(plan_tables.plan_record(found, report, out, WRITTEN))
        return ExitCode.of(report.accepted)
    terminal.show(plan_tables.plan_tables(found))
    terminal.show_warnings(lung.warnings)
    if not report.accepted:
        terminal.show(plan_tables.check_tables(report, refusals_only=True))
    terminal.say(f"Written to {out}: {', '.join(WRITTEN)}")
    terminal.show_verdict(report.accepted)
    return ExitCode.of(report.accepted)
