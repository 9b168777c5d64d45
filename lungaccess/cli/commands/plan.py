"""The command `lungaccess plan`, and what `demo` shares with it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from anatomy.io.files import require_writable_folder
from lungaccess.cli import terminal
from lungaccess.cli.commands.common import (
    DEFAULT_BUDGET_S,
    DEFAULT_SYSTEM,
    NO_PLAN,
    OK,
    ObjectiveText,
    print_warnings,
    require_budget,
    require_map,
    verdict,
)  # fmt: skip
from lungaccess.cli.inputs import load_device, load_lung, require_one_target
from lungaccess.cli.progress import SearchDisplay, progress
from lungaccess.cli.terminal import console
from stages.needle import Objective

if TYPE_CHECKING:
    from anatomy.lung import Lung
    from lungaccess.cli.search import SearchRequest

Method = Literal[
    "atlas", "kuntz2015", "kuntz2015-without-rejection", "reference", "reference-without-rejection"
]


def plan(
    patient: Path,
    *,
    target: str | None = None,
    nodule: int | None = None,
    system: str = DEFAULT_SYSTEM,
    budget: float | None = None,
    iterations: int | None = None,
    seed: int = 0,
    objective: ObjectiveText = "inverse-clearance",
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
        voxels crossed, or length; or a weighted sum such as length=1,cost-map=0.5.
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
    from lungaccess.cli.search import SearchRequest

    require_one_target(target, nodule)
    require_budget(budget, iterations)
    require_writable_folder(out)
    device = load_device(system, allow_fissures)
    weighed = Objective.of(objective)
    lung = load_lung(patient, cache, thick_slices=thick_slices)
    require_map(lung, weighed)
    if budget is None and iterations is None:
        budget = DEFAULT_BUDGET_S
    request = SearchRequest(
        system=device,
        target=target,
        nodule=nodule,
        objective=weighed,
        method=method,
        seed=seed,
        time_s=budget,
        iterations=iterations,
        cache=cache,
        processes=processes,
    )
    return _plan_and_report(lung, request, out, json)


def _plan_and_report(lung: Lung, request: SearchRequest, out: Path, json: bool) -> int:
    """Do as `_search_and_report`; that there is no plan is printed as JSON, too, if JSON is asked for."""
    from lungaccess.cli.records import no_plan_record
    from lungaccess.plans.no_plan import NoPlan

    try:
        return search_and_report(lung, request, out, json)
    except NoPlan as failure:
        if not json:
            raise
        terminal.show_json(no_plan_record(failure))
        return NO_PLAN


def search_and_report(lung: Lung, request: SearchRequest, out: Path, json: bool) -> int:
    """Search, check, write everything to `out`, show it, and return the exit code."""
    from lungaccess.checking import check as judge
    from lungaccess.cli.records import plan_record
    from lungaccess.cli.search import run_search
    from lungaccess.problem.target import resolve_target
    from lungaccess.report import cost_over_time_csv, cost_over_time_png, overview_png, tree_png

    target = resolve_target(lung, request.target, request.nodule)
    found, history = run_search(lung, target, request, SearchDisplay(request.time_s, request.iterations))
    found.save(out / "plan.json")
    with progress("checking and drawing the plan"):
        report = judge(found, lung, system=request.system, target_lps=target.lps_mm)
        overview_png(found, lung, out / "overview.png")
        tree_png(lung, out / "tree.png")
        cost_over_time_csv(history, out / "cost_over_time.csv")
        cost_over_time_png(history, out / "cost_over_time.png", request.objective.words)
    written = ("plan.json", "overview.png", "tree.png", "cost_over_time.png", "cost_over_time.csv")
    if json:
        terminal.show_json(plan_record(found, report, out, written))
        return OK if report.accepted else NO_PLAN
    terminal.show(terminal.plan_tables(found))
    print_warnings(lung)
    if not report.accepted:
        terminal.show(terminal.check_tables(report, refusals_only=True))
    console.print(terminal.escaped(f"Written to {out}: {', '.join(written)}"))
    return verdict(report.accepted)
