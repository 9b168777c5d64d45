"""The command `lungaccess report`: everything about a plan on one page that opens offline."""

from pathlib import Path
from typing import TYPE_CHECKING

from anatomy.base.files import require_writable_folder
from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import CountOrNone, SamplesOrNone, Seed
from lungaccess.cli.options import ErrorOptions, PatientOfPlan, PatientOptions
from lungaccess.cli.plan_search import HISTORY_FILE
from lungaccess.cli.progress import progress
from lungaccess.cli.result_folder import keep_earlier

if TYPE_CHECKING:
    from anatomy.lung import Lung
    from lungaccess.plans.plan import Plan
from lungaccess.cli.shown_ct import CtOption, shown_ct


def report(
    plan: Path,
    patient: PatientOfPlan,
    *,
    out: Path | None = None,
    alternatives: CountOrNone = 0,
    ct: CtOption = None,
    movie: Path | None = None,
    errors: ErrorOptions = ErrorOptions(),
    samples: SamplesOrNone | None = None,
    seed: Seed | None = None,
    instructions: bool = True,
    output: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Write one HTML file about a stored plan: it plays in 3-D, with slices, charts, limits and risk.

    A plan that states its chance of success shows that, unless errors, procedure, samples or seed are given.

    Args:
        plan: The plan.json; cost_over_time.csv beside it is shown, too.
        out: The HTML file; report.html beside the plan if not given.
        alternatives: So many other plans to the same target are searched and shown on demand.
        movie: WebP file for the flight through the airway to the scope's place.
        samples: Deviated plans of the estimate of success; 0 leaves it out; 2000 if not given, or 120
            procedures that measure.
        seed: Seed of that estimate; 0 if not given.
        instructions: Whether instructions for the scope are listed step by step.
    """
    from lungaccess.cli.plan_search import advised
    from lungaccess.judging.appraisal import appraise
    from lungaccess.plans.plan import Plan
    from lungaccess.showing.report.html import PageOptions, bronchoscopy_webp, plan_page

    page = plan.parent / "report.html" if out is None else out
    for file in (page, *([movie] if movie is not None else [])):
        require_writable_folder(file.parent)
    keep_earlier(page)
    stored, model, followed = Plan.load(plan), errors.given(), errors.given_procedure()
    lung = output.load(patient)
    stored.require_lung(lung)
    image = shown_ct(ct, patient)
    with progress("making the page"):
        appraisal = appraise(
            stored, lung, errors=model, procedure=followed, draws=samples, seed=seed, each_kind=True
        )
        options = PageOptions(
            alternatives=_others(stored, lung, alternatives, output) if alternatives else (),
            ct=None if image is None else image.read(),
            ct_name="" if image is None else image.path.name,
            cost_over_time=plan.parent / HISTORY_FILE,
            errors=model,
            procedure=followed,
            risk_samples=samples,
            risk_seed=seed,
            instructions=instructions,
            appraisal=appraisal,
            advice=advised(stored, lung, model, followed, output.cache, appraisal),
        )
        plan_page(stored, lung, page, options)
        if movie is not None:
            bronchoscopy_webp(stored, lung, movie)
    files = [str(file) for file in (page, movie) if file is not None]
    if output.json:
        terminal.show_json({"files": files, "page_bytes": page.stat().st_size})
        return ExitCode.OK
    written = ", ".join(files)
    size = page.stat().st_size / 1e6
    terminal.say(f"Written: {written} (the page has {size:.1f} MB)")
    return ExitCode.OK


def _others(plan: "Plan", lung: "Lung", count: int, output: PatientOptions) -> "tuple[Plan, ...]":
    """Return plans to the target of a plan that differ from each other; none if no direct arc reaches it.

    Of a patient that breathes they have their windows.
    """
    from lungaccess.judging import alternatives
    from lungaccess.plans.no_plan import NoPlan
    from lungaccess.problem.target import Target
    from lungaccess.uncertainty.breathing.window import with_window

    target = Target(lps_mm=plan.target_lps, origin=plan.target_origin)
    atlas = output.open_atlas(lung, plan.system)
    try:
        found = alternatives(lung, plan.system, target, goal=plan.objective, count=count, atlas=atlas)
    except NoPlan:
        return ()
    return tuple(with_window(each.plan, lung) for each in found)
