"""The command `lungaccess alternatives`: a diverse set of plans to one target."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from anatomy.io.files import require_writable_folder
from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import Count, NotNegative
from lungaccess.cli.options import (
    ObjectiveText,
    PatientFolder,
    PatientOptions,
    SystemOptions,
    TargetOptions,
    require_map,
)
from lungaccess.cli.progress import progress
from stages.needle import Objective

if TYPE_CHECKING:
    from lungaccess.coupled import Alternative

COLUMNS = (
    "plan", "branch", "scope at", "clearance, mm", "pleura, mm", "in tissue, mm", "1/clearance", "map", "best"
)  # fmt: skip


def alternatives(
    patient: PatientFolder,
    *,
    target: TargetOptions = TargetOptions(),
    system: SystemOptions = SystemOptions(),
    count: Annotated[Count, Parameter(help="How many plans at most.")] = 15,
    separation: Annotated[
        NotNegative,
        Parameter(help="The needles of every two plans lie somewhere at least so many mm from each other."),
    ] = 5.0,
    objective: Annotated[
        ObjectiveText, Parameter(help="By what the cheapest come first, as for `plan`.")
    ] = "inverse-clearance",
    out: Annotated[Path, Parameter(help="Folder for plan-01.json and so on.")] = Path(
        "lungaccess-alternatives"
    ),
    output: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Show plans to one target that differ, check each, and write them; those no other beats are marked."""
    from lungaccess.checking import check
    from lungaccess.coupled import alternatives as find_alternatives

    stated, weighed = target.stated(), Objective.of(objective)
    require_writable_folder(out)
    device = system.load()
    lung = output.load(patient)
    require_map(lung, weighed)
    aim, atlas = stated.resolve(lung), output.open_atlas(lung, device)
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
    if output.json:
        terminal.show_json(_records(found, accepted, out))
        return ExitCode.of(not refused)
    terminal.show([terminal.table(f"Plans to the target in {lung.name}", COLUMNS, _rows(found))])
    terminal.say(f"Written to {out}; the check refuses {refused} of {len(found)}")
    return ExitCode.of(not refused)


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
