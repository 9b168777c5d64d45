"""The command `lungaccess check`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.options import PatientOfPlan, PatientOptions


def check(
    plan: Annotated[Path, Parameter(help="The plan.json to check.")],
    patient: PatientOfPlan,
    *,
    system: Annotated[
        str | None,
        Parameter(help="Check against this preset or TOML file instead of the devices stated in the plan."),
    ] = None,
    output: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Check a stored plan by independent code; exit code 0 if it is accepted, 1 if it is refused."""
    from lungaccess.checking import check as check_plan
    from lungaccess.cli.plan_tables import check_tables
    from lungaccess.plans.plan import Plan
    from lungaccess.problem.system import load_system

    stored = Plan.load(plan)
    device = None if system is None else load_system(system)
    report = check_plan(stored, output.load(patient, thick_slices=True), system=device)
    if output.json:
        terminal.show_json(report.to_mapping())
        return ExitCode.of(report.accepted)
    terminal.show(check_tables(report))
    terminal.show_verdict(report.accepted)
    return ExitCode.of(report.accepted)
