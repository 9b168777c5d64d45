"""The command `lungaccess export`: a plan and its patient for other programs."""

from __future__ import annotations

from pathlib import Path

from lungaccess.cli import terminal
from lungaccess.cli.inputs import load_lung
from lungaccess.cli.progress import progress

ACCEPTED, REFUSED = 0, 1


def export(
    plan: Path,
    patient: Path,
    *,
    slicer: Path,
    json: bool = False,
    cache: Path | None = None,
) -> int:
    """Write a stored plan and its patient for 3D Slicer; exit code 1 if the check refuses the plan.

    Parameters
    ----------
    plan : Path
        The plan.json.
    patient : Path
        Folder of the patient it was made for.
    slicer : Path
        Folder for the scene, curves, models and segmentation; drag its scene.mrml into 3D Slicer.
    json : bool
        Print JSON instead of text.
    cache : Path
        Folder where the prepared anatomy is kept for the next command.
    """
    from lungaccess.plans.plan import Plan
    from lungaccess.slicer import export_slicer

    stored = Plan.load(plan)
    lung = load_lung(patient, cache)
    with progress("exporting") as shown:
        written = export_slicer(stored, lung, slicer, progress=shown.step)
    if json:
        terminal.show_json({"folder": str(slicer), **written.to_mapping()})
    else:
        terminal.console.print(terminal.escaped(f"Written to {slicer}: {', '.join(written.files)}"))
        terminal.show_verdict(written.report.accepted)
    return ACCEPTED if written.report.accepted else REFUSED
