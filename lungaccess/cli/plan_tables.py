"""A plan and what the check says of it, as tables and as plain values."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table

from lungaccess.cli import terminal
from stages.needle import Objective

if TYPE_CHECKING:
    from lungaccess.checking import CheckReport, Finding
    from lungaccess.plans.no_plan import NoPlan
    from lungaccess.plans.plan import Plan


def plan_record(plan: Plan, report: CheckReport, folder: Path, files: tuple[str, ...]) -> dict[str, Any]:
    """Return what a command that planned found and wrote; lengths in mm, times in s."""
    return {
        "found": True,
        "accepted": report.accepted,
        "refusals": [each.to_mapping() for each in report.refusals],
        "folder": str(folder),
        "files": list(files),
        "digest": plan.digest,
        "objective": plan.objective,
        "cost": plan.cost,
        "costs": dict(plan.costs),
        "clearance_mm": {device: dict(values) for device, values in plan.clearance_mm.items()},
        "iterations": plan.iterations,
        "timing": dict(plan.timing),
    }


def no_plan_record(failure: NoPlan) -> dict[str, Any]:
    """Return why there is no plan."""
    return {
        "found": False,
        "accepted": False,
        "why": failure.found,
        "reasons": dict(failure.reasons),
        "advice": failure.advice,
    }


def plan_tables(plan: Plan) -> list[Table]:
    """Return the stages of a plan, each distance beside the distance it must keep, and the costs."""
    from lungaccess.plans.costs import costs_in_words

    return [
        terminal.table("The three stages", ("stage", "what to do"), _stage_rows(plan)),
        terminal.table(
            "Least distances (axis to structure)", ("device", "structure", "mm", "at least"), _distances(plan)
        ),
        terminal.table(
            f"Costs of the needle (made small: {Objective.of(plan.objective).words})",
            ("cost", "value"),
            costs_in_words(plan.costs),
        ),
    ]


def _stage_rows(plan: Plan) -> list[terminal.Row]:
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


def _distances(plan: Plan) -> list[terminal.Row]:
    """Return each distance and the least one allowed; a fissure that may be crossed has none."""
    return [
        (
            device,
            structure,
            f"{value:.2f}",
            ""
            if structure == "fissure" and not plan.fissures_are_obstacles
            else f"{plan.least_required_clearance_mm(device):.2f}",
        )
        for device in ("tube", "needle")
        for structure, value in plan.clearance_mm[device].items()
    ]


def check_tables(report: CheckReport, *, refusals_only: bool = False) -> list[Table]:
    """Return the findings of an independent check by stage, all of them or those that are not ok."""
    shown = [finding for finding in report.findings if not (refusals_only and finding.ok)]
    stages = dict.fromkeys(finding.stage for finding in shown)
    return [_findings_table(stage, [each for each in shown if each.stage == stage]) for stage in stages]


def _findings_table(stage: str, findings: list[Finding]) -> Table:
    """Return what was found of one stage: values, limits and the distances between the two."""
    made = terminal.bare_table(f"Independent check: {stage}")
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
            terminal.escaped(finding.name),
            "" if finding.value is None else f"{finding.value:.4g}{unit}",
            limit,
            "" if finding.margin is None else f"{finding.margin:.3g}",
            terminal.escaped(finding.detail),
        )
    return made
