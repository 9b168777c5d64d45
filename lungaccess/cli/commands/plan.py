"""The commands that plan all stages: `lungaccess demo`, `plan` and `alternatives`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from rich.panel import Panel

from anatomy.base.errors import AnatomyError
from anatomy.base.files import write_text
from anatomy.base.words import of_hundred
from lungaccess.cli import lazy, options, plan_search, terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import Count, NotNegative, Seconds, Seed
from lungaccess.cli.progress import progress
from lungaccess.cli.result_folder import Force, claim_folder
from lungaccess.plans.no_plan import NoPlan
from lungaccess.problem.goals import SUCCESS


def demo(
    *,
    out: Path = Path("demo-output"),
    # The cost has settled by then, and a first visitor does not wait long.
    budget: Seconds = 3.0,
    # The first nodule of this synthetic patient can be reached, and its plan becomes better in many steps.
    seed: Seed = 1,
    force: Force = False,
) -> ExitCode:
    """Make a synthetic patient, plan to one of its nodules, check and draw the plan, write a page on it.

    Args:
        out: Folder for plan.json, the pictures and report.html.
        budget: Planning time in seconds.
        seed: Seed of the patient and of the search.
    """
    from lungaccess.cli.anatomy_tables import anatomy_tables

    search = options.SearchOptions(budget=budget, seed=seed)
    claim_folder(out, plan_search.RESULTS, force=force)
    with progress("making a synthetic patient") as shown:
        lung = _demo_lung(seed, shown.step)
    target, systems = lazy.stated_target(None, 1), options.SystemOptions().candidates()
    terminal.show(anatomy_tables(lung)[1:3])
    guide = _what_to_look_at(out)
    job = plan_search.PlanJob(asked=search.asked(systems), target=target, out=out, guide=guide)
    failure: NoPlan | None = None
    for number in range(1, len(lung.targets_lps) + 1):
        try:
            return plan_search.plan_and_report(lung, replace(job, target=lazy.stated_target(None, number)))
        except NoPlan as error:
            terminal.progress_console.print(f"Nodule {number} cannot be reached; trying the next one.")
            failure = error
    raise failure or AnatomyError(
        "The synthetic patient has no nodule",
        remedy="Choose another --seed",
        expected="a patient with a nodule",
    )


def _demo_lung(seed: int, progress: Callable[[str], None]) -> lazy.Lung:
    """Make the synthetic patient of the demonstration; its prepared anatomy is cached.

    An adult, because the presets are: a child's airways hold no bronchoscope of 4 mm.
    """
    # Coarse enough that the patient is made within seconds, fine enough for the airways of the plan.
    images = lazy.make_phantom(seed=seed, size="adult", spacing_mm=1.25).images
    return lazy.open_lung(dict(images.sources), lambda: images, progress=progress)


def _what_to_look_at(out: Path) -> Panel:
    """Return a guide to the pictures of a plan."""
    lines = (
        f"{out / 'overview.png'}: the blue scope stays in the airway, the orange tube leaves through its "
        "wall at the diamond, the magenta needle passes the vessels and ends in the green nodule. R and L "
        "are the patient's right and left. In the two cuts, no full red or grey reaches the dashed lines; "
        "in the graph, no curve enters the red area outside the blue one.",
        f"{out / 'tree.png'}: the airway tree by generation; every branch lies inside the airway.",
        f"{out / 'report.html'}: all of it in 3-D, playing along a slider; open it in a browser.",
    )
    return Panel("\n".join(lines), title="what to look at", title_align="left")


PICTURE, PAGE = "no_plan.png", "no_plan.html"


def plan(
    patient: options.PatientFolder,
    *,
    target: options.TargetOptions = options.TargetOptions(),
    system: options.SystemOptions = options.SystemOptions(),
    search: options.SearchOptions = options.SearchOptions(),
    through: options.PlaceOptions = options.PlaceOptions(),
    errors: options.ErrorOptions = options.ErrorOptions(),
    tool: options.ToolText = None,
    thick_slices: bool = False,
    out: Path = Path("lungaccess-plan"),
    pictures: bool = True,
    explain_time: NotNegative | None = None,
    force: Force = False,
    masks: options.PatientOptions = options.PatientOptions(),
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
    stated = target.stated()
    systems = lazy.systems_with_tool(system.candidates(), tool)
    asked = search.asked(systems, errors.given(), errors.given_procedure(), through.stated())
    claim_folder(out, plan_search.RESULTS, force=force)
    lung = masks.load(patient, thick_slices=thick_slices)
    job = plan_search.PlanJob(asked=asked, target=stated, out=out, pictures=pictures)
    try:
        return plan_search.plan_and_report(lung, job)
    except NoPlan as failure:
        # What would help is explained for the target of the masks, where nothing moves.
        if explain_time == 0.0 or asked.request(lung, stated.resolve(lung)).is_for_window:
            raise
        _explain_and_report(lung, job, failure, search.cost, explain_time)
        return ExitCode.NEGATIVE


def _explain_and_report(
    lung: lazy.Lung, job: plan_search.PlanJob, failure: NoPlan, cost: str, time_s: float | None
) -> None:
    """Explain a `NoPlan`, write and show what was learned.

    Plans of other systems are searched by `cost`; the time is that of `explain_no_plan` if None.
    """
    explanation = _explained(lung, job, failure, cost, time_s)
    written = lazy.save_explanation(explanation, job.out)
    _show_explanation(explanation)
    if job.pictures:
        written = (*written, *_drawn(lung, job, explanation))
    record = lazy.explanation_record(explanation)
    record |= {"folder": str(job.out), "files": list(written)}
    terminal.tell(record)
    terminal.say(f"Written to {job.out}: {', '.join(written)}")


def _explained(
    lung: lazy.Lung, job: plan_search.PlanJob, failure: NoPlan, cost: str, time_s: float | None
) -> lazy.Explanation:
    system = job.asked.systems[0]

    def atlas_of(other: lazy.System, on_share: Callable[[float], None]) -> lazy.Atlas:
        def tell(share: float) -> None:
            on_share(share)
            shown.step(f"atlas of {other.name}", share)

        return lazy.open_atlas(lung, other, progress=tell)

    with progress("no plan: looking for what would help") as shown:
        return lazy.explain_no_plan(
            lung,
            system,
            job.target.resolve(lung),
            failure,
            atlas=lazy.open_atlas(lung, system, progress=shown.share),
            objective=cost,
            seed=job.asked.fields["seed"],
            time_s=lazy.DEFAULT_TIME_S if time_s is None else time_s,
            atlas_of=atlas_of,
            is_kept=lambda other: lazy.atlas_is_kept(lung, other),
            on_part=shown.step,
        )


def _drawn(lung: lazy.Lung, job: plan_search.PlanJob, explanation: lazy.Explanation) -> tuple[str, ...]:
    with progress("drawing why there is no plan"):
        lazy.no_plan_png(explanation, lung, job.out / PICTURE)
    with progress("making the page"):
        lazy.no_plan_page(explanation, lung, job.out / PAGE)
    return PICTURE, PAGE


def _show_explanation(explanation: lazy.Explanation) -> None:
    """Print the headline, then what was learned, the most useful first, then the counted reasons."""
    terminal.console.print(
        Panel(explanation.headline, title="no plan", title_align="left", border_style="yellow")
    )
    terminal.show(terminal.table(each.title, each.headings, each.rows) for each in lazy.sections(explanation))
    terminal.show_reasons(explanation.failure)
    if explanation.ran_out_of_time:
        terminal.say(
            f"The explanation took {explanation.time_s:.1f} s of processor time, without compiling kernels; "
            "a longer --explain-time tries the rest."
        )


TRADE_OFF = "trade_off.svg"
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
    patient: options.PatientFolder,
    *,
    target: options.TargetOptions = options.TargetOptions(),
    system: options.SystemOptions = options.SystemOptions(),
    count: Count = 15,
    separation: NotNegative = 5.0,
    search: options.SearchOptions = options.SearchOptions(),
    errors: options.ErrorOptions = options.ErrorOptions(),
    out: Path = Path("lungaccess-alternatives"),
    force: Force = False,
    masks: options.PatientOptions = options.PatientOptions(),
) -> ExitCode:
    """Show plans to one target that differ, check each, and write them.

    Those that no other beats in success, length and clearance together are marked: the Pareto front.

    Args:
        count: How many plans at most.
        separation: The needles of every two plans lie somewhere at least so many mm from each other.
        out: Folder for plan-01.json and so on, and trade_off.svg.
    """
    stated, systems = target.stated(), system.candidates()
    asked = search.asked(systems, errors.given(), errors.given_procedure())
    claim_folder(out, ("plan-*.json", TRADE_OFF), force=force)
    lung = masks.load(patient)
    request = asked.request(lung, stated.resolve(lung))
    with progress("searching") as shown:

        def atlas_of(device: lazy.System) -> lazy.Atlas:
            return lazy.open_atlas(lung, device, progress=shown.share)

        found = lazy.answer_with_several(request, count=count, separation_mm=separation, atlas_of=atlas_of)
    chosen, by_success = plan_search.system_of(found[0].plan, systems), request.goal is SUCCESS
    given = (None, None) if by_success else (request.errors, request.procedure)
    appraiser = lazy.Appraiser(lung, given[0], procedure=given[1])
    appraisals = []
    with progress("checking") as shown:
        for number, each in enumerate(found, start=1):
            each.plan.save(out / f"plan-{number:02d}.json")
            appraisals.append(appraiser.appraise(each.plan, chosen, target_lps=request.target.lps_mm))
            shown.share(number / len(found))
    found = lazy.with_front([each.plan for each in found], [each.headline.chance for each in appraisals])
    if drawing := lazy.trade_off_svg(found):
        write_text(out / TRADE_OFF, drawing)
    refused = sum(not each.accepted for each in appraisals)
    terminal.tell(_records(found, appraisals, out, lung.cost is not None))
    _show(lung, found, appraisals)
    if found[0].plan.system_choice:
        terminal.say(" ".join(found[0].plan.system_choice))
    if len(found) < count:
        terminal.say(
            f"{len(found)} of at most {count} plans: no further direct way was proved whose needle lies "
            f"somewhere {separation:g} mm from these (--separation)"
        )
    terminal.say(f"Written to {out}; the check refuses {refused} of {len(found)}")
    return ExitCode.of(not refused)


def _show(lung: lazy.Lung, found: tuple[lazy.Alternative, ...], appraisals: list[lazy.Appraisal]) -> None:
    best = max(range(len(found)), key=lambda n: _success(appraisals[n]))
    terminal.say(f"Of these plans, plan {best + 1:02d} succeeds most often:")
    plan_search.show_headline(appraisals[best].headline)
    has_map, has_window = lung.cost is not None, lung.motion is not None
    columns = [name for name in COLUMNS if (has_map or name != "map") and (has_window or name != "window")]
    rows = [
        _row(number, each, appraisal, has_map)
        for number, (each, appraisal) in enumerate(zip(found, appraisals, strict=True), start=1)
    ]
    terminal.show([terminal.table(f"Plans to the target in {lung.name}", columns, rows)])
    terminal.say(NOTE)
    if has_window:
        terminal.say(WINDOW_NOTE)


def _success(appraisal: lazy.Appraisal) -> float:
    """Return the estimated chance; of a refused plan less than of any other."""
    success = appraisal.headline.success
    return -1.0 if success is None else success.value


def _records(
    found: tuple[lazy.Alternative, ...], appraisals: list[lazy.Appraisal], out: Path, has_map: bool
) -> list[dict[str, object]]:
    return [
        {
            "plan": str(out / f"plan-{number:02d}.json"),
            **appraisal.to_mapping(),
            "on_front": bool(each.on_front),
            "branch": int(each.plan.tube.exit.branch),
            "generation": int(each.plan.scope.generation),
            "criteria": lazy.known_costs(each.criteria, has_map=has_map),
        }
        for number, (each, appraisal) in enumerate(zip(found, appraisals, strict=True), start=1)
    ]


def _row(number: int, each: lazy.Alternative, appraisal: lazy.Appraisal, has_map: bool) -> tuple[str, ...]:
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
