"""The command `lungaccess demo`."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rich.panel import Panel

from anatomy.base.errors import AnatomyError
from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import Seconds, Seed
from lungaccess.cli.options import CacheOptions, SearchOptions, SystemOptions
from lungaccess.cli.plan_search import RESULTS, PlanJob, plan_and_report
from lungaccess.cli.progress import progress
from lungaccess.cli.result_folder import Force, claim_folder

if TYPE_CHECKING:
    from anatomy.lung import Lung


def demo(
    *,
    out: Path = Path("demo-output"),
    # The cost has settled by then, and a first visitor does not wait long.
    budget: Seconds = 3.0,
    # The first nodule of this synthetic patient can be reached, and its plan becomes better in many steps.
    seed: Seed = 1,
    force: Force = False,
    output: CacheOptions = CacheOptions(),
) -> ExitCode:
    """Make a synthetic patient, plan to one of its nodules, check and draw the plan, write a page on it.

    Args:
        out: Folder for plan.json, the pictures and report.html.
        budget: Planning time in seconds.
        seed: Seed of the patient and of the search.
    """
    from lungaccess.cli.anatomy_tables import anatomy_tables
    from lungaccess.problem.target import stated_target

    search = SearchOptions(budget=budget, seed=seed)
    claim_folder(out, RESULTS, force=force)
    with progress("making a synthetic patient") as shown:
        lung = demo_lung(seed, output.cache, shown.step)
    target, systems = stated_target(None, 1), SystemOptions().candidates()
    if not output.json:
        terminal.show(anatomy_tables(lung)[1:3])
    guide = what_to_look_at(out)
    job = PlanJob(asked=search.asked(systems), target=target, out=out, output=output, guide=guide)
    return _first_reachable_nodule(lung, job)


def demo_lung(seed: int, cache: Path | None, progress: Callable[[str], None]) -> "Lung":
    """Make the synthetic patient of the demonstration; its prepared anatomy is cached.

    An adult, because the presets are: a child's airways hold no bronchoscope of 4 mm.
    """
    from anatomy.phantom import make_phantom
    from anatomy.store import open_lung

    # Coarse enough that the patient is made within seconds, fine enough for the airways of the plan.
    images = make_phantom(seed=seed, size="adult", spacing_mm=1.25).images
    return open_lung(dict(images.sources), lambda: images, cache=cache, progress=progress)


def _first_reachable_nodule(lung: "Lung", job: PlanJob) -> ExitCode:
    """Plan to the nodules in their order until one can be reached."""
    from lungaccess.plans.no_plan import NoPlan
    from lungaccess.problem.target import stated_target

    failure: NoPlan | None = None
    for number in range(1, len(lung.targets_lps) + 1):
        try:
            return plan_and_report(lung, replace(job, target=stated_target(None, number)))
        except NoPlan as error:
            terminal.progress_console.print(f"Nodule {number} cannot be reached; trying the next one.")
            failure = error
    raise failure or AnatomyError(
        "The synthetic patient has no nodule",
        remedy="Choose another --seed",
        expected="a patient with a nodule",
    )


def what_to_look_at(out: Path) -> Panel:
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
