"""The command `lungaccess export`: a plan and its patient for other programs."""

from pathlib import Path

from anatomy.base.errors import SettingsError
from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.options import PatientOfPlan, PatientOptions, PlanFile
from lungaccess.cli.progress import progress
from lungaccess.cli.result_folder import Force, claim_folder
from lungaccess.cli.shown_ct import shown_ct


def export(
    plan: PlanFile,
    patient: PatientOfPlan,
    *,
    slicer: Path | None = None,
    trajectory: Path | None = None,
    models: Path | None = None,
    dicom: Path | None = None,
    ct: Path | None = None,
    anonymise: bool = False,
    force: Force = False,
    output: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Write a stored plan for other programs and systems; exit code 1 if the check refuses it.

    A refused plan is named so for 3D Slicer, and is not written otherwise.

    Args:
        slicer: Folder for the scene, curves, models and segmentation; drag its scene.mrml into 3D Slicer.
        trajectory: Folder for the motion in time: joint values as CSV, and messages of ROS 2 as YAML.
        models: Folder for surfaces of anatomy and devices, as STL and as one glTF, and for the camera of a
            film.
        dicom: Folder for segments, structured report and overview as DICOM, beside the CT's series.
        ct: Folder of the CT's DICOM series for --dicom; the one that was segmented if not given.
        anonymise: Leave name, identity, dates and physicians out of what --dicom writes.
    """
    if all(folder is None for folder in (slicer, trajectory, models, dicom)):
        raise SettingsError(
            "None of --slicer, --trajectory, --models and --dicom is given",
            expected="a folder for 3D Slicer, for the motion in time, for models, or for DICOM",
            remedy="Add --slicer DIR",
        )
    from lungaccess.cli.plan_tables import show_headline
    from lungaccess.judging.appraisal import appraise
    from lungaccess.plans.plan import Plan
    from lungaccess.showing.live import plan_trajectory, write_trajectory
    from lungaccess.showing.model_files import export_models
    from lungaccess.showing.slicer import export_slicer

    for folder in (slicer, trajectory, models, dicom):
        if folder is not None:
            claim_folder(folder, ("*",), force=force)
    stored = Plan.load(plan)
    lung = output.load(patient)
    stored.require_lung(lung)
    written: dict[Path, tuple[str, ...]] = {}
    with progress("checking the plan") as shown:
        appraisal = appraise(stored, lung)
        if slicer is not None:
            written[slicer] = export_slicer(stored, lung, slicer, progress=shown.step).files
        if trajectory is not None and appraisal.accepted:
            written[trajectory] = write_trajectory(plan_trajectory(stored), trajectory)
        if models is not None and appraisal.accepted:
            shown.step("writing models")
            written[models] = export_models(stored, lung, models)
        if dicom is not None and appraisal.accepted:
            from lungaccess.showing.dicom_files import export_dicom

            shown.step("writing DICOM")
            written[dicom] = export_dicom(
                stored, lung, dicom, shown_ct(ct, patient), appraisal, anonymise=anonymise
            )
    if output.json:
        folders = [{"folder": str(folder), "files": list(files)} for folder, files in written.items()]
        answer = {**(folders[0] if folders else {}), "accepted": appraisal.accepted}
        terminal.show_json(answer | ({"others": folders[1:]} if folders[1:] else {}))
    else:
        for folder, files in written.items():
            terminal.say(f"Written to {folder}: {', '.join(files)}")
        show_headline(appraisal.headline)
    return ExitCode.of(appraisal.accepted)
