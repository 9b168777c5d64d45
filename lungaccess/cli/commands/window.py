"""The command `lungaccess window`: the phases of the breath in which a plan is proved."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from anatomy.io.files import require_suffix
from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import NotNegative
from lungaccess.cli.options import PatientOfPlan, PatientOptions


def window(
    plan: Annotated[Path, Parameter(help="The plan.json.")],
    patient: PatientOfPlan,
    *,
    tolerance: Annotated[
        NotNegative, Parameter(help="Largest distance in mm to the moving target, at most 2.")
    ] = 2.0,
    out: Annotated[Path | None, Parameter(help="A plan.json to write, the plan with its window.")] = None,
    output: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Show in which phases of the breath a plan is proved clear and on target; exit code 1 if in none.

    The patient needs a motion: [motion] in its patient.toml.
    """
    from dataclasses import replace

    from lungaccess.breathing.window import breathing_window
    from lungaccess.plans.file import plain
    from lungaccess.plans.plan import Plan

    if out is not None:
        require_suffix(out, ".json")
    stored = Plan.load(plan)
    found = breathing_window(stored, output.load(patient), tolerance_mm=tolerance)
    if out is not None:
        replace(stored, window=found).save(out)
    if output.json:
        terminal.show_json({**plain(found), "share": found.share, "words": found.words})
        return ExitCode.of(len(found.phases) > 0)
    terminal.say(found.words)
    if found.warning_only:
        terminal.say("The motion is that of other people's lungs: this is a warning, not a promise.")
    rows = [
        (f"{100.0 * a:.1f} to {100.0 * b:.1f} %", f"{100.0 * (b - a):.1f} %")
        for a, b in found.phases.tolist()
    ]
    rows += [("not decided", f"{100.0 * found.undecided_share:.2f} %")]
    terminal.show([terminal.table(f"Window of breathing: {found.motion_source}", ("phases", "share"), rows)])
    return ExitCode.of(len(found.phases) > 0)
