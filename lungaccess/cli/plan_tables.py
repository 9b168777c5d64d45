"""A plan and what the check says of it, as tables and as plain values."""

from __future__ import annotations

import math
import shlex
import sys
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from anatomy.base.words import of_hundred
from lungaccess.cli import terminal
from stages.needle import Objective

if TYPE_CHECKING:
    from anatomy.lung import Lung
    from lungaccess.judging.advice import Advice
    from lungaccess.judging.appraisal import Appraisal, Headline
    from lungaccess.judging.checking import CheckReport, Finding
    from lungaccess.plans.no_plan import NoPlan
    from lungaccess.plans.plan import Plan


GRADE_STYLES = {"good": "green", "fair": "yellow", "unknown": "yellow", "poor": "red"}
MARKS = {True: Text("ok", "green"), False: Text("refused", "bold red"), None: Text("not checked", "yellow")}


def no_plan_record(failure: NoPlan) -> dict[str, Any]:
    """Return why there is no plan."""
    from lungaccess.plans.version import made_by

    return {
        **made_by(),
        "found": False,
        "accepted": False,
        "why": failure.found,
        "reasons": dict(failure.reasons),
        "advice": failure.advice,
        "attempts": dict(failure.attempts),
    }


def plan_tables(plan: Plan, lung: Lung) -> list[Table]:
    """Return the stages of a plan and its costs."""
    from lungaccess.plans.costs import costs_in_words, known_costs

    what = "the tubes beyond the lumen" if plan.needle is None else "the needle"
    return [
        terminal.table("The stages", ("stage", "what to do"), _stage_rows(plan, lung)),
        steps_table(plan, lung),
        terminal.table(
            f"Costs of {what} (made small: {Objective.of(plan.objective).words})",
            ("cost", "value"),
            costs_in_words(known_costs(plan.costs, has_map=lung.cost is not None)),
        ),
    ]


def steps_table(plan: Plan, lung: Lung) -> Table:
    """Return step by step what hands do with the bronchoscope."""
    from lungaccess.plans.scope_steps import handle_words, scope_steps, steps_note

    steps = scope_steps(plan, lung)
    rows = [(str(number), one.text) for number, one in enumerate(steps, start=1)]
    rows += [
        (f"pass {number}", f"{said[:1].upper()}{said[1:]}.")
        for number, said in enumerate(plan.redirections, 2)
    ]
    made = terminal.table("The bronchoscope, step by step", ("step", "what to do"), rows)
    made.caption = f"{handle_words(plan)} {steps_note(plan, lung)}"
    made.caption_justify = "left"
    return made


def _stage_rows(plan: Plan, lung: Lung) -> list[terminal.Row]:
    from lungaccess.plans.view import view_words
    from lungaccess.problem.nodules import target_words

    scope, tube, place = plan.scope, plan.tube, target_words(lung, plan.target_lps)
    way = plan.way_to_target if plan.needle is None else f"steer {plan.way_to_target}"
    return [
        (
            "scope",
            f"advance {scope.length_from_carina_mm:.1f} mm beyond the carina, to generation "
            f"{scope.generation}",
        ),
        (
            "tubes",
            f"{plan.rotations}, {plan.insertions} beyond the scope; "
            f"through the wall of branch {lung.branch_words(tube.exit.branch)}",
        ),
        ("needle", way + (f": {place}" if place else "")),
        *((f"pass {number}", said) for number, said in enumerate(plan.redirections, 2)),
        *((("ultrasound", view),) if (view := view_words(plan, lung)) else ()),
    ]


def arcs_table(arcs: Iterable[Sequence[float]]) -> Table:
    """Return the arcs of a needle, each with its length in mm, roll in rad and curvature in 1/mm."""
    rows = [
        (f"{n}", f"{math.degrees(roll):.1f}", f"{length:.2f}", f"{1.0 / bend:.1f}" if bend else "straight")
        for n, (length, roll, bend) in enumerate(arcs, start=1)
    ]
    headings = ("", "roll first, deg", "insert, mm", "radius, mm")
    return terminal.table("arcs of the needle", headings, rows)


def show_findings(appraisal: Appraisal) -> None:
    """Print what the check refuses, if anything, and the limits."""
    for finding in (*appraisal.check.refusals, *appraisal.check.unchecked):
        terminal.say(f"{finding}")
    if appraisal.limits:
        terminal.show([limits_table(appraisal)])


def show_headline(headline: Headline) -> None:
    """Print the headline in a panel whose colour, mark and title follow the worse of its two parts."""
    style = GRADE_STYLES[headline.grade.key]
    parts = [(headline.grade.mark, f"bold {style}"), (f" {headline.text}", "bold")]
    parts += [(f"\n{each}", "dim") for each in headline.details]
    title = Text(headline.verdict, f"bold {style}")
    terminal.console.print(
        Panel(terminal.styled(*parts), title=title, title_align="left", border_style=style)
    )


def show_advice(advice: Sequence[Advice], appraisal: Appraisal) -> None:
    """Print what lifts the chance of success most, as it was tried, each with its command."""
    success = appraisal.headline.success
    if not advice or success is None:
        return
    now = of_hundred(success.value)
    rows = [(each.words, of_hundred(each.success.value), command_with(each.options)) for each in advice]
    title = f"What was found to lift the chance of success, now {now} of 100"
    terminal.show([terminal.table(title, ("with", "of 100", "command"), rows)])


def command_with(options: Sequence[str]) -> str:
    """Return the command that runs now with other options in place of those of the same name."""
    words, replaced = sys.argv[1:], {options[0], *(["--nodule"] if options[0] == "--target" else [])}
    kept, skips = [], False
    for word in words:
        skips = word in replaced or (skips and not word.startswith("--"))
        kept += [] if skips else [word]
    return shlex.join(["lungaccess", *kept, *options])


def limits_table(appraisal: Appraisal) -> Table:
    """Return the limits that the plan comes nearest to; broken ones come first."""
    from lungaccess.judging.appraisal import LIMITS_TITLE, SHOWN_LIMITS

    rows = [
        (each.what, each.found_words, each.bound_words, each.used_words if each.ok else "BROKEN")
        for each in appraisal.limits[:SHOWN_LIMITS]
    ]
    made = terminal.table(LIMITS_TITLE, ("limit", "measured", "needs", "used"), rows)
    made.caption = "`lungaccess check PLAN PATIENT --all` lists every finding."
    made.caption_justify = "left"
    return made


def check_tables(report: CheckReport) -> list[Table]:
    """Return all findings of an independent check by stage."""
    stages = dict.fromkeys(finding.stage for finding in report.findings)
    return [
        _findings_table(stage, [each for each in report.findings if each.stage == stage]) for stage in stages
    ]


def _findings_table(stage: str, findings: list[Finding]) -> Table:
    made = terminal.bare_table(f"Independent check: {stage}")
    made.add_column("")
    made.add_column("what", no_wrap=True)
    for heading in ("found", "limit", "margin"):
        made.add_column(heading, justify="right")
    made.add_column("")
    for finding in findings:
        made.add_row(MARKS[finding.ok], *finding.cells()[1:])
    return made
