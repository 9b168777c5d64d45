"""The command `lungaccess demo`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from anatomy.errors import AnatomyError
from anatomy.io.files import require_writable_folder
from lungaccess.cli import terminal
from lungaccess.cli.commands.common import DEFAULT_SYSTEM, OK, require_budget
from lungaccess.cli.commands.plan import search_and_report
from lungaccess.cli.inputs import load_device
from lungaccess.cli.progress import progress
from lungaccess.cli.terminal import console

if TYPE_CHECKING:
    from anatomy.lung import Lung
    from lungaccess.cli.search import SearchRequest

# The first nodule of this synthetic patient can be reached.
DEMO_SEED = 2


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
    from lungaccess.cli.search import SearchRequest, demo_lung

    require_budget(budget, None)
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
    from lungaccess.cli.commands.report import HISTORY_FILE
    from lungaccess.plans.plan import Plan
    from lungaccess.report.html import PageOptions, plan_page

    options = PageOptions(cost_over_time=out / HISTORY_FILE)
    plan_page(Plan.load(out / "plan.json"), lung, out / "report.html", options)


def _first_reachable_nodule(lung: Lung, request: SearchRequest, out: Path, json: bool) -> int:
    """Plan to the nodules in their order until one can be reached."""
    from dataclasses import replace

    from lungaccess.plans.no_plan import NoPlan

    failure: NoPlan | None = None
    for number in range(1, len(lung.targets_lps) + 1):
        try:
            return search_and_report(lung, replace(request, nodule=number), out, json)
        except NoPlan as error:
            terminal.progress_console.print(f"Nodule {number} cannot be reached; trying the next one.")
            failure = error
    raise failure or AnatomyError("The synthetic patient has no nodule", remedy="Choose another --seed")
