"""What the command line shows: tables, JSON, and short panels for errors."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.panel import Panel
from rich.table import Table

if TYPE_CHECKING:
    from anatomy.errors import LungaccessError
    from anatomy.lung import Lung
    from lungaccess.checking import CheckReport, Finding
    from lungaccess.one_stage.needle import NeedleAnswer
    from lungaccess.plans.no_plan import NoPlan
    from lungaccess.plans.plan import Plan
    from lungaccess.problem.system import System

console = Console()
error_console = Console(stderr=True)
progress_console = Console(stderr=True)

Row = tuple[str, ...]


def set_quiet(quiet: bool) -> None:
    """Let commands print neither results nor progress, or let them again; JSON and errors still come."""
    console.quiet = progress_console.quiet = quiet


def show_json(value: object) -> None:
    """Print plain values as JSON on standard output, also for quiet commands; null for what is not finite."""
    console.file.write(json.dumps(_finite(value), indent=2, allow_nan=False) + "\n")


def _finite(value: object) -> object:
    """Replace numbers that JSON does not know."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    return value


def show_verdict(accepted: bool) -> None:
    """Print the verdict of the independent check."""
    if accepted:
        console.print("[bold green]The independent check accepts the plan.[/]")
    else:
        console.print("[bold red]The independent check refuses the plan.[/]")


def table(title: str, headings: Iterable[str], rows: Iterable[Row]) -> Table:
    """Return a plain table; its columns after the first are right-aligned where they hold numbers."""
    listed = list(rows)
    made = _bare_table(title)
    for number, heading in enumerate(headings):
        cells = [row[number] for row in listed]
        numeric = number > 0 and all(_is_number(cell) for cell in cells if cell)
        made.add_column(heading, justify="right" if numeric else "left", overflow="fold")
    for row in listed:
        made.add_row(*(escaped(cell) for cell in row))
    return made


def _bare_table(title: str) -> Table:
    return Table(title=title, title_justify="left", title_style="bold", header_style="bold", box=None)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def escaped(text: str) -> str:
    """Return text in which rich finds no markup."""
    return text.replace("[", r"\[")


def show(tables: Iterable[Table]) -> None:
    """Print tables with a blank line after each."""
    for made in tables:
        console.print(made)
        console.print()


def needle_tables(answer: NeedleAnswer) -> list[Table]:
    """Return what a needle planner found: the outcome, and the path arc by arc."""
    words = {
        "path": "a path, proved clear",
        "no path": "no path exists (proved against the masks)",
        "nothing found": "nothing found within the limit; no proof either",
    }
    rows = [("outcome", words.get(answer.outcome, answer.outcome))]
    if answer.branch >= 0:
        rows.append(("taken to have pierced", f"branch {answer.branch}"))
    path = answer.path
    if path is None:
        return [table("needle", ("", ""), rows)]
    if answer.first_path_s is not None:
        rows.append(("first path after", f"{1000.0 * answer.first_path_s:.1f} ms"))
    rows += [
        ("length", f"{path.length_mm:.2f} mm"),
        ("largest angle from the start", f"{np.degrees(path.max_angle_from_start_rad()):.1f} deg"),
        ("turning in all", f"{np.degrees(path.accumulated_turn_rad):.1f} deg"),
    ]
    rows += [(f"cost: {name}", f"{cost:.3f}") for name, cost in answer.costs.items()]
    arcs = [
        (
            f"{n}",
            f"{np.degrees(roll):.1f}",
            f"{length:.2f}",
            f"{1.0 / curvature:.1f}" if curvature else "straight",
        )
        for n, (length, roll, curvature) in enumerate(path.arcs, start=1)
    ]
    return [
        table("needle", ("", ""), rows),
        table("arcs", ("", "roll first, deg", "insert, mm", "radius, mm"), arcs),
    ]


def show_error(error: LungaccessError) -> None:
    """Print what was found, what was expected and what to do, in a short panel on standard error."""
    lines = [escaped(error.found.rstrip(".") + ".")]
    if error.expected:
        lines.append(f"[dim]expected[/]  {escaped(error.expected)}")
    if error.remedy:
        lines.append(f"[dim]remedy[/]    {escaped(error.remedy)}")
    error_console.print(Panel("\n".join(lines), title="bad input", title_align="left", border_style="red"))


