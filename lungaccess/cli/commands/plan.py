"""The command `lungaccess plan`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from anatomy.base.errors import SettingsError
from anatomy.base.files import require_writable_folder
from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import NotNegative
from lungaccess.cli.options import (
    AUTO,
    SUCCESS,
    WINDOW,
    ErrorOptions,
    PatientFolder,
    PatientOptions,
    PlaceOptions,
    SearchOptions,
    SystemOptions,
    TargetOptions,
    require_map,
    stated_phases,
)
from lungaccess.cli.plan_search import PlanRequest, plan_and_report
from stages.needle import Objective


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
    from lungaccess.uncertainty.breathing.window import require_motion

    for_success, widest = search.objective == SUCCESS, search.objective == WINDOW
    phases = stated_phases(search.phases)
    if for_success or widest:
        _require_plain(f"--objective {search.objective}", search, system)
        search = replace(search, objective=SearchOptions().objective)
    if phases is not None:
        _require_plain("--phases", search, system)
    place = through.stated()
    if place is not None:
        _require_plain(place.option, search, system)
        if for_success or widest or phases is not None:
            raise SettingsError(
                f"{place.option} is asked for with success, a window or phases",
                expected="a cost that is made small",
                remedy="Leave one of them out",
            )
    if phases is not None and for_success:
        raise SettingsError(
            "--phases is asked for with --objective success",
            expected="a cost, or the widest window that holds the phases",
            remedy="Choose --objective window, or leave one of them out",
        )
    Objective.of(search.objective)
    stated = target.stated()
    model, procedure = errors.load(), errors.given_procedure()
    require_writable_folder(out)
    systems = system.candidates()
    lung = output.load(patient, thick_slices=thick_slices)
    require_map(lung, search.objective)
    if widest or phases is not None:
        require_motion(lung)
    request = PlanRequest(
        systems=systems, target=stated, search=search, errors=model, out=out, output=output,
        pictures=pictures, procedure=procedure, for_success=for_success, phases=phases, widest=widest,
        place=place,
    )  # fmt: skip
    try:
        return plan_and_report(lung, request)
    except NoPlan as failure:
        if explain_time != 0.0 and not (widest or phases):
            record = explain_and_report(lung, request, failure, explain_time)
        elif output.json:
            record = no_plan_record(failure)
        else:
            raise
        if output.json:
            terminal.show_json(record)
        return ExitCode.NEGATIVE


def _require_plain(asked: str, search: SearchOptions, system: SystemOptions) -> None:
    """Raise SettingsError unless the search is one that can be made for success or a window."""
    plain = SearchOptions()
    asked_for = search.method, search.needle_planner, search.processes, search.gap
    if asked_for != (plain.method, None, plain.processes, None):
        raise SettingsError(
            f"{asked} is asked for with another search",
            expected="neither --method nor --needle-planner nor --processes nor --gap",
            remedy="Leave them out",
        )
    if system.system == AUTO:
        raise SettingsError(
            f"{asked} is asked for with --system {AUTO}",
            expected="one system",
            remedy="Name a system; `lungaccess presets` lists them",
        )
