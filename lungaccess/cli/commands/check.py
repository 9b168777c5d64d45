"""The command `lungaccess check`."""

from __future__ import annotations

from pathlib import Path

from lungaccess.cli import terminal
from lungaccess.cli.commands.common import NO_PLAN, OK, verdict
from lungaccess.cli.inputs import load_device, load_lung


def check(
    plan: Path,
    patient: Path,
    *,
    system: str | None = None,
    json: bool = False,
    cache: Path | None = None,
) -> int:
    """Judge a stored plan by independent code; exit code 0 if it is accepted, 1 if it is refused.

    Parameters
    ----------
    plan : Path
        The plan.json to judge.
    patient : Path
        Folder of the patient it was made for.
    system : str
        Judge against this preset or TOML file instead of the devices stated in the plan.
    json : bool
        Print JSON instead of tables.
    cache : Path
        Folder where the prepared anatomy is kept for the next command.
    """
    from lungaccess.checking import check as judge
    from lungaccess.plans.plan import Plan

    stored = Plan.load(plan)
    device = None if system is None else load_device(system, None)
    report = judge(stored, load_lung(patient, cache, thick_slices=True), system=device)
    if json:
        terminal.show_json(report.to_mapping())
        return OK if report.accepted else NO_PLAN
    terminal.show(terminal.check_tables(report))
    return verdict(report.accepted)
