"""How the verdict of the check looks in a notebook: refusals at once, all findings on demand."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from anatomy.display import title

_HEADINGS = ("", "what", "found", "limit", "margin", "")


Row = tuple[str, ...]
"""The cells of one finding, in the order of the headings; see `Finding.cells`."""


def report_html(findings: Sequence[Row], refused: Sequence[Row], *, accepted: bool) -> str:
    """Return the verdict and the findings as HTML; only a refusal has a colour.

    Accepted geometry says nothing of the chance of success, so it is not shown in green.
    """
    verdict = "accepts the plan" if accepted else f"REFUSES the plan ({len(refused)} findings)"
    colour = "inherit" if accepted else "#c00000"
    everything = f"<details><summary>{len(findings)} findings</summary>{_table(findings)}</details>"
    return (
        f'<div style="color:{colour}">{title(f"The independent check {verdict}")}</div>'
        f"{_table(refused) if refused else ''}{everything}"
    )


def _table(rows: Sequence[Row]) -> str:
    head = "".join(f"<th>{heading}</th>" for heading in _HEADINGS)
    return f"<table><tr>{head}</tr>{''.join(_row(row) for row in rows)}</table>"


def _row(row: Row) -> str:
    return "<tr>" + "".join(f'<td style="text-align:left">{escape(cell)}</td>' for cell in row) + "</tr>"
