"""The command `lungaccess shapes`: all that a design of tubes can do, whatever the patient."""

import math
from pathlib import Path
from typing import TYPE_CHECKING

from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.options import DEFAULT_SYSTEM, CacheOptions

if TYPE_CHECKING:
    from stages.tube import TubeShapes


def shapes(
    *, system: str = DEFAULT_SYSTEM, out: Path | None = None, output: CacheOptions = CacheOptions()
) -> ExitCode:
    """Follow a design of one to three tubes through all insertions and relative rotations.

    Exit code 0 if the device allows any deployment; 1 if it allows none.

    Args:
        system: Name of a preset, or path of a TOML file: a system, or one to three tables [[tubes]], the
            innermost first.
        out: CSV file for a table of all shapes.
    """
    from lungaccess.planning.one_stage import design_shapes, load_tubes, save_shapes, shapes_record

    device = load_tubes(system)
    found = design_shapes(device, cache=output.cache)
    if out is not None:
        save_shapes(found, out)
    if output.json:
        terminal.show_json(shapes_record(device.name, found))
        return ExitCode.of(found.count > 0)
    terminal.show([terminal.table(f"Shapes of {device.name}", ("", "", "limit"), _rows(device.name, found))])
    if out is not None:
        terminal.say(f"Written to {out}")
    return ExitCode.of(found.count > 0)


def _rows(name: str, found: "TubeShapes") -> list[terminal.Row]:
    from lungaccess.planning.one_stage import shapes_record

    record = shapes_record(name, found)
    turns = record["relative_rotations"]
    turned = f"{turns} relative rotations" if turns > 1 else "no relative rotation"
    grid = f"insertions every {record['stop_mm']:g} mm, {turned}"
    rows: list[terminal.Row] = [("deployments looked at", f"{record['candidates']}", grid)]
    rows += [(f"refused: {why}", f"{count}", "") for why, count in record["refused"].items()]
    rows.append(("allowed", f"{record['shapes']}", ""))
    if not found.count:
        return rows
    largest, limits = record["largest"], found.limits
    return [
        *rows,
        ("tip ahead, at most", f"{largest['tip_ahead_mm']:.1f} mm", f"{limits.max_extension_mm:g} mm out"),
        ("tip aside, at most", f"{largest['tip_aside_mm']:.1f} mm", ""),
        ("tip turned, at most", f"{math.degrees(largest['tip_turned_rad']):.1f} deg", ""),
        (
            "largest sideways sweep",
            f"{largest['lateral_sweep_mm']:.3f} mm",
            f"at most {limits.max_lateral_sweep_mm:g} mm",
        ),
        ("follow-the-leader error", f"{largest['follow_the_leader_error_mm']:.3f} mm", ""),
        ("largest strain", f"{100 * largest['strain']:.2f} %", f"at most {100 * limits.max_strain:g} %"),
        ("least determinant on the way", f"{record['least_determinant']:.4f}", "above 0"),
        ("arcs away from the tubes, at most", f"{largest['arc_error_mm']:.4f} mm", ""),
    ]