def show_no_plan(failure: NoPlan) -> None:
    """Print why no plan was found: the counted reasons, and what would help."""
    console.print(Panel(escaped(failure.found), title="no plan", title_align="left", border_style="yellow"))
    rows = [(reason, f"{count}") for reason, count in failure.reasons.items() if count]
    if rows:
        console.print(
            table("What was looked at, and what was ruled out", ("stage and reason", "count"), rows)
        )
    if failure.advice:
        console.print(f"\n[bold]What would help:[/] {escaped(failure.advice)}")


def plan_tables(plan: Plan) -> list[Table]:
    """Return the stages of a plan, and each distance beside the distance it must keep."""
    return [
        table("The three stages", ("stage", "what to do"), _stage_rows(plan)),
        table(
            "Least distances (axis to structure)",
            ("device", "structure", "mm", "at least"),
            _distances(plan),
        ),
    ]


def _stage_rows(plan: Plan) -> list[Row]:
    scope, tube, needle = plan.scope, plan.tube, plan.needle
    return [
        (
            "scope",
            f"advance {scope.length_from_carina_mm:.1f} mm beyond the carina, to generation "
            f"{scope.generation} (lumen radius to spare {scope.min_lumen_margin_mm:.2f} mm)",
        ),
        (
            "tubes",
            f"turn to {np.degrees(tube.rotation_rad):.1f}°, outer tube {tube.outer_insertion_mm:.1f} mm, "
            f"inner tube {tube.inner_insertion_mm:.1f} mm beyond the scope; through the wall at "
            f"{np.degrees(tube.exit.wall_angle_rad):.0f}°",
        ),
        (
            "needle",
            f"steer {needle.length_mm:.1f} mm in {len(needle.arcs)} arc(s), at most "
            f"{np.degrees(needle.max_angle_from_start_rad):.1f}° from its start",
        ),
    ]


def _distances(plan: Plan) -> list[Row]:
    return [
        (device, structure, f"{value:.2f}", _least(plan, device, structure))
        for device in ("tube", "needle")
        for structure, value in plan.clearance_mm[device].items()
    ]


def _least(plan: Plan, device: str, structure: str) -> str:
    if structure == "fissure" and not plan.fissures_are_obstacles:
        return ""
    return f"{plan.required_clearance_mm[{'tube': 'inner_tube'}.get(device, device)]:.2f}"


def check_tables(report: CheckReport, *, refusals_only: bool = False) -> list[Table]:
    """Return the findings of an independent check by stage, all of them or those that are not ok."""
    shown = [finding for finding in report.findings if not (refusals_only and finding.ok)]
    stages = dict.fromkeys(finding.stage for finding in shown)
    return [_findings_table(stage, [each for each in shown if each.stage == stage]) for stage in stages]


def _findings_table(stage: str, findings: list[Finding]) -> Table:
    """Return what was found of one stage: values, limits and the distances between the two."""
    made = _bare_table(f"Independent check: {stage}")
    made.add_column("")
    made.add_column("what", no_wrap=True)
    for heading in ("found", "limit", "margin"):
        made.add_column(heading, justify="right")
    made.add_column("")
    for finding in findings:
        mark = "[green]ok[/]" if finding.ok else "[bold red]refused[/]"
        limit = "" if finding.side is None else f"{finding.side} {finding.limit:.4g}"
        unit = f" {finding.unit}" if finding.unit else ""
        made.add_row(
            mark,
            escaped(finding.name),
            "" if finding.value is None else f"{finding.value:.4g}{unit}",
            limit,
            "" if finding.margin is None else f"{finding.margin:.3g}",
            escaped(finding.detail),
        )
    return made


