"""Search for a plan, check it, write and show it, as tables and as plain values: what several commands do."""

from __future__ import annotations

import math
import shlex
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from anatomy.base.files import write_text
from anatomy.base.records import frozen_value
from anatomy.base.words import of_hundred
from lungaccess.cli import lazy, terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.options import Asked
from lungaccess.cli.progress import SearchDisplay, progress
from lungaccess.plans.no_plan import NoPlan
from stages.needle import Objective

PLAN_FILE, HISTORY_FILE = "plan.json", "cost_over_time.csv"
"""The plan, saved as soon as there is one and again when there is a better one; how its cost fell."""
SUMMARY_FILE = "summary.json"
"""What `--json` prints: headline, limits, costs.  The plan's own file states only the plan."""
PICTURES = ("overview.png", "tree.png", "cost_over_time.png")
"""Pictures of a found plan, unless the user wants none."""
PAGE_FILE = "report.html"
"""The page that `demo` and `report` write beside the plan."""
RESULTS = (PLAN_FILE, SUMMARY_FILE, HISTORY_FILE, *PICTURES, "no_plan.*", "plan-*.json", PAGE_FILE)
"""All files that `plan` may write, and the page beside them."""


class CostHistory:
    """Collects how plans become better while a search runs; its clock is that of the planner."""

    def __init__(self, display: SearchDisplay, goal: lazy.Goal) -> None:
        self._point, self._goal, self._display, self._iteration = lazy.CostPoint, goal, display, 0
        self._best: float | None = None
        self.points: list[lazy.CostPoint] = []

    def on_progress(self, event: lazy.ProgressEvent) -> None:
        """Take over what the planner says about itself."""
        self._iteration = event.iteration
        self._append(event.elapsed_s)
        self._display.update(event.message or event.phase, event.elapsed_s, event.iteration, self._best)

    def on_plan(self, found: lazy.Plan) -> None:
        """Take over a better plan, or the first clear one, of which the goal may not be known yet."""
        self._best, self._iteration = self._goal.value(found), found.iterations
        elapsed_s = float(found.timing["planning_s"])
        self._append(elapsed_s)
        self._display.better(elapsed_s, "" if self._best is None else self._goal.said(self._best))

    def _append(self, elapsed_s: float) -> None:
        self.points.append(self._point(elapsed_s=elapsed_s, iteration=self._iteration, best=self._best))


@frozen_value
class PlanJob:
    """What to plan and where to, and what to do with the plan; with a guide a page is made, too."""

    asked: Asked
    target: lazy.StatedTarget
    out: Path
    pictures: bool = True
    guide: Panel | None = None

    @property
    def files(self) -> tuple[str, ...]:
        """Names of the files that a found plan leaves in the folder."""
        page = () if self.guide is None else (PAGE_FILE,)
        return (PLAN_FILE, SUMMARY_FILE, HISTORY_FILE, *(PICTURES if self.pictures else ()), *page)


def run_search(
    request: lazy.Request, job: PlanJob, display: SearchDisplay
) -> tuple[lazy.Plan, list[lazy.CostPoint]]:
    """Search until the budget is spent; return the best plan and the history of its cost, or raise NoPlan.

    The first plan is saved as soon as it is found, and the best one at the end, whatever happens after.  An
    interruption from the keyboard ends the search early; the best plan so far is kept.
    """
    history = CostHistory(display, request.goal)

    def atlas_of(system: lazy.System) -> lazy.Atlas:
        def on_share(share: float) -> None:
            history.on_progress(lazy.atlas_event(share))

        return lazy.open_atlas(request.lung, system, progress=on_share)

    best: lazy.Plan | None = None
    with display:
        try:
            for found in lazy.answer(
                request, atlas_of=atlas_of, counterfactuals=False, on_progress=history.on_progress
            ):
                if best is None:
                    found.save(job.out / PLAN_FILE)
                best = found
                history.on_plan(found)
        except KeyboardInterrupt:
            if best is None:
                raise
            display.interrupted()
    if best is None:
        raise NoPlan("The search ended without a plan", reasons={}, advice="Give it more time")
    best.save(job.out / PLAN_FILE)
    return best, history.points


