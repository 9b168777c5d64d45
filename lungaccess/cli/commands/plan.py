"""The command `lungaccess plan`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.panel import Panel

from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import NotNegative
from lungaccess.cli.options import (
    ErrorOptions,
    PatientFolder,
    PatientOptions,
    PlaceOptions,
    SearchOptions,
    SystemOptions,
    TargetOptions,
    ToolText,
)
from lungaccess.cli.plan_search import RESULTS, PlanJob, plan_and_report
from lungaccess.cli.progress import progress
from lungaccess.cli.result_folder import Force, claim_folder

if TYPE_CHECKING:
    from collections.abc import Callable

    from anatomy.lung import Lung
    from lungaccess.cli.plan_search import PlanJob
    from lungaccess.judging.explanation import Explanation
    from lungaccess.planning.coupled import Atlas
    from lungaccess.plans.no_plan import NoPlan
    from lungaccess.problem.system import System

PICTURE, PAGE = "no_plan.png", "no_plan.html"


def plan(
    patient: PatientFolder,
    *,
    target: TargetOptions = TargetOptions(),
    system: SystemOptions = SystemOptions(),
    search: SearchOptions = SearchOptions(),
    through: PlaceOptions = PlaceOptions(),
    errors: ErrorOptions = ErrorOptions(),
    tool: ToolText = None,
    thick_slices: bool = False,
    out: Path = Path("lungaccess-plan"),
    pictures: bool = True,
    explain_time: NotNegative | None = None,
    force: Force = False,
    output: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Plan the access to a target, check the plan, and write plan, pictures and cost over time.

    Args:
        thick_slices: Plan on masks from slices of more than 3 mm, which lack small airways and vessels.
        out: Folder for plan.json, cost_over_time.csv and the pictures.
        pictures: Whether overview.png, tree.png and cost_over_time.png are drawn.
        explain_time: Seconds of processor time, compiling kernels not counted, for what is learned where
            there is no plan: the nearest miss, what blocks, which preset or change of device would do, what
            is proved; 10 if not given, 0 to leave it out. One preset is tried however short the time is.
    """
    from lungaccess.cli.plan_tables import no_plan_record
    from lungaccess.plans.no_plan import NoPlan
    from lungaccess.problem.system import systems_with_tool

    stated = target.stated()
    systems = systems_with_tool(system.candidates(), tool)
    asked = search.asked(systems, errors.given(), errors.given_procedure(), through.stated())
    claim_folder(out, RESULTS, force=force)
    lung = output.load(patient, thick_slices=thick_slices)
    job = PlanJob(asked=asked, target=stated, out=out, output=output, pictures=pictures)
    try:
        return plan_and_report(lung, job)
    except NoPlan as failure:
        # What would help is explained for the target of the masks, where nothing moves.
        if explain_time != 0.0 and not asked.request(lung, stated.resolve(lung)).is_for_window:
            record = explain_and_report(lung, job, failure, search.cost, explain_time)
        elif output.json:
            record = no_plan_record(failure)
        else:
            raise
        if output.json:
            terminal.show_json(record)
        return ExitCode.NEGATIVE


def explain_and_report(
    lung: Lung, job: PlanJob, failure: NoPlan, cost: str, time_s: float | None
) -> dict[str, Any]:
    """Explain a `NoPlan`, write and show what was learned, and return it as plain values.

    Args:
        cost: By which plans of other systems are searched.
        time_s: Processor time for the explanation; the default of `explain_no_plan` if None.
    """
    from lungaccess.judging.explanation import explanation_record, save_explanation

    explanation = _explained(lung, job, failure, cost, time_s)
    written = save_explanation(explanation, job.out)
    if not job.output.json:
        show_explanation(explanation)
    if job.pictures:
        written = (*written, *_drawn(lung, job, explanation))
    record = explanation_record(explanation)
    record |= {"folder": str(job.out), "files": list(written)}
    if not job.output.json:
        terminal.say(f"Written to {job.out}: {', '.join(written)}")
    return record


def _explained(lung: Lung, job: PlanJob, failure: NoPlan, cost: str, time_s: float | None) -> Explanation:
    from lungaccess.judging.explanation import DEFAULT_TIME_S, explain_no_plan
    from lungaccess.planning.coupled import atlas_is_kept, open_atlas

    system, cache = job.asked.systems[0], job.output.cache

    def atlas_of(other: System, on_share: Callable[[float], None]) -> Atlas:
        def tell(share: float) -> None:
            on_share(share)
            shown.step(f"atlas of {other.name}", share)

        return open_atlas(lung, other, cache=cache, progress=tell)

    with progress("no plan: looking for what would help") as shown:
        return explain_no_plan(
            lung,
            system,
            job.target.resolve(lung),
            failure,
            atlas=open_atlas(lung, system, cache=cache, progress=shown.share),
            objective=cost,
            seed=job.asked.fields["seed"],
            time_s=DEFAULT_TIME_S if time_s is None else time_s,
            atlas_of=atlas_of,
            is_kept=lambda other: atlas_is_kept(lung, other, cache=cache),
            on_part=shown.step,
        )


def _drawn(lung: Lung, job: PlanJob, explanation: Explanation) -> tuple[str, ...]:
    from lungaccess.showing.report import no_plan_png
    from lungaccess.showing.report.html import no_plan_page

    with progress("drawing why there is no plan"):
        no_plan_png(explanation, lung, job.out / PICTURE)
    with progress("making the page"):
        no_plan_page(explanation, lung, job.out / PAGE)
    return PICTURE, PAGE


def show_explanation(explanation: Explanation) -> None:
    """Print the headline, then what was learned, the most useful first, then the counted reasons."""
    from lungaccess.judging.explanation import sections

    terminal.console.print(
        Panel(explanation.headline, title="no plan", title_align="left", border_style="yellow")
    )
    terminal.show(terminal.table(each.title, each.headings, each.rows) for each in sections(explanation))
    terminal.show_reasons(explanation.failure)
    if explanation.ran_out_of_time:
        terminal.say(
            f"The explanation took {explanation.time_s:.1f} s of processor time, without compiling kernels; "
            "a longer --explain-time tries the rest."
        )
