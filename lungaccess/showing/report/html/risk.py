"""How likely a plan succeeds, as tables of its page: deviated as it stands, simulated, or as it states."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from anatomy.base.words import percent, range_of_hundred
from lungaccess.planning.procedure import ProcedureReport
from lungaccess.plans.chance import Chance
from lungaccess.showing.report.html import words
from lungaccess.uncertainty.risk import Share

if TYPE_CHECKING:
    from lungaccess.planning.success import Estimate
    from lungaccess.uncertainty.risk import RestingRow, RiskReport, Sensitivity

FAILS = "Why procedures fail"
SHARES = "shares"
"""The kind of a table whose values are not wrapped: a share and its interval stay on one line."""


def risk_section(report: Estimate | None, start_words: str) -> str:
    """Return how likely the plan succeeds if the devices deviate from it, or that it was not computed.

    `start_words` tell its safe start region.
    """
    of_start = f"<p>{words.text(start_words)}.</p>"
    if report is None:
        return f"{of_start}<p>Chance of success not computed.</p>"
    if isinstance(report, Chance):
        return of_start + _of_chance(report)
    if isinstance(report, ProcedureReport):
        return of_start + _of_procedures(report)
    return of_start + _of_deviations(report)


def resting_section(rows: Sequence[RestingRow]) -> str:
    """Return what the shaft of the scope does to the plan where it rests on the wall."""
    found = [
        (each.name, f"{each.value:.2f} {each.unit}{f' (limit {each.words})' if each.words else ''}")
        for each in rows
    ]
    return words.pairs("The scope left to itself rests on the wall", found)


def _of_chance(chance: Chance) -> str:
    """Return what a plan states of its chance of success."""
    note = (
        f"As the plan states, of {chance.samples} draws with the seed {chance.seed} that its search never "
        "saw; not computed again. With --errors, --procedure, --samples or --seed the page computes it."
    )
    rows = sorted(chance.failures.items(), key=lambda item: -item[1])
    failed = [(name, _share(Share(count=count, samples=chance.samples))) for name, count in rows]
    return f"<p class='note'>{words.text(note)}</p>" + words.pairs(FAILS, failed, SHARES)


def _of_procedures(report: ProcedureReport) -> str:
    """Return what came of procedures that measure on their way."""
    note = (
        f"{report.samples} procedures '{report.procedure.name}', seed {report.seed}: "
        f"{report.procedure.description} Errors of '{report.model.label}'. The bronchoscope is placed "
        f"{report.placements:.2f} times. The range is the 95 % interval."
    )
    missed = [
        (f"of the inserted ends, {percent(share)} miss by no more than", f"{miss:.2f} mm")
        for share, miss in report.miss_mm.items()
    ]
    stages = [
        (
            words.text(each.stage),
            f"{each.replans / report.samples:.2f}",
            _share(each.without_path, fails=True),
            "–" if math.isnan(each.corrected_mm) else f"{each.corrected_mm:.2f} mm",
        )
        for each in report.stages
    ]
    headings = ("planned again from", "times", "without a path", "would have missed by (median)")
    return (
        f"<p class='note'>{words.text(note)}</p>"
        + words.pairs(
            FAILS, [(name, _share(share, fails=True)) for name, share in report.failures] + missed, SHARES
        )
        + words.table("What measuring corrects", headings, stages, SHARES)
    )


def _of_deviations(report: RiskReport) -> str:
    """Return what came of plans that are carried out as they stand."""
    within = f"ends within {report.radius_mm:.1f} mm of the target"
    rows = [("reaches the goal and touches nothing forbidden", _share(report.succeeds))]
    rows.append((report.tissue or within, _share(report.reaches)))
    rows += [
        (f"touches: {name}" if name != "stays in the airway" else name, _share(share, fails=True))
        for name, share in report.touches.items()
    ]
    rows += [
        (f"miss that {percent(share)} do not exceed", f"{miss:.2f} mm")
        for share, miss in report.miss_mm.items()
    ]
    alone = [(name.replace("_", " "), _share(share)) for name, share in report.alone.items()]
    assumed = ", ".join(report.model.assumed).replace("_", " ") or "none"
    sizes = report.model.words(with_needle=report.with_needle)
    note = (
        f"{report.samples} deviated plans, seed {report.seed}, open loop, errors of '{report.model.label}': "
        f"{sizes}; of which assumed: {assumed}. "
        f"{'Nodule' if report.tissue else 'Radius of the goal'}: {report.radius_origin}. The range is the "
        "95 % interval."
    )
    return (
        f"<p class='note'>{words.text(note)}</p>"
        + words.pairs("If the devices deviate", rows, SHARES)
        + words.pairs("Success with errors of one kind only", alone, SHARES)
        + sensitivity_bars(report.sensitivity)
    )


def sensitivity_bars(found: Sequence[Sensitivity]) -> str:
    """Return a drawing of what each kind of error has to do with success, "" without any."""
    if not found or not found[0].total:
        return ""
    most = max(1.0, found[0].total)
    rows = []
    for number, each in enumerate(found):
        top, total, first = 20 * number, 220.0 * each.total / most, 220.0 * max(each.first_order, 0.0) / most
        rows.append(
            f'<text x="0" y="{top + 13}">{words.text(each.kind.replace("_", " "))}</text>'
            f'<rect x="130" y="{top + 3}" width="{total:.1f}" height="13" fill="#9ecae1"/>'
            f'<rect x="130" y="{top + 3}" width="{min(first, total):.1f}" height="13" fill="#2171b5"/>'
            f'<text x="{136 + total:.1f}" y="{top + 13}">{each.total:.2f}</text>'
        )
    caption = (
        "Share of the variance of success that goes with each kind of error: dark by itself, light together "
        "with others."
    )
    height = 20 * len(found) + 4
    return (
        f'<figure><svg xmlns="http://www.w3.org/2000/svg" width="400" viewBox="0 0 400 {height}" role="img" '
        f'aria-label="{caption}" font-size="12" fill="currentColor">{"".join(rows)}</svg>'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _share(share: Share, *, fails: bool = False) -> str:
    return f"{percent(share.value, up=fails)} ({range_of_hundred(share.interval)})"
