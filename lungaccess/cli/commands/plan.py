"""The command `lungaccess plan`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from anatomy.errors import SettingsError
from anatomy.io.files import require_writable_folder
from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import NotNegative
from lungaccess.cli.options import (
    AUTO,
    SUCCESS,
    ErrorOptions,
    PatientFolder,
    PatientOptions,
    ProcedureName,
    SearchOptions,
    SystemOptions,
    TargetOptions,
    require_map,
)
from lungaccess.cli.plan_search import PlanRequest, plan_and_report
from stages.needle import Objective

if TYPE_CHECKING:
    from lungaccess.procedure import Procedure


def plan(
    patient: PatientFolder,
    *,
    target: TargetOptions = TargetOptions(),
    system: SystemOptions = SystemOptions(),
    search: SearchOptions = SearchOptions(),
    errors: ErrorOptions = ErrorOptions(),
    procedure: Annotated[
        ProcedureName | None,
        Parameter(
            help="For --objective success, what is measured and planned again on the way: a preset "
            "(closed-loop, measured-scope, measured-tip, open-loop) or a TOML file; open-loop if not given."
        ),
    ] = None,
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
            help="Seconds for what is learned where there is no plan: the nearest miss, what blocks, which "
            "preset or change of device would do, what is proved; 10 if not given, 0 to leave it out."
        ),
    ] = None,
    output: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Plan the access to a target, check the plan, and write plan, pictures and cost over time."""
    from lungaccess.cli.no_plan_output import explain_and_report
    from lungaccess.cli.plan_tables import no_plan_record
    from lungaccess.plans.no_plan import NoPlan

    followed = _procedure(search, system, procedure)
    search = search if followed is None else replace(search, objective=SearchOptions().objective)
    stated, objective, model = target.stated(), Objective.of(search.objective), errors.load()
    require_writable_folder(out)
    systems = system.candidates()
    lung = output.load(patient, thick_slices=thick_slices)
    require_map(lung, objective)
    request = PlanRequest(
        systems=systems, target=stated, search=search, errors=model, out=out, output=output,
        pictures=pictures, procedure=followed,
    )  # fmt: skip
    try:
        return plan_and_report(lung, request)
    except NoPlan as failure:
        if explain_time != 0.0:
            record = explain_and_report(lung, request, failure, explain_time)
        elif output.json:
            record = no_plan_record(failure)
        else:
            raise
        if output.json:
            terminal.show_json(record)
        return ExitCode.NEGATIVE


def _procedure(search: SearchOptions, system: SystemOptions, name: str | None) -> Procedure | None:
    """Return the procedure that is to succeed, None where a cost is made small."""
    from lungaccess.procedure import load_procedure

    if search.objective != SUCCESS:
        if name is not None:
            raise SettingsError(
                f"--procedure is {name} with --objective {search.objective}",
                expected=f"--objective {SUCCESS}",
                remedy="`lungaccess risk` simulates procedures of a plan that is there",
            )
        return None
    plain = SearchOptions()
    if (search.method, search.needle_planner, search.processes) != (plain.method, None, plain.processes):
        raise SettingsError(
            f"--objective {SUCCESS} is asked for with another search",
            expected="neither --method nor --needle-planner nor --processes",
            remedy="Leave them out",
        )
    if system.system == AUTO:
        raise SettingsError(
            f"--objective {SUCCESS} is asked for with --system {AUTO}",
            expected="one system",
            remedy="Name a system; `lungaccess presets` lists them",
        )
    return load_procedure(name or "open-loop")
