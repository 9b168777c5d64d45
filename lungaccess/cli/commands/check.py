"""The command `lungaccess check`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.options import ErrorOptions, PatientOfPlan, PatientOptions


def check(
    plan: Annotated[Path, Parameter(help="The plan.json to check.")],
    patient: PatientOfPlan,
    *,
    system: Annotated[
        str | None,
        Parameter(help="Check against this preset or TOML file instead of the devices stated in the plan."),
    ] = None,
    errors: ErrorOptions = ErrorOptions(),
    everything: Annotated[
        bool, Parameter(name="--all", negative="", help="List every finding, not only the nearest limits.")
    ] = False,
    output: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Check a stored plan by independent code; exit code 0 if it is accepted, 1 if it is refused."""
    from lungaccess.appraisal import appraise
    from lungaccess.cli.plan_tables import check_tables, show_appraisal
    from lungaccess.plans.plan import Plan
    from lungaccess.problem.system import load_system

    stored, model = Plan.load(plan), errors.given()
    device = None if system is None else load_system(system)
    followed = errors.given_procedure()
    lung = output.load(patient, thick_slices=True)
    appraisal = appraise(stored, lung, errors=model, procedure=followed, system=device)
    if output.json:
        terminal.show_json({**appraisal.to_mapping(), **appraisal.check.to_mapping()})
        return ExitCode.of(appraisal.accepted)
    show_appraisal(appraisal)
    if everything:
        terminal.show(check_tables(appraisal.check))
    return ExitCode.of(appraisal.accepted)
