"""The command line: plans, what is known about them, and each stage alone.

Exit codes: 0, a plan was found and the independent check accepts it; 1, there is no plan or the check
refuses it; 2, the input is bad.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, CycloptsError, Parameter
from rich.panel import Panel

from anatomy.errors import AnatomyError, LungaccessError, SettingsError
from anatomy.io.files import require_writable_folder
from anatomy.io.frames import Frame
from lungaccess import terminal
from lungaccess.commands_advise import advise
from lungaccess.commands_alternatives import alternatives
from lungaccess.commands_doctor import completion, doctor
from lungaccess.commands_export import export
from lungaccess.commands_reach import reach
from lungaccess.commands_report import report
from lungaccess.commands_risk import risk
from lungaccess.commands_route import route
from lungaccess.commands_segment import segment
from lungaccess.commands_study import study
from lungaccess.commands_tour import tour
from lungaccess.commands_tubes import tubes
from lungaccess.inputs import load_device, load_lung, require_one_target
from lungaccess.progress import SearchDisplay, progress
from lungaccess.terminal import console, error_console

if TYPE_CHECKING:
    from anatomy.grid import Float
    from anatomy.lung import Lung
    from lungaccess.run import SearchRequest

OK, NO_PLAN, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
DEFAULT_SYSTEM = "lung-default"
DEFAULT_BUDGET_S = 10.0
# The first nodule of this synthetic patient can be reached.
DEMO_SEED = 2

Objective = Literal["inverse-clearance", "cost-map", "voxel-sum", "length"]
Method = Literal[
    "atlas", "kuntz2015", "kuntz2015-without-rejection", "reference", "reference-without-rejection"
]
NeedlePlanner = Literal["decide", "rrt", "optimal", "resolution"]

_TOO_LARGE = AnatomyError(
    "There is not enough memory for this patient",
    expected="about 6 GiB free for 512 x 512 x 600 voxels",
    remedy="Close other programs, or resample the masks to 1 mm voxels",
)

OBJECTIVES = {
    "inverse-clearance": "inverse_clearance",
    "cost-map": "cost_map",
    "voxel-sum": "voxel_sum",
    "length": "length_mm",
}


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("lungaccess")
    except PackageNotFoundError:
        return "unknown (not installed)"


app = App(
    name="lungaccess",
    help="Plan access to a lung nodule with three stages: bronchoscope, concentric tubes, steerable needle.",
    help_epilogue="Exit codes: 0 a plan that the check accepts, 1 no plan or a refused one, 2 bad input.",
    version=_version,
    result_action="return_value",
    suppress_keyboard_interrupt=False,
)
app.command(advise)
app.command(alternatives)
app.command(route)
app.command(tour)
app.command(tubes)
app.command(risk)
app.command(reach)
app.command(segment)
app.command(study)
app.command(report)
app.command(export)
app.command(doctor)
app.command(completion)


# Cyclopts would end the process by itself.
app.meta.suppress_keyboard_interrupt = False


@app.meta.default
def _run(
    *words: Annotated[str, Parameter(show=False, allow_leading_hyphen=True)],
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], negative="")] = False,
) -> int | None:
    """Run a command.

    Parameters
    ----------
    quiet : bool
        Print neither results nor progress, only errors and what --json asks for.
    """
    terminal.set_quiet(quiet)
    code: int | None = app(words, exit_on_error=False, error_console=error_console)
    return code


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code; no user error ever shows a traceback.

    Parameters
    ----------
    arguments : sequence of str, optional
        The words after the name of the program; those of this process if None.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        code = app.meta(_with_nodule_number(words), exit_on_error=False, error_console=error_console)
    except CycloptsError:
        return BAD_INPUT
    except LungaccessError as error:
        return _explain(error)
    except MemoryError:
        terminal.show_error(_TOO_LARGE)
        return BAD_INPUT
    except KeyboardInterrupt:
        error_console.print("interrupted")
        return INTERRUPTED
    return int(code or OK)


def _explain(error: LungaccessError) -> int:
    """Print an error for people and return the exit code that belongs to it."""
    from lungaccess.noplan import NoPlan

    if isinstance(error, NoPlan):
        terminal.show_no_plan(error)
        return NO_PLAN
    terminal.show_error(error)
    return BAD_INPUT


def _with_nodule_number(words: list[str]) -> list[str]:
    """Let `--nodule` stand alone for `--nodule 1`."""
    completed: list[str] = []
    for word, following in zip(words, [*words[1:], ""], strict=True):
        completed.append(word)
        if word == "--nodule" and not following.lstrip("+-").isdigit():
            completed.append("1")
    return completed


@app.command
def plan(
    patient: Path,
    *,
    target: str | None = None,
    nodule: int | None = None,
    system: str = DEFAULT_SYSTEM,
    budget: float | None = None,
    iterations: int | None = None,
    seed: int = 0,
    objective: Objective = "inverse-clearance",
    method: Method = "atlas",
    allow_fissures: bool | None = None,
    processes: int = 1,
    thick_slices: bool = False,
    out: Path = Path("lungaccess-plan"),
    json: bool = False,
    cache: Path | None = None,
) -> int:
    """Plan the way to a target, check the plan, and write plan, pictures and cost over time.

    Parameters
    ----------
    patient : Path
        Folder of masks (Med-RAD, TotalSegmentator, or own masks with a lungaccess TOML file).
    target : str
        Target point in mm with its frame: ras:x,y,z or lps:x,y,z.
    nodule : int
        Go to the centre of this nodule of the nodule mask; 1, the largest, if no number follows.
    system : str
        Name of a preset (see `lungaccess presets`) or path of a TOML file.
    budget : float
        Planning time in seconds; 10 if neither this nor --iterations is given.
    iterations : int
        Number of iterations instead of a time: the same seed then gives the same plan.
    seed : int
        Seed of the random numbers.
    objective : str
        What to make small: integral of 1/clearance, integral of the patient's cost map, its sum over the
        voxels crossed, or length.
    method : str
        Search over the deployment atlas; Algorithm 1 of Kuntz et al. 2015; or reference: the same as
        printed, with collisions of surface meshes, slow.
    allow_fissures : bool
        Whether fissures may be crossed; as the system says if not given.
    processes : int
        How many processes refine the plan at the same time.
    thick_slices : bool
        Plan on masks from slices of more than 3 mm, which lack small airways and vessels.
    out : Path
        Folder for plan.json, overview.png, cost_over_time.png and cost_over_time.csv.
    json : bool
        Print JSON instead of tables.
    cache : Path
        Folder where the prepared anatomy is kept for the next command.
    """
    from lungaccess.run import SearchRequest

    require_one_target(target, nodule)
    _require_budget(budget, iterations)
    require_writable_folder(out)
    device = load_device(system, allow_fissures)
    lung = load_lung(patient, cache, thick_slices=thick_slices)
    if objective in ("cost-map", "voxel-sum") and lung.cost is None:
        raise SettingsError(
            f"Patient {lung.name} has no cost map",
            expected=f"a cost map among the patient's files for --objective {objective}",
            remedy="Choose inverse-clearance or length",
        )
    if budget is None and iterations is None:
        budget = DEFAULT_BUDGET_S
    request = SearchRequest(
        system=device,
        target=target,
        nodule=nodule,
        objective=OBJECTIVES[objective],
        method=method,
        seed=seed,
        time_s=budget,
        iterations=iterations,
        cache=cache,
        processes=processes,
    )
    return _plan_and_report(lung, request, out, json)


@app.command
def needle(
    patient: Path,
    *,
    start: str,
    frame: Frame = "lps",
    target: str | None = None,
    nodule: int | None = None,
    system: str = DEFAULT_SYSTEM,
    planner: NeedlePlanner = "decide",
    objective: Objective = "length",
    budget: float | None = None,
    iterations: int | None = None,
    seed: int = 0,
    allow_fissures: bool | None = None,
    json: bool = False,
    cache: Path | None = None,
) -> int:
    """Plan the needle alone from a given pose, or prove that no path exists.

    Parameters
    ----------
    patient : Path
        Folder of masks.
    start : str
        Number of a start pose that came with the patient, or path of a text file with a 4x4 pose whose +z
        column is the direction of insertion.
    frame : str
        Frame of the numbers in that file.
    target : str
        Target point in mm with its frame: ras:x,y,z or lps:x,y,z.
    nodule : int
        Go to the centre of this nodule.
    system : str
        Preset or TOML file whose needle and margins are used.
    planner : str
        decide: a path, or a proof that there is none; rrt; optimal: better and better paths; resolution:
        the best path of pieces at a resolution, or the statement that it has none.
    objective : str
        What to make small: length, integral of 1/clearance, integral of the cost map, or its sum over voxels.
    budget : float
        Planning time in seconds; 10 if neither this nor --iterations is given.
    iterations : int
        Number of iterations instead of a time.
    seed : int
        Seed of the random numbers.
    allow_fissures : bool
        Whether fissures may be crossed; as the system says if not given.
    json : bool
        Print JSON instead of tables.
    cache : Path
        Folder where the prepared anatomy is kept for the next command.
    """
    from lungaccess.needle import plan_needle
    from lungaccess.target import resolve_target

    require_one_target(target, nodule)
    _require_budget(budget, iterations)
    device = load_device(system, allow_fissures)
    lung = load_lung(patient, cache)
    limit_s = DEFAULT_BUDGET_S if budget is None and iterations is None else budget
    pose, aim = _start_pose(lung, start, frame), resolve_target(lung, target, nodule)
    with progress("searching" if limit_s is None else f"searching, at most {limit_s:g} s"):
        answer = plan_needle(
            lung,
            device,
            pose,
            aim,
            planner=planner,
            objective=objective,
            seed=seed,
            iterations=iterations,
            time_s=limit_s,
        )
    if json:
        from lungaccess.records import needle_record

        terminal.show_json(needle_record(answer))
    else:
        terminal.show(terminal.needle_tables(answer))
    return NO_PLAN if answer.path is None else OK


def _start_pose(lung: Lung, start: str, frame: Frame) -> Float:
    """Return a pose by its number among those of the patient, or from a file."""
    from anatomy.io.frames import read_pose

    if not start.isdigit():
        return read_pose(start, frame)
    number = int(start)
    if not 1 <= number <= len(lung.starts):
        raise SettingsError(
            f"There is no start pose {number}",
            expected=f"1 to {len(lung.starts)}" if lung.starts else "a file: the patient came with no pose",
        )
    return lung.starts[number - 1]


@app.command
def check(
    plan: Path,
    patient: Path,
    *,
    system: str | None = None,
    json: bool = False,
    cache: Path | None = None,
) -> int:
    """Judge a stored plan by independent code; exit code 0 if it is accepted, 1 if it is refused.

    Parameters
    ----------
    plan : Path
        The plan.json to judge.
    patient : Path
        Folder of the patient it was made for.
    system : str
        Judge against this preset or TOML file instead of the devices stated in the plan.
    json : bool
        Print JSON instead of tables.
    cache : Path
        Folder where the prepared anatomy is kept for the next command.
    """
    from lungaccess.checking import check as judge
    from lungaccess.plans import Plan

    stored = Plan.load(plan)
    device = None if system is None else load_device(system, None)
    report = judge(stored, load_lung(patient, cache, thick_slices=True), system=device)
    if json:
        terminal.show_json(report.to_mapping())
        return OK if report.accepted else NO_PLAN
    terminal.show(terminal.check_tables(report))
    return _verdict(report.accepted)


@app.command
def info(patient: Path, *, out: Path | None = None, json: bool = False, cache: Path | None = None) -> int:
    """Show what was understood of a patient: volumes, airway tree, sources and warnings.

    Parameters
    ----------
    patient : Path
        Folder of masks.
    out : Path
        Folder for tree.png, a picture of the airway tree.
    json : bool
        Print JSON instead of tables.
    cache : Path
        Folder where the prepared anatomy is kept for the next command.
    """
    if out is not None:
        require_writable_folder(out)
    lung = load_lung(patient, cache, thick_slices=True)
    if json:
        from lungaccess.records import lung_record

        terminal.show_json(lung_record(lung))
    else:
        terminal.show(terminal.anatomy_tables(lung))
        _print_warnings(lung)
    if out is not None:
        from lungaccess.report import tree_png

        picture = tree_png(lung, out / "tree.png")
        if not json:
            console.print(f"Picture of the tree: {picture}")
    return OK


@app.command
def presets(*, json: bool = False) -> int:
    """List the systems that ship with lungaccess.

    Parameters
    ----------
    json : bool
        Print JSON, with every setting, instead of a table.
    """
    from anatomy.settings import to_mapping
    from lungaccess.system import load_system, preset_names

    systems = {name: load_system(name) for name in preset_names()}
    if json:
        terminal.show_json({name: to_mapping(system) for name, system in systems.items()})
    else:
        console.print(terminal.preset_table(systems))
    return OK


@app.command
def demo(
    *,
    out: Path = Path("demo-output"),
    budget: float = 3.0,
    seed: int = DEMO_SEED,
    json: bool = False,
    cache: Path | None = None,
) -> int:
    """Make a synthetic patient, plan to one of its nodules, check and draw the plan, write a page about it.

    Parameters
    ----------
    out : Path
        Folder for plan.json, the pictures and report.html.
    budget : float
        Planning time in seconds.
    seed : int
        Seed of the patient and of the search.
    json : bool
        Print JSON instead of tables.
    cache : Path
        Folder where the prepared anatomy is kept for the next command.
    """
    from lungaccess.run import SearchRequest, demo_lung

    _require_budget(budget, None)
    require_writable_folder(out)
    with progress("making a synthetic patient") as shown:
        lung = demo_lung(seed, cache, shown.step)
    if not json:
        terminal.show(terminal.anatomy_tables(lung)[1:3])
    request = SearchRequest(system=load_device(DEFAULT_SYSTEM, None), seed=seed, time_s=budget, cache=cache)
    code = _first_reachable_nodule(lung, request, out, json)
    if code == OK:
        with progress("making the page"):
            _write_page(lung, out)
        if not json:
            console.print(terminal.what_to_look_at(out))
    return code


def _write_page(lung: Lung, out: Path) -> None:
    """Write report.html about the plan in `out`."""
    from lungaccess.commands_report import HISTORY_FILE
    from lungaccess.plans import Plan
    from lungaccess.report.html import PageOptions, plan_page

    options = PageOptions(cost_over_time=out / HISTORY_FILE)
    plan_page(Plan.load(out / "plan.json"), lung, out / "report.html", options)


def _first_reachable_nodule(lung: Lung, request: SearchRequest, out: Path, json: bool) -> int:
    """Plan to the nodules in their order until one can be reached."""
    from dataclasses import replace

    from lungaccess.noplan import NoPlan

    failure: NoPlan | None = None
    for number in range(1, len(lung.targets_lps) + 1):
        try:
            return _search_and_report(lung, replace(request, nodule=number), out, json)
        except NoPlan as error:
            terminal.progress_console.print(f"Nodule {number} cannot be reached; trying the next one.")
            failure = error
    raise failure or AnatomyError("The synthetic patient has no nodule", remedy="Choose another --seed")


def _plan_and_report(lung: Lung, request: SearchRequest, out: Path, json: bool) -> int:
    """Do as `_search_and_report`; that there is no plan is printed as JSON, too, if JSON is asked for."""
    from lungaccess.noplan import NoPlan
    from lungaccess.records import no_plan_record

    try:
        return _search_and_report(lung, request, out, json)
    except NoPlan as failure:
        if not json:
            raise
        terminal.show_json(no_plan_record(failure))
        return NO_PLAN


def _search_and_report(lung: Lung, request: SearchRequest, out: Path, json: bool) -> int:
    """Search, check, write everything to `out`, show it, and return the exit code."""
    from lungaccess.checking import check as judge
    from lungaccess.records import plan_record
    from lungaccess.report import cost_over_time_csv, cost_over_time_png, overview_png, tree_png
    from lungaccess.run import run_search
    from lungaccess.target import resolve_target

    target = resolve_target(lung, request.target, request.nodule)
    found, history = run_search(lung, target, request, SearchDisplay(request.time_s, request.iterations))
    found.save(out / "plan.json")
    with progress("checking and drawing the plan"):
        report = judge(found, lung, system=request.system, target_lps=target.lps_mm)
        overview_png(found, lung, out / "overview.png")
        tree_png(lung, out / "tree.png")
        cost_over_time_csv(history, out / "cost_over_time.csv")
        cost_over_time_png(history, out / "cost_over_time.png", terminal.objective_words(found.objective))
    written = ("plan.json", "overview.png", "tree.png", "cost_over_time.png", "cost_over_time.csv")
    if json:
        terminal.show_json(plan_record(found, report, out, written))
        return OK if report.accepted else NO_PLAN
    terminal.show(terminal.plan_tables(found))
    _print_warnings(lung)
    if not report.accepted:
        terminal.show(terminal.check_tables(report, refusals_only=True))
    console.print(terminal.escaped(f"Written to {out}: {', '.join(written)}"))
    return _verdict(report.accepted)


def _verdict(accepted: bool) -> int:
    terminal.show_verdict(accepted)
    return OK if accepted else NO_PLAN


def _print_warnings(lung: Lung) -> None:
    if lung.warnings:
        text = terminal.escaped("\n".join(f"- {warning}" for warning in lung.warnings))
        console.print(Panel(text, title="warnings", title_align="left", border_style="yellow"))


def _require_budget(budget: float | None, iterations: int | None) -> None:
    if budget is not None and not 0.0 < budget < float("inf"):
        raise SettingsError(f"--budget is {budget:g} s", expected="a finite time above 0")
    if iterations is not None and iterations < 1:
        raise SettingsError(f"--iterations is {iterations}", expected="at least 1")


__all__ = ["app", "main"]
