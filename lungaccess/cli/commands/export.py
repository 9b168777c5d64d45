"""The command `lungaccess export`: a plan and its patient for other programs."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from anatomy.base.errors import SettingsError
from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.options import PatientOfPlan, PatientOptions, PlanFile
from lungaccess.cli.progress import progress
from lungaccess.cli.result_folder import Force, claim_folder


def export(
    plan: PlanFile,
    patient: PatientOfPlan,
    *,
    slicer: Annotated[
        Path | None,
        Parameter(
            help="Folder for the scene, curves, models and segmentation; drag its scene.mrml into 3D Slicer."
        ),
    ] = None,
    trajectory: Annotated[
        Path | None,
        Parameter(help="Folder for the motion in time: joint values as CSV, and messages of ROS 2 as YAML."),
    ] = None,
    models: Annotated[
        Path | None,
        Parameter(
            help="Folder for surfaces of anatomy and devices, as STL and as one glTF, and for the camera "
            "of a film."
        ),
    ] = None,
    force: Force = False,
    output: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Write a stored plan for 3D Slicer, for robots, or as models; exit code 1 if the check refuses the plan.

    A refused plan is named so for 3D Slicer, and is not written for robots or as models.
    """
    if slicer is None and trajectory is None and models is None:
        raise SettingsError(
            "None of --slicer, --trajectory and --models is given",
            expected="a folder for 3D Slicer, for the motion in time, or for models",
            remedy="Add --slicer DIR",
        )
    from lungaccess.cli.plan_tables import show_headline
    from lungaccess.judging.appraisal import DRAWS, SEED, Headline
    from lungaccess.judging.checking import check
    from lungaccess.plans.plan import Plan
    from lungaccess.showing.live import plan_trajectory, write_trajectory
    from lungaccess.showing.model_files import export_models
    from lungaccess.showing.slicer import export_slicer
    from lungaccess.uncertainty.risk import assess

    for folder in (slicer, trajectory, models):
        if folder is not None:
            claim_folder(folder, ("*",), force=force)
    stored = Plan.load(plan)
    lung = output.load(patient)
    stored.require_lung(lung)
    written: dict[Path, tuple[str, ...]] = {}
    if slicer is not None:
        with progress("exporting") as shown:
            exported = export_slicer(stored, lung, slicer, progress=shown.step)
        written[slicer], report = exported.files, exported.report
    else:
        with progress("checking the plan"):
            report = check(stored, lung)
    if trajectory is not None and report.accepted:
        written[trajectory] = write_trajectory(plan_trajectory(stored), trajectory)
    if models is not None and report.accepted:
        with progress("writing models"):
            written[models] = export_models(stored, lung, models)
    accepted = report.accepted
    if output.json:
        folders = [{"folder": str(folder), "files": list(files)} for folder, files in written.items()]
        answer = {**(folders[0] if folders else {}), "accepted": accepted}
        terminal.show_json(answer | ({"others": folders[1:]} if folders[1:] else {}))
    else:
        for folder, files in written.items():
            terminal.say(f"Written to {folder}: {', '.join(files)}")
        risk = assess(stored, lung, samples=DRAWS, seed=SEED, each_kind=False) if accepted else None
        show_headline(Headline.of(report, risk))
    return ExitCode.of(accepted)
