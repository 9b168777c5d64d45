"""How the verdict of the check looks in a notebook: refusals at once, all findings on demand."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING

from anatomy.display import title

if TYPE_CHECKING:
    from lungaccess.checking.findings import CheckReport, Finding

_HEADINGS = ("", "what", "found", "limit", "margin", "")


def report_html(report: CheckReport) -> str:
    """Return a report as HTML; the verdict is a word, not a colour alone."""
    refused = report.refusals
    verdict = "accepts the plan" if report.accepted else f"REFUSES the plan ({len(refused)} findings)"
    colour = "#1a7f37" if report.accepted else "#c00000"
    everything = (
        f"<details><summary>{len(report.findings)} findings</summary>{_table(report.findings)}</details>"
    )
    return (
        f'<div style="color:{colour}">{title(f"The independent check {verdict}")}</div>'
        f"{_table(refused) if refused else ''}{everything}"
    )


def _table(findings: Sequence[Finding]) -> str:
    head = "".join(f"<th>{heading}</th>" for heading in _HEADINGS)
    return f"<table><tr>{head}</tr>{''.join(_row(each) for each in findings)}</table>"


def _row(finding: Finding) -> str:
    unit = f" {finding.unit}" if finding.unit else ""
    cells = (
        "ok" if finding.ok else "REFUSED",
        finding.name,
        "" if finding.value is None else f"{finding.value:.4g}{unit}",
        "" if finding.side is None else f"{finding.side} {finding.limit:.4g}",
        "" if finding.margin is None else f"{finding.margin:.3g}",
        finding.detail,
    )
    return "<tr>" + "".join(f'<td style="text-align:left">{escape(cell)}</td>' for cell in cells) + "</tr>"
