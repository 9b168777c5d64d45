"""What is known about a plan, as tables of the page: limits, instructions, chance of success, provenance."""

import math
from collections.abc import Sequence

from anatomy.base.words import percent, plural, range_of_hundred
from anatomy.lung import Lung
from lungaccess.judging.appraisal import Appraisal, Limit
from lungaccess.judging.appraisal.limits import LIMITS_TITLE, SHOWN_LIMITS
from lungaccess.judging.checking import CheckReport
from lungaccess.judging.checking.findings import Finding
from lungaccess.planning import Alternative
from lungaccess.planning.procedure import ProcedureReport
from lungaccess.planning.success import Estimate
from lungaccess.plans.chance import Chance
from lungaccess.plans.plan import Plan
from lungaccess.showing.report.html import words
from lungaccess.showing.report.key_numbers import figures_of_plan
from lungaccess.uncertainty.risk import RestingRow, RiskReport, Sensitivity, Share

STAGE_NAMES = {"scope": "Bronchoscope", "tube": "Tubes", "needle": "Needle", "exemption": "The pierced wall"}


def limits_section(appraisal: Appraisal) -> str:
    """Return the limits that the plan comes nearest to, broken ones first."""
    rows = [
        (words.text(each.what), each.found_words, each.bound_words, _bar(each))
        for each in appraisal.limits[:SHOWN_LIMITS]
    ]
    return words.table(LIMITS_TITLE, ("limit", "measured", "needs", "used"), rows, "nearest")


def _bar(limit: Limit) -> str:
    """Return how much of a limit is used, as a bar and in words."""
    width = 100.0 * min(limit.used, 1.0)
    # From so much of a limit on its bar is coloured.
    kind = "bar" if limit.used < 0.9 else "bar tight"
    said = limit.used_words if limit.ok else "BROKEN"
    return (
        f'<span class="{kind}" aria-hidden="true"><span style="width:{width:.0f}%"></span></span> '
        f"{words.text(said) if limit.ok else words.verdict(False, no=said)}"
    )


def check_section(report: CheckReport) -> str:
    """Return all findings of the check, folded: limits, comparisons of statements, and what has no limit."""
    limits = [f for f in report.findings if f.margin is not None and not _compares_record(f)]
    record = [f for f in report.findings if f.margin is not None and _compares_record(f)]
    others = [f for f in report.findings if f.margin is None]
    stages = [name for name in STAGE_NAMES if any(f.stage == name for f in limits)]
    stages += sorted({f.stage for f in limits} - set(stages))
    shown = [_limits(STAGE_NAMES.get(name, name), [f for f in limits if f.stage == name]) for name in stages]
    rows = [(words.text(f.name), words.verdict(f.ok), _value(f), words.text(f.detail)) for f in others]
    unlimited = words.table("Without a limit", ("what", "verdict", "found", "detail"), rows)
    return "".join(
        [
            _refusals(report),
            _folded(f"{len(limits)} limits of devices and tolerances", "".join(shown)),
            _folded(f"{len(record)} comparisons of what the plan states with what the check recomputed",
                    _limits("Stated and recomputed", record)),
            _folded(f"{len(others)} findings without a limit", unlimited),
        ]
    )  # fmt: skip


def _compares_record(finding: Finding) -> bool:
    """Tell whether a finding is about the plan's own statements, not about a limit of a device."""
    return (
        ".stated" in finding.name
        or "stated" in finding.detail
        or finding.detail == "largest angle between the axes"
    )


def _folded(summary: str, content: str) -> str:
    return f"<details><summary>{words.text(summary)}</summary>{content}</details>"


def _refusals(report: CheckReport) -> str:
    """Return the verdict, what is refused, and what could not be checked."""
    missing = words.bullets(report.unchecked)
    missing = (
        f"<p>{plural(len(report.unchecked), 'thing')} could not be checked:</p>{missing}" if missing else ""
    )
    if report.accepted:
        number = len(report.findings) - len(report.unchecked)
        return f"<p>The independent check accepts the geometry: {number} findings are ok.</p>{missing}"
    refused = words.bullets(report.refusals)
    return f"<p>{words.verdict(False)}: do not use this plan.</p>{refused}{missing}"


def _limits(title: str, findings: Sequence[Finding]) -> str:
    # The margin as a share of the limit, which compares findings of different units.
    ordered = sorted(findings, key=lambda f: (f.ok, (f.margin or 0.0) / max(abs(f.limit or 0.0), 1e-9)))
    rows = [
        (
            words.text(f.name),
            _value(f),
            _limit(f),
            f"{words.number(f.margin)} {words.text(f.unit)}",
            words.verdict(f.ok),
            words.text(f.detail),
        )
        for f in ordered
    ]
    return words.table(title, ("what", "found", "limit", "margin", "verdict", "detail"), rows, "limits")


def _limit(finding: Finding) -> str:
    spare = f" (tolerance {words.number(finding.tolerance, 2)})" if finding.tolerance else ""
    return words.text(f"{finding.side or ''} {words.number(finding.limit)} {finding.unit}{spare}")


