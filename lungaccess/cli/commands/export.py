"""The command `lungaccess export`: a plan and its patient for other programs."""

from __future__ import annotations

from pathlib import Path

from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.options import PatientOfPlan, PatientOptions, PlanFile
from lungaccess.cli.progress import progress


def export(
    plan: PlanFile, patient: PatientOfPlan, *, slicer: Path, output: PatientOptions = PatientOptions()
) -> ExitCode:
    """Write a stored plan and its patient for 3D Slicer; exit code 1 if the check refuses the plan.

    Parameters
    ----------
    slicer : Path
        Folder for the scene, curves, models and segmentation; drag its scene.mrml into 3D Slicer.
    """
    from lungaccess.appraisal import DRAWS, SEED, Headline
    from lungaccess.cli.plan_tables import show_headline
    from lungaccess.plans.plan import Plan
    from lungaccess.risk import assess
    from lungaccess.slicer import export_slicer

    stored = Plan.load(plan)
    lung = output.load(patient)
    with progress("exporting") as shown:
        written = export_slicer(stored, lung, slicer, progress=shown.step)
    accepted = written.report.accepted
    if output.json:
        terminal.show_json({"folder": str(slicer), **written.to_mapping()})
    else:
        terminal.say(f"Written to {slicer}: {', '.join(written.files)}")
        risk = assess(stored, lung, samples=DRAWS, seed=SEED, each_kind=False) if accepted else None
        show_headline(Headline.of(written.report, risk))
    return ExitCode.of(accepted)