def anatomy_tables(lung: Lung) -> list[Table]:
    """Return what was understood of a patient: structures, airway tree by generation, sources."""
    made = [
        table(f"Patient {lung.name} ({lung.kind})", ("", ""), _patient_rows(lung)),
        table("Structures", ("structure", "volume, ml", "voxels"), _volume_rows(lung)),
        table(
            "Airway tree",
            ("generation", "branches", "mean radius, mm", "least radius, mm", "mean length, mm"),
            _generation_rows(lung),
        ),
        table("Repairs of the airway tree", ("repair", "at LPS, mm", "length, mm"), _repair_rows(lung)),
        table("Sources", ("file", "SHA-256"), [(name, digest[:16]) for name, digest in lung.sources.items()]),
    ]
    return [each for each in made if each.row_count]


def _patient_rows(lung: Lung) -> list[Row]:
    rows: list[Row] = [
        ("working grid", lung.grid.describe()),
        ("carina, LPS mm", ", ".join(f"{c:.1f}" for c in lung.tree.carina_lps)),
        ("breath hold", lung.breath_hold or "not stated"),
        ("fissures", "given" if lung.has_fissures else "not given"),
        ("cost map", "given" if lung.cost is not None else "not given"),
        ("start poses, targets", f"{len(lung.starts)}, {len(lung.targets_lps)}"),
    ]
    dropped = lung.tree.report.components_dropped
    if dropped:
        rows.append(("airway pieces left out", f"{dropped} ({lung.tree.report.voxels_dropped} voxels)"))
    return rows


def _repair_rows(lung: Lung) -> list[Row]:
    """Return every change the airway tree needed, with its place."""
    report = lung.tree.report
    kinds = (
        ("gap bridged", report.gaps_bridged),
        ("loop opened", report.loops_opened),
        ("spur pruned", report.spurs_pruned),
    )
    return [
        (kind, ", ".join(f"{c:.1f}" for c in record.position_lps), f"{record.length_mm:.1f}")
        for kind, records in kinds
        for record in records
    ]


def _volume_rows(lung: Lung) -> list[Row]:
    from lungaccess.cli.records import structure_voxels

    ml = lung.grid.voxel_volume_mm3 / 1000.0
    return [(name, f"{count * ml:.1f}", f"{count}") for name, count in structure_voxels(lung).items()]


def _generation_rows(lung: Lung) -> list[Row]:
    tree = lung.tree
    rows: list[Row] = []
    for generation in range(int(tree.generation.max()) + 1):
        branches = np.flatnonzero(tree.generation == generation)
        radius = np.asarray(tree.branch_mean_radius_mm)[branches]
        length = np.asarray(tree.branch_length_mm)[branches]
        figures = (f"{radius.mean():.2f}", f"{radius.min():.2f}", f"{length.mean():.1f}")
        rows.append((f"{generation}", f"{len(branches)}", *figures))
    return rows


def preset_table(systems: Mapping[str, System]) -> Table:
    """Return one line a preset: the sizes that matter, and what it is."""
    rows = [
        (
            name,
            f"{system.scope.outer_diameter_mm:g}",
            f"{system.tubes.outer.outer_diameter_mm:g} / {system.tubes.inner.outer_diameter_mm:g}",
            f"{system.needle.diameter_mm:g}",
            f"{1.0 / system.needle.max_curvature_per_mm:.0f}",
            system.description,
        )
        for name, system in systems.items()
    ]
    headings = ("name", "scope, mm", "tubes, mm", "needle, mm", "least turning radius, mm", "what it is")
    return table("Systems that ship with lungaccess (diameters)", headings, rows)


def what_to_look_at(out: Path) -> Panel:
    """Return a guide to the pictures of a plan."""
    lines = (
        f"{out / 'overview.png'}: the blue scope stays in the airway, the orange tube leaves through its",
        "wall at the diamond, the black needle passes the vessels and ends in the green nodule.",
        "R and L are the patient's right and left. In the two cuts, no full red or grey reaches the",
        "dashed lines; in the graph, no curve enters the red area outside the blue one.",
        f"{out / 'tree.png'}: the airway tree by generation; every branch lies inside the airway.",
        f"{out / 'report.html'}: all of it in 3-D, playing along a slider; open it in a browser.",
    )
    return Panel("\n".join(escaped(line) for line in lines), title="what to look at", title_align="left")
