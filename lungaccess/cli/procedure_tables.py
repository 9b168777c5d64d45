"""What the command line says of simulated procedures."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from lungaccess.cli import terminal
from lungaccess.uncertainty.risk.statistics import Share

if TYPE_CHECKING:
    from rich.table import Table

    from lungaccess.planning.procedure import ProcedureReport


def plain_share(share: Share) -> dict[str, object]:
    """Return a share as plain values."""
    return {"probability": share.value, "interval_95": list(share.interval)}


def share_row(name: str, share: Share) -> terminal.Row:
    """Return name, per cent and interval of a share."""
    low, high = share.interval
    return name, f"{100.0 * share.value:.2f}", f"{100.0 * low:.2f} to {100.0 * high:.2f}"


def procedure_record(report: ProcedureReport) -> dict[str, object]:
    """Return a report as plain values."""
    from anatomy.base.settings import to_mapping

    return {
        "errors": {**to_mapping(report.model), "name": report.model.label},
        "procedure": to_mapping(report.procedure),
        "samples": report.samples,
        "seed": report.seed,
        "radius_mm": report.radius_mm,
        "radius_origin": report.radius_origin,
        "succeeds": plain_share(report.succeeds),
        "ends": {name: plain_share(share) for name, share in report.ends.items()},
        "touches": {name: plain_share(share) for name, share in report.touches.items()},
        "miss_mm": {f"{share:g}": miss for share, miss in report.miss_mm.items()},
        "placements": report.placements,
        "stages": [
            {
                "stage": each.stage,
                "replans": each.replans,
                "without_path": plain_share(each.without_path),
                "corrected_mm": None if math.isnan(each.corrected_mm) else each.corrected_mm,
            }
            for each in report.stages
        ],
    }


def procedure_tables(report: ProcedureReport) -> list[Table]:
    """Return how procedures ended, and what each stage corrected."""
    rows = [share_row("success", report.succeeds)]
    rows += [share_row(name, share) for name, share in report.failures]
    rows += [
        (f"{100.0 * share:.0f} % of the inserted end within", f"{miss:.2f}", "mm")
        for share, miss in report.miss_mm.items()
    ]
    title = (
        f"{report.samples} procedures '{report.procedure.name}', errors of '{report.model.label}'; goal "
        f"{report.radius_mm:.2f} mm: {report.radius_origin}"
    )
    found = [terminal.table(title, ("ends with", "%", "95 % interval"), rows)]
    if report.stages:
        stages = [
            (
                each.stage,
                f"{each.replans / report.samples:.2f}",
                f"{100.0 * each.without_path.value:.1f}",
                "" if math.isnan(each.corrected_mm) else f"{each.corrected_mm:.2f}",
            )
            for each in report.stages
        ]
        headings = ("planned again from", "times", "without a path, %", "would have missed by, mm (median)")
        title = f"The bronchoscope is placed {report.placements:.2f} times"
        found.append(terminal.table(title, headings, stages))
    return found
