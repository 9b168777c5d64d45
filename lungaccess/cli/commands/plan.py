"""The command `lungaccess plan`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from anatomy.base.files import require_writable_folder
from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import NotNegative
from lungaccess.cli.options import (
    ErrorOptions,
    PatientFolder,
    PatientOptions,
    PlaceOptions,
    SearchOptions,
    SystemOptions,
    TargetOptions,
)
from lungaccess.cli.plan_search import PlanJob, plan_and_report


def plan(
    patient: PatientFolder,
    *,
    target: TargetOptions = TargetOptions(),
    system: SystemOptions = SystemOptions(),
    search: SearchOptions = SearchOptions(),
    through: PlaceOptions = PlaceOptions(),
    errors: ErrorOptions = ErrorOptions(),
    thick_slices: Annotated[
        bool,
        Parameter(help="Plan on masks from slices of more than 3 mm, which lack small airways and vessels."),
    ] = False,
    out: Annotated[Path, Parameter(help="Folder for plan.json, cost_over_time.csv and the pictures.")] = Path(
        "lungaccess-plan"
    ),
    pictures: Annotated[
        bool, Parameter(help="Whether overview.png, tree.png and cost_over_time.png are drawn.")
    ] = True,
    explain_time: Annotated[
        NotNegative | None,
        Parameter(
            help="Seconds of processor time, compiling kernels not counted, for what is learned where there "
            "is no plan: the nearest miss, what blocks, which preset or change of device would do, what is "
            "proved; 10 if not given, 0 to leave it out. One preset is tried however short the time is."
        ),
    ] = None,
    output: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Plan the access to a target, check the plan, and write plan, pictures and cost over time."""
    from lungaccess.cli.no_plan_output import explain_and_report
    from lungaccess.cli.plan_tables import no_plan_record
    from lungaccess.plans.no_plan import NoPlan

    stated = target.stated()
    systems = system.candidates()
    asked = search.asked(systems, errors.given(), errors.given_procedure(), through.stated())
    require_writable_folder(out)
    lung = output.load(patient, thick_slices=thick_slices)
    job = PlanJob(asked=asked, target=stated, out=out, output=output, pictures=pictures)
    try:
        return plan_and_report(lung, job)
    except NoPlan as failure:
        # What would help is explained for the target of the masks, where nothing moves.
        if explain_time != 0.0 and not asked.request(lung, stated.resolve(lung)).is_for_window:
            record = explain_and_report(lung, job, failure, search.cost, explain_time)
        elif output.json:
            record = no_plan_record(failure)
        else:
            raise
        if output.json:
            terminal.show_json(record)
        return ExitCode.NEGATIVE
