"""The command `lungaccess alternatives`: a diverse set of plans to one target."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from anatomy.base.words import of_hundred
from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import Count, NotNegative
from lungaccess.cli.options import (
    ErrorOptions,
    PatientFolder,
    PatientOptions,
    SearchOptions,
    SystemOptions,
    TargetOptions,
)
from lungaccess.cli.plan_search import system_of
from lungaccess.cli.progress import progress
from lungaccess.cli.result_folder import Force, claim_folder
from lungaccess.problem.goals import SUCCESS

if TYPE_CHECKING:
    from anatomy.lung import Lung
    from lungaccess.judging.appraisal import Appraisal
    from lungaccess.planning import Alternative
    from lungaccess.planning.coupled import Atlas
    from lungaccess.problem.system import System

PICTURE = "trade_off.svg"
COLUMNS = (
    *("plan", "succeeds", "window", "branch", "gen."),
    *("clear", "pleura", "tissue", "near", "map", "front"),
)
NOTE = (
    "succeeds: of 100; gen.: generation of the scope's tip; clear, pleura: least distance of tubes and "
    "needle from any obstacle and from the pleura, mm, as the plan states it; tissue: way in tissue, mm; "
    "near, map: nearness to obstacles and cost map along the needle; front: no other plan is better in one "
    "of succeeds, clear and tissue and as good in the others.  The plan that succeeds most often of several "
    "owes part of it to luck, which its interval does not count"
)
WINDOW_NOTE = "window: share of the breath in which the plan is proved, %; the front counts it, too"


def alternatives(
    patient: PatientFolder,
    *,
    target: TargetOptions = TargetOptions(),
    system: SystemOptions = SystemOptions(),
    count: Count = 15,
    separation: NotNegative = 5.0,
    search: SearchOptions = SearchOptions(),
    errors: ErrorOptions = ErrorOptions(),
    out: Path = Path("lungaccess-alternatives"),
    force: Force = False,
    output: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Show plans to one target that differ, check each, and write them.

    Those that no other beats in success, length and clearance together are marked: the Pareto front.

    Args:
        count: How many plans at most.
        separation: The needles of every two plans lie somewhere at least so many mm from each other.
        out: Folder for plan-01.json and so on, and trade_off.svg.
    """
    from anatomy.base.files import write_text
    from lungaccess.judging import answer_with_several
    from lungaccess.judging.appraisal import Appraiser
    from lungaccess.planning import with_front
    from lungaccess.planning.coupled import open_atlas
    from lungaccess.showing.report.html import trade_off_svg

    stated, systems = target.stated(), system.candidates()
    asked = search.asked(systems, errors.given(), errors.given_procedure())
    claim_folder(out, ("plan-*.json", PICTURE), force=force)
    lung = output.load(patient)
    request = asked.request(lung, stated.resolve(lung))
    with progress("searching") as shown:

        def atlas_of(device: System) -> Atlas:
            return open_atlas(lung, device, cache=output.cache, progress=shown.share)

        found = answer_with_several(request, count=count, separation_mm=separation, atlas_of=atlas_of)
    chosen, by_success = system_of(found[0].plan, systems), request.goal is SUCCESS
    given = (None, None) if by_success else (request.errors, request.procedure)
    appraiser = Appraiser(lung, given[0], procedure=given[1])
    appraisals = []
    with progress("checking") as shown:
        for number, each in enumerate(found, start=1):
            each.plan.save(out / f"plan-{number:02d}.json")
            appraisals.append(appraiser.appraise(each.plan, chosen, target_lps=request.target.lps_mm))
            shown.share(number / len(found))
    found = with_front([each.plan for each in found], [each.headline.chance for each in appraisals])
    if drawing := trade_off_svg(found):
        write_text(out / PICTURE, drawing)
    refused = sum(not each.accepted for each in appraisals)
    if output.json:
        terminal.show_json(_records(found, appraisals, out, lung.cost is not None))
        return ExitCode.of(not refused)
    _show(lung, found, appraisals)
    if found[0].plan.system_choice:
        terminal.say(" ".join(found[0].plan.system_choice))
    terminal.say(f"Written to {out}; the check refuses {refused} of {len(found)}")
    return ExitCode.of(not refused)


def _show(lung: Lung, found: tuple[Alternative, ...], appraisals: list[Appraisal]) -> None:
    """Print the headline of the plan that succeeds most often, then one row a plan."""
    from lungaccess.cli.plan_tables import show_headline

    best = max(range(len(found)), key=lambda n: _success(appraisals[n]))
    terminal.say(f"Of these plans, plan {best + 1:02d} succeeds most often:")
    show_headline(appraisals[best].headline)
    has_map = lung.cost is not None
    has_window = lung.motion is not None
    columns = [name for name in COLUMNS if (has_map or name != "map") and (has_window or name != "window")]
    rows = [
        _row(number, each, appraisal, has_map)
        for number, (each, appraisal) in enumerate(zip(found, appraisals, strict=True), start=1)
    ]
    terminal.show([terminal.table(f"Plans to the target in {lung.name}", columns, rows)])
    terminal.say(NOTE)
    if has_window:
        terminal.say(WINDOW_NOTE)


def _success(appraisal: Appraisal) -> float:
    """Return the estimated chance; of a refused plan less than of any other."""
    success = appraisal.headline.success
    return -1.0 if success is None else success.value


def _records(
    found: tuple[Alternative, ...], appraisals: list[Appraisal], out: Path, has_map: bool
) -> list[dict[str, object]]:
    """Return each plan's file, appraisal and criteria as plain values."""
    from lungaccess.plans.costs import known_costs

    return [
        {
            "plan": str(out / f"plan-{number:02d}.json"),
            **appraisal.to_mapping(),
            "on_front": bool(each.on_front),
            "branch": int(each.plan.tube.exit.branch),
            "generation": int(each.plan.scope.generation),
            "criteria": known_costs(each.criteria, has_map=has_map),
        }
        for number, (each, appraisal) in enumerate(zip(found, appraisals, strict=True), start=1)
    ]


def _row(number: int, each: Alternative, appraisal: Appraisal, has_map: bool) -> tuple[str, ...]:

    success = appraisal.headline.success
    return (
        f"{number:02d}",
        "refused" if success is None else of_hundred(success.value),
        *([] if each.plan.window is None else [of_hundred(each.plan.window.share)]),
        str(each.plan.tube.exit.branch),
        str(each.plan.scope.generation),
        f"{each.criteria['clearance_mm']:.2f}",
        f"{each.criteria['pleura_mm']:.2f}",
        f"{each.criteria['length_in_tissue_mm']:.1f}",
        f"{each.criteria['inverse_clearance']:.2f}",
        *([f"{each.criteria['cost_map']:.2f}"] if has_map else []),
        "yes" if each.on_front else "",
    )
