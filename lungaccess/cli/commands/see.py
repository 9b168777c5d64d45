"""The commands that show a plan: `lungaccess report`, `view` and `steps`; and the CT in their slices."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from anatomy.base.cache import stated_cache
from anatomy.base.errors import SettingsError
from anatomy.base.files import require_writable_folder
from lungaccess.cli import lazy, terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import CountOrNone, Port, SamplesOrNone, Seed
from lungaccess.cli.options import (
    DEFAULT_SYSTEM,
    ErrorOptions,
    PatientOfPlan,
    PatientOptions,
    PlanFile,
    open_atlas,
)
from lungaccess.cli.plan_search import HISTORY_FILE, advised, steps_table
from lungaccess.cli.progress import progress
from lungaccess.cli.result_folder import held, keep_earlier
from lungaccess.plans.no_plan import NoPlan


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
    masks: PatientOptions = PatientOptions(),
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
    page = plan.parent / "report.html" if out is None else out
    for file in (page, *([movie] if movie is not None else [])):
        require_writable_folder(file.parent)
    keep_earlier(page)
    model, followed = errors.given(), errors.given_procedure()
    stored, lung = masks.load_plan(plan, patient)
    image = shown_ct(ct, patient)
    with progress("making the page"):
        appraisal = lazy.appraise(
            stored, lung, errors=model, procedure=followed, draws=samples, seed=seed, each_kind=True
        )
        options = lazy.PageOptions(
            alternatives=_others(stored, lung, alternatives) if alternatives else (),
            ct=None if image is None else image.read(),
            ct_name="" if image is None else image.path.name,
            cost_over_time=plan.parent / HISTORY_FILE,
            errors=model,
            procedure=followed,
            risk_samples=samples,
            risk_seed=seed,
            instructions=instructions,
            appraisal=appraisal,
            advice=advised(stored, lung, model, followed, appraisal),
        )
        lazy.plan_page(stored, lung, page, options)
        if movie is not None:
            lazy.bronchoscopy_webp(stored, lung, movie)
    files = [str(file) for file in (page, movie) if file is not None]
    terminal.tell({"files": files, "page_bytes": page.stat().st_size})
    terminal.say(f"Written: {', '.join(files)} (the page has {page.stat().st_size / 1e6:.1f} MB)")
    return ExitCode.OK


def _others(plan: lazy.Plan, lung: lazy.Lung, count: int) -> tuple[lazy.Plan, ...]:
    """Return plans to the target of a plan that differ from each other; none if no direct arc reaches it.

    Of a patient that breathes they have their windows.
    """
    target = lazy.Target(lps_mm=plan.target_lps, origin=plan.target_origin)
    atlas = open_atlas(lung, plan.system)
    try:
        found = lazy.alternatives(lung, plan.system, target, goal=plan.objective, count=count, atlas=atlas)
    except NoPlan:
        return ()
    return tuple(lazy.with_window(each.plan, lung) for each in found)


def view(
    patient: Path | None = None,
    *,
    system: str = DEFAULT_SYSTEM,
    ct: CtOption = None,
    series: str | None = None,
    out: Path | None = None,
    port: Port | None = None,
    browser: bool = True,
    thick_slices: bool = False,
    masks: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Explore a patient or a CT: click a target, see the feasible exits and better and better plans.

    The page is served to this machine alone, at the address that is printed, until Ctrl-C; nothing is fetched
    from elsewhere.  Needs the extra `view`.

    Args:
        patient: Folder of masks: Med-RAD, TotalSegmentator, or own masks with a patient.toml; or a CT, an
            image file or a folder of DICOM, which is segmented first. Without one the page lets you choose.
        system: System that is shown first: name of a preset, or path of a TOML file.
        series: UID of the DICOM series of a CT, where the folder holds several.
        out: Patient folder for a CT; if not given, NAME-patient here, or NAME-patient-2 where that holds
            another patient. It is taken up again.
        port: Port of this machine; a free one if not given.
        browser: Whether the page is opened in the browser.
        thick_slices: Explore masks from slices of more than 3 mm, which lack small structures.
    """
    import asyncio
    import webbrowser

    from lungaccess.cli.commands.patients import segment

    try:
        from lungaccess.showing.explorer import Address, Explorer, PatientSource
    except ModuleNotFoundError as error:
        raise SettingsError(
            f"The explorer needs {error.name}, which is not installed",
            expected="the extra `view`",
            remedy="pip install 'lungaccess[view]'",
        ) from error
    first = lazy.load_system(system)
    if patient is not None and lazy.is_ct(patient):
        made = out or lazy.patient_folder(patient, series)
        as_json, terminal.console.as_json = terminal.console.as_json, False  # Only the address is told.
        try:
            segment(patient, out=made, series=series, thick_slices=thick_slices, accept=masks.accept)
        finally:
            terminal.console.as_json = as_json
        held.close()  # The explorer writes into the folder, too, when a nodule is added.
        patient = made
    elif out is not None or series is not None:
        raise SettingsError(
            f"{patient or 'No patient'} is no CT, and --{'series' if out is None else 'out'} is for a CT",
            expected="a CT, which is segmented first",
            remedy="Leave the option out to explore masks, or to choose on the page",
        )
    shown = None if patient is None else shown_ct(ct, patient)
    if shown is not None:
        shown.read()  # Here, where a file that is none is refused before anything is shown.
    if patient is not None:
        masks.load(patient, thick_slices=thick_slices)  # Prepared and kept here, with its progress shown.
        patient = patient.resolve()
    own = () if system in lazy.shipped_names() else ((Path(system).resolve(), first),)
    source = PatientSource(
        folder=patient, system=first.name, own=own, cache=stated_cache(), ct=shown, accept=masks.accept
    )

    def started(address: Address) -> None:
        terminal.tell({"address": address.url, "port": address.port})
        terminal.say(f"The explorer is at {address.url}\nCtrl-C ends it.")
        if browser:
            webbrowser.open(address.url)

    asyncio.run(Explorer(source, port or 0).serve(started))
    return ExitCode.OK


def steps(plan: PlanFile, patient: PatientOfPlan, *, masks: PatientOptions = PatientOptions()) -> ExitCode:
    """Print step by step how the bronchoscope of a plan moves; with --json also every state, for motors."""
    stored, lung = masks.load_plan(plan, patient)
    if terminal.console.as_json:
        terminal.tell(lazy.motion_record(stored, lung))
    terminal.show([steps_table(stored, lung)])
    return ExitCode.OK


CtOption = Annotated[
    Path | None,
    Parameter(
        help="CT for the slices, an image file or a folder of DICOM; else ct.nii.gz of the patient's folder, "
        "the CT that was segmented, or the structures of the masks."
    ),
]


def shown_ct(stated: Path | None, patient: Path) -> lazy.CtFile | None:
    """Return the CT that was stated, else the patient's; without one, a warning says where it was looked for.

    Raises:
        FileError: If the record of the patient's segmentation is damaged.
    """
    found = lazy.find_ct(patient) if stated is None else lazy.CtFile(path=stated)
    if found is None or found.path.exists() or stated is not None:
        return found
    terminal.progress_console.print(
        f"The CT that was segmented is no longer at {found.path}, so that slices show the masks; "
        "--ct says where it is.",
        highlight=False,
    )
    return None
