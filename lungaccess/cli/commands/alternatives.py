"""The command `lungaccess alternatives`: a diverse set of plans to one target."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from anatomy.io.files import require_writable_folder
from lungaccess.cli import terminal
from lungaccess.cli.commands.common import ObjectiveText, require_map
from lungaccess.cli.inputs import load_device, load_lung, require_one_target
from lungaccess.cli.progress import progress
from stages.needle import Objective

if TYPE_CHECKING:
    from lungaccess.coupled import Alternative

ACCEPTED, REFUSED = 0, 1
COLUMNS = (
    "plan", "branch", "scope at", "clearance, mm", "pleura, mm", "in tissue, mm", "1/clearance", "map", "best"
)  # fmt: skip


def alternatives(
    patient: Path,
    *,
    target: str | None = None,
    nodule: int | None = None,
    system: str = "lung-default",
    count: int = 15,
    separation: float = 5.0,
    objective: ObjectiveText = "inverse-clearance",
    allow_fissures: bool | None = None,
    out: Path = Path("lungaccess-alternatives"),
    json: bool = False,
    cache: Path | None = None,
) -> int:
    """Show plans to one target that differ, check each, and write them; those no other beats are marked.

    Parameters
    ----------
    patient : Path
        Folder of masks.
    target : str
        Target point in mm with its frame: ras:x,y,z or lps:x,y,z.
    nodule : int
        Go to the centre of this nodule.
    system : str
        Preset or TOML file.
    count : int
        How many plans at most.
    separation : float
        The needles of every two plans lie somewhere at least so many mm from each other.
    objective : str
        By what the cheapest come first, as for `plan`.
    allow_fissures : bool
        Whether fissures may be crossed; as the system says if not given.
    out : Path
        Folder for plan-01.json and so on.
    json : bool
        Print JSON instead of a table.
    cache : Path
        Folder where the prepared anatomy is kept for the next command.
    """
    from lungaccess.checking import check
    from lungaccess.coupled import alternatives as find_alternatives
    from lungaccess.coupled.atlas_store import open_atlas
    from lungaccess.problem.target import resolve_target

    require_one_target(target, nodule)
    require_writable_folder(out)
    weighed = Objective.of(objective)
    device = load_device(system, allow_fissures)
    lung = load_lung(patient, cache)
    require_map(lung, weighed)
    aim = resolve_target(lung, target, nodule)
    with progress("enumerating what scope and tubes can do") as shown:
        atlas = open_atlas(lung, device, cache=cache, progress=shown.share)
    with progress("searching"):
        found = find_alternatives(
            lung, device, aim, objective=weighed, count=count, separation_mm=separation, atlas=atlas
        )
    accepted = []
    with progress("checking") as shown:
        for number, each in enumerate(found, start=1):
            each.plan.save(out / f"plan-{number:02d}.json")
            accepted.append(check(each.plan, lung).accepted)
            shown.share(number / len(found))
    refused = accepted.count(False)
    if json:
        terminal.show_json(_records(found, accepted, out))
        return REFUSED if refused else ACCEPTED
    terminal.show([terminal.table(f"Ways to the target in {lung.name}", COLUMNS, _rows(found))])
    terminal.console.print(terminal.escaped(f"Written to {out}; the check refuses {refused} of {len(found)}"))
    return REFUSED if refused else ACCEPTED


def _records(found: tuple[Alternative, ...], accepted: list[bool], out: Path) -> list[dict[str, object]]:
    """Return each plan's file, verdict and criteria as plain values."""
    return [
        {
            "plan": str(out / f"plan-{number:02d}.json"),
            "accepted": verdict,
            "no_other_beats_it": bool(each.on_front),
            "branch": int(each.plan.tube.exit.branch),
            "generation": int(each.plan.scope.generation),
            "criteria": {name: float(value) for name, value in each.criteria.items()},
        }
        for number, (each, verdict) in enumerate(zip(found, accepted, strict=True), start=1)
    ]


def _rows(found: tuple[Alternative, ...]) -> list[tuple[str, ...]]:
    return [
        (
            f"{number:02d}",
            str(each.plan.tube.exit.branch),
            f"generation {each.plan.scope.generation}",
            f"{each.criteria['clearance_mm']:.2f}",
            f"{each.criteria['pleura_mm']:.2f}",
            f"{each.criteria['length_in_tissue_mm']:.1f}",
            f"{each.criteria['inverse_clearance']:.2f}",
            f"{each.criteria['cost_map']:.2f}",
            "yes" if each.on_front else "",
        )
        for number, each in enumerate(found, start=1)
    ]