def plan_and_report(lung: lazy.Lung, job: PlanJob) -> ExitCode:
    """Search, appraise, show headline, limits and plan, draw it, return the exit code; NoPlan without a plan.

    What is known is saved and shown before anything slower begins: the first plan, then the best one with its
    check and its chance of success, then the pictures.
    """
    request = job.asked.request(lung, job.target.resolve(lung))
    goal, limits = request.goal, request.limits
    best, history = run_search(request, job, SearchDisplay(limits.time_s, limits.iterations, goal.words))
    # After the search: the first plan does not wait for these.

    found = best if best.window is not None else lazy.with_window(best, lung)
    if found is not best:
        found.save(job.out / PLAN_FILE)
    with progress("checking the plan and its chance"):
        appraisal = lazy.appraise(
            found,
            lung,
            errors=None if found.chance else request.errors,
            procedure=None if found.chance else request.procedure,
            system=system_of(found, request.systems),
            target_lps=request.target.lps_mm,
        )
    with progress("looking for what would help"):
        advice = advised(found, lung, request.errors, request.procedure, appraisal)
    record = lazy.plan_record(
        found, lung, appraisal, job.out, job.files, [each.to_mapping() for each in advice]
    )
    write_text(job.out / SUMMARY_FILE, terminal.json_text(record))
    if job.guide is not None:
        terminal.console.print(job.guide)
    _show_plan(found, lung, appraisal, advice)
    lazy.cost_over_time_csv(history, job.out / HISTORY_FILE)
    if job.pictures:
        with progress("drawing the plan"):
            lazy.overview_png(found, lung, job.out / "overview.png", appraisal)
            lazy.tree_png(lung, job.out / "tree.png")
            lazy.cost_over_time_png(history, job.out / "cost_over_time.png", goal)
    if job.guide is not None:
        with progress("making the page"):
            options = lazy.PageOptions(cost_over_time=job.out / HISTORY_FILE, advice=advice)
            lazy.plan_page(found, lung, job.out / PAGE_FILE, options)
    terminal.tell(record)
    terminal.say(f"Written to {job.out}: {', '.join(job.files)}")
    return ExitCode.of(appraisal.accepted)


def advised(
    plan: lazy.Plan,
    lung: lazy.Lung,
    errors: lazy.ErrorModel | None,
    procedure: lazy.Procedure | None,
    appraisal: lazy.Appraisal | None = None,
) -> tuple[lazy.Advice, ...]:
    """Return what would lift the chance of a plan, with the presets whose atlases the cache holds."""

    def kept_atlas(system: lazy.System) -> lazy.Atlas | None:
        is_kept = lazy.atlas_is_kept(lung, system)
        return lazy.open_atlas(lung, system) if is_kept else None

    known = appraisal or lazy.appraise(plan, lung, errors=errors, procedure=procedure)
    return lazy.advise(
        plan, lung, known, errors=errors, procedure=procedure, atlas_of=kept_atlas,
        systems=lazy.presets_by_invasiveness(tool=plan.system.tool),
    )  # fmt: skip


def system_of(plan: lazy.Plan, systems: Sequence[lazy.System]) -> lazy.System:
    """Return the one of several systems by whose name a plan goes; the first if there is none."""
    return {each.name: each for each in systems}.get(plan.system.name, systems[0])


def _show_plan(
    plan: lazy.Plan, lung: lazy.Lung, appraisal: lazy.Appraisal, advice: Sequence[lazy.Advice] = ()
) -> None:
    """Print a plan, its limits and what would lift its chance; the headline comes last, where it is seen."""
    terminal.show(_plan_tables(plan, lung))
    terminal.show_warnings(lung.warnings)
    show_findings(appraisal)
    if plan.window is not None:
        terminal.say(plan.window.words)
    if plan.gap is not None:
        terminal.say(plan.gap_in_words)
    if plan.system_choice:
        terminal.say(" ".join(plan.system_choice))
    _show_advice(advice, appraisal)
    show_headline(appraisal.headline)


GRADE_STYLES = {"good": "green", "fair": "yellow", "unknown": "yellow", "poor": "red"}
MARKS = {True: Text("ok", "green"), False: Text("refused", "bold red"), None: Text("not checked", "yellow")}


def no_plan_record(failure: NoPlan) -> dict[str, Any]:
    """Return why there is no plan."""
    return {
        **lazy.made_by(),
        "found": False,
        "accepted": False,
        "why": failure.found,
        "reasons": dict(failure.reasons),
        "advice": failure.advice,
        "attempts": dict(failure.attempts),
    }


def _plan_tables(plan: lazy.Plan, lung: lazy.Lung) -> list[Table]:
    """Return the stages of a plan and its costs."""
    scope, tube, place = plan.scope, plan.tube, lazy.target_words(lung, plan.target_lps)
    what, steer = ("the tubes beyond the lumen", "") if plan.needle is None else ("the needle", "steer ")
    stages = [
        (
            "scope",
            f"advance {scope.length_from_carina_mm:.1f} mm beyond the carina, to generation "
            f"{scope.generation}",
        ),
        (
            "tubes",
            f"{plan.rotations}, {plan.insertions} beyond the scope; "
            f"through the wall of branch {lung.branch_words(tube.exit.branch)}",
        ),
        ("needle", f"{steer}{plan.way_to_target}" + (f": {place}" if place else "")),
        *((f"pass {number}", said) for number, said in enumerate(plan.redirections, 2)),
        *((("ultrasound", view),) if (view := lazy.view_words(plan, lung)) else ()),
    ]
    return [
        terminal.table("The stages", ("stage", "what to do"), stages),
        steps_table(plan, lung),
        terminal.table(
            f"Costs of {what} (made small: {Objective.of(plan.objective).words})",
            ("cost", "value"),
            lazy.costs_in_words(lazy.known_costs(plan.costs, has_map=lung.cost is not None)),
        ),
    ]


