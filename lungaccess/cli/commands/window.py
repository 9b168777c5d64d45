"""The command `lungaccess window`: the phases of the breath in which a plan is proved."""

from pathlib import Path
from typing import TYPE_CHECKING

from anatomy.base.files import require_suffix
from anatomy.base.words import of_hundred, percent
from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import NotNegative
from lungaccess.cli.options import PatientOfPlan, PatientOptions

if TYPE_CHECKING:
    from rich.table import Table

    from lungaccess.uncertainty.breathing.in_tissue import CarriedNeedle


def window(
    plan: Path,
    patient: PatientOfPlan,
    *,
    tolerance: NotNegative = 2.0,
    out: Path | None = None,
    tissue_carries_needle: bool = False,
    picture: Path | None = None,
    output: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Show in which phases of the breath a plan is proved clear and on target; exit code 1 if in none.

    The patient needs a motion: [motion] in its patient.toml.

    Args:
        plan: The plan.json.
        tolerance: Largest distance in mm to the moving target, at most 2.
        out: A plan.json to write, the plan with its window.
        tissue_carries_needle: Show what the breath does to the needle once it is in place, as a figure.
        picture: A PNG to write, the window on a clock.
    """
    from dataclasses import asdict, replace

    from lungaccess.plans.file import plain
    from lungaccess.plans.plan import Plan
    from lungaccess.uncertainty.breathing.in_tissue import carried_needle
    from lungaccess.uncertainty.breathing.window import breathing_window

    for file, suffix in ((out, ".json"), (picture, ".png")):
        if file is not None:
            require_suffix(file, suffix)
    stored = Plan.load(plan)
    lung = output.load(patient)
    found = breathing_window(stored, lung, tolerance_mm=tolerance)
    in_place = carried_needle(stored, lung, found) if tissue_carries_needle else None
    if out is not None:
        replace(stored, window=found).save(out)
    if picture is not None:
        from lungaccess.showing.report import window_png

        window_png(found, picture)
    if output.json:
        told = {} if in_place is None else {"needle_in_tissue_not_proved": asdict(in_place)}
        terminal.show_json({**plain(found), "share": found.share, "words": found.words, **told})
        return ExitCode.of(len(found.phases) > 0)
    terminal.say(found.words)
    rows = [(f"{of_hundred(a, up=True)} to {percent(b)}", percent(b - a)) for a, b in found.phases.tolist()]
    rows += [("not decided", percent(found.undecided_share))]
    tables = [terminal.table(f"Window of breathing: {found.motion_source}", ("phases", "share"), rows)]
    if in_place is not None:
        tables.append(_in_place(in_place))
    terminal.show(tables)
    return ExitCode.of(len(found.phases) > 0)


def _in_place(needle: "CarriedNeedle") -> "Table":
    """Return what the breath does to the needle in place."""
    rows = [
        ("its end to the moving target", f"{needle.end_miss_mm:.1f} mm"),
        ("shift of its begin from the tubes", f"{needle.shift_at_tubes_mm:.1f} mm"),
        ("bend there", f"{needle.bend_at_tubes_deg:.0f}°"),
        ("smallest radius of curvature", f"{needle.least_radius_mm:.0f} mm"),
        ("length of its way through tissue", f"{100.0 * needle.length_factor:.1f} %"),
    ]
    title = "In place, carried by tissue: worst of the breath, sampled, not proved"
    return terminal.table(title, ("", ""), rows)
