"""The command `lungaccess steps`: what hands or motors do with the bronchoscope of a plan."""

from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.options import PatientOfPlan, PatientOptions, PlanFile


def steps(plan: PlanFile, patient: PatientOfPlan, *, output: PatientOptions = PatientOptions()) -> ExitCode:
    """Print step by step how the bronchoscope of a plan moves; with --json also every state, for motors."""
    from lungaccess.cli.plan_tables import steps_table
    from lungaccess.plans.plan import Plan
    from lungaccess.plans.scope_steps import motion_record

    stored = Plan.load(plan)
    lung = output.load(patient)
    stored.require_lung(lung)
    if output.json:
        terminal.show_json(motion_record(stored, lung))
    else:
        terminal.show([steps_table(stored, lung)])
    return ExitCode.OK