def steps_table(plan: lazy.Plan, lung: lazy.Lung) -> Table:
    """Return step by step what hands do with the bronchoscope."""
    rows = [(str(number), one.text) for number, one in enumerate(lazy.scope_steps(plan, lung), start=1)]
    rows += [
        (f"pass {number}", f"{said[:1].upper()}{said[1:]}.")
        for number, said in enumerate(plan.redirections, 2)
    ]
    note = f"{lazy.handle_words(plan)} {lazy.steps_note(plan, lung)}"
    return terminal.table("The bronchoscope, step by step", ("step", "what to do"), rows, note)


def arcs_table(arcs: Iterable[Sequence[float]]) -> Table:
    """Return the arcs of a needle, each with its length in mm, roll in rad and curvature in 1/mm."""
    rows = [
        (f"{n}", f"{math.degrees(roll):.1f}", f"{length:.2f}", f"{1.0 / bend:.1f}" if bend else "straight")
        for n, (length, roll, bend) in enumerate(arcs, start=1)
    ]
    return terminal.table("arcs of the needle", ("", "roll first, deg", "insert, mm", "radius, mm"), rows)


def show_findings(appraisal: lazy.Appraisal) -> None:
    """Print what the check refuses, if anything, and the limits."""
    for finding in (*appraisal.check.refusals, *appraisal.check.unchecked):
        terminal.say(f"{finding}")
    if appraisal.limits:
        terminal.show([_limits_table(appraisal)])


def show_headline(headline: lazy.Headline) -> None:
    """Print the headline in a panel whose colour, mark and title follow the worse of its two parts."""
    style = GRADE_STYLES[headline.grade.key]
    parts = [(headline.grade.mark, f"bold {style}"), (f" {headline.text}", "bold")]
    parts += [(f"\n{each}", "dim") for each in headline.details]
    title = Text(headline.verdict, f"bold {style}")
    terminal.console.print(
        Panel(terminal.styled(*parts), title=title, title_align="left", border_style=style)
    )


def _show_advice(advice: Sequence[lazy.Advice], appraisal: lazy.Appraisal) -> None:
    """Print what lifts the chance of success most, as it was tried, each with its command."""
    success = appraisal.headline.success
    if not advice or success is None:
        return
    now = of_hundred(success.value)
    rows = [(each.words, of_hundred(each.success.value), _command_with(each.options)) for each in advice]
    title = f"What was found to lift the chance of success, now {now} of 100"
    terminal.show([terminal.table(title, ("with", "of 100", "command"), rows)])


def _command_with(options: Sequence[str]) -> str:
    """Return the command that runs now with other options in place of those of the same name."""
    words, replaced = sys.argv[1:], {options[0], *(["--nodule"] if options[0] == "--target" else [])}
    kept, skips = [], False
    for word in words:
        skips = word in replaced or (skips and not word.startswith("--"))
        kept += [] if skips else [word]
    return shlex.join(["lungaccess", *kept, *options])


def _limits_table(appraisal: lazy.Appraisal) -> Table:
    """Return the limits that the plan comes nearest to; broken ones come first."""
    rows = [
        (each.what, each.found_words, each.bound_words, each.used_words if each.ok else "BROKEN")
        for each in appraisal.limits[: lazy.SHOWN_LIMITS]
    ]
    more = "`lungaccess check PLAN PATIENT --all` lists every finding."
    return terminal.table(lazy.LIMITS_TITLE, ("limit", "measured", "needs", "used"), rows, more)


def check_tables(report: lazy.CheckReport) -> list[Table]:
    """Return all findings of an independent check by stage."""
    tables = {}
    for finding in report.findings:
        if finding.stage not in tables:
            tables[finding.stage] = made = terminal.bare_table(f"Independent check: {finding.stage}")
            made.add_column("")
            made.add_column("what", no_wrap=True)
            for heading in ("found", "limit", "margin"):
                made.add_column(heading, justify="right")
            made.add_column("")
        tables[finding.stage].add_row(MARKS[finding.ok], *finding.cells()[1:])
    return list(tables.values())