def _value(finding: Finding) -> str:
    return f"{words.number(finding.value)} {words.text(finding.unit)}" if finding.value is not None else "–"


def plans_section(found: Sequence[Alternative], appraisals: Sequence[Appraisal]) -> str:
    """Return a table that compares plans, each with its chance of success; those on the front are marked."""
    rows, breathe = [], any(each.plan.window is not None for each in found)
    for number, (each, appraisal) in enumerate(zip(found, appraisals, strict=True)):
        headline, tightest, plan = appraisal.headline, appraisal.limits[:1], each.plan
        rows.append(
            (
                words.text(plan_name(number, len(found[0].plan.passes))),
                words.grade(headline.grade, headline.chance_words),
                words.text(headline.failures[0][0] if headline.failures else "–"),
                words.number(each.criteria["length_in_tissue_mm"]),
                words.number(each.criteria["clearance_mm"]),
                "yes" if each.on_front and len(found) > 1 else "",
                words.text(headline.geometry_words),
                words.text(tightest[0].words if tightest else "–"),
                words.text(plan.tube.exit.branch),
                words.text(plan.scope.generation),
                words.number(plan.costs["inverse_clearance"], 4),
                *([] if not breathe else [percent(plan.window.share) if plan.window else "not computed"]),
            )
        )
    headings = (
        "plan", "succeeds", "fails most often because it", "tissue, mm", "clearance, mm", "on the front",
        "check", "nearest limit", "branch pierced", "generation of the scope's tip",
        "nearness to obstacles",
    )  # fmt: skip
    more = ("share of the breath in the window",) if breathe else ()
    return words.table("Plans to this target", (*headings, *more), rows, "plans")


def plan_name(number: int, passes: int) -> str:
    """Return the name of a plan by its place on the page: the one that was given, and its further passes."""
    if 0 < number < passes:
        return f"Pass {number + 1} alone"
    whole = "The plan" if passes == 1 else f"All {passes} passes of the plan"
    return whole if number == 0 else f"Alternative {number - passes + 1}"


def shown_name(number: int, passes: int) -> tuple[str, str]:
    """Return the name and the short label of what is drawn of a plan: one pass, where it has several."""
    if number < passes and passes > 1:
        return f"Pass {number + 1}", str(number + 1)
    return plan_name(number, passes), f"{'' if passes == 1 else 'A'}{number - passes + 1}"


def key_section(plan: Plan, lung: Lung) -> str:
    """Return the key numbers of a plan but for its limits, which stand at the top of the page."""
    return "".join(words.pairs(heading, rows) for heading, rows in figures_of_plan(plan, lung))


def instructions_section(plan: Plan, lung: Lung) -> str:
    """Return step by step how hands bring the scope to where the plan has its tip."""
    from lungaccess.plans.bifurcations import route_bifurcations
    from lungaccess.plans.insertion import shown_motion
    from lungaccess.plans.scope_steps import handle_words, scope_steps, steps_note

    texts = [*(one.text for one in scope_steps(plan, lung)), handle_words(plan)]
    texts += [f"Pass {number}: {said}." for number, said in enumerate(plan.redirections, 2)]
    found = route_bifurcations(shown_motion(plan), plan.scope.branches, lung, plan.system)
    ways = [one.text for one in found]
    return (
        f"<h3>Which way at each bifurcation</h3>{words.steps(ways)}"
        f"<h3>With the hands</h3>{words.steps(texts)}<p class='note'>{words.text(steps_note(plan, lung))}</p>"
    )


def provenance_section(plan: Plan, lung: Lung) -> str:
    """Return where a plan came from."""
    rows: list[tuple[str, object]] = [
        ("plan made with lungaccess", plan.software_version),
        ("kernels", plan.kernels or "not stated"),
        ("digest of the plan", plan.digest),
        ("patient", plan.patient_name),
        ("lung", plan.lung_key),
        ("breath hold", plan.breath_hold or "not stated"),
        ("target from", plan.target_origin),
        ("system", plan.system.name),
        *(("choice of the system", sentence) for sentence in plan.system_choice),
        ("fingerprint of the system", plan.system_fingerprint),
        ("method, seed, iterations", f"{plan.method}, {plan.seed}, {plan.iterations}"),
        ("objective", plan.objective),
        *((f"seconds: {name}", f"{seconds:.2f}") for name, seconds in plan.timing.items()),
    ]
    warnings = words.bullets(lung.warnings)
    files = words.pairs("SHA-256 of the image files", sorted(plan.sources.items()))
    noted = f"<p>Warnings of the anatomy:</p>{warnings}" if warnings else ""
    return words.pairs("Plan", rows) + noted + f"<details><summary>Image files</summary>{files}</details>"


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
        + _sensitivity_bars(report.sensitivity)
    )


def _sensitivity_bars(found: Sequence[Sensitivity]) -> str:
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
