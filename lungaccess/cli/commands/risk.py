"""The commands `lungaccess risk` and `start-region`: what errors do to a stored plan."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING

from anatomy.base.words import of_hundred, percent, range_of_hundred
from lungaccess.cli import lazy, terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import NotNegative, Positive, Probability, Processes, Samples, SamplesOrNone, Seed
from lungaccess.cli.options import ErrorOptions, PatientOfPlan, PatientOptions, PlanFile, ToolText
from lungaccess.cli.progress import progress
from lungaccess.plans.record import picked
from lungaccess.uncertainty.risk.statistics import Share

if TYPE_CHECKING:
    from rich.table import Table


def risk(
    plan: PlanFile,
    patient: PatientOfPlan,
    *,
    errors: ErrorOptions = ErrorOptions(),
    samples: Samples | None = None,
    radius: Positive | None = None,
    probability: Probability = 0.95,
    tool: ToolText = None,
    seed: Seed = 0,
    processes: Processes = 1,
    masks: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Estimate how likely a stored plan succeeds if the devices deviate from it.

    Args:
        samples: Number of deviated plans; 10000, or 1000 procedures that measure on their way.
        radius: Radius of the goal in mm; by default that of the nodule, or 5 if the target lies in none.
        probability: Probability of success that the tolerances keep.
        seed: Seed of the random numbers.
        processes: How many processes share procedures that measure; one on Windows.
    """
    from lungaccess.planning.procedure.simulation import DEFAULT_SAMPLES as PROCEDURES

    model, followed = errors.load(), errors.given_procedure() or lazy.Procedure()
    tool_given = None if tool is None else lazy.load_tool(tool)
    stored, lung = masks.load_plan(plan, patient)
    stored = replace(stored, system=lazy.with_tool(stored.system, tool_given))
    with progress("bringing the scope to rest on the wall"):
        wall = model.wall or lazy.WallContact()
        rested = lazy.resting_rows(lazy.resting_tip(stored, lung, wall), wall)
    if not followed.is_open_loop:
        with progress(f"simulating procedures '{followed.name}'"):
            found = lazy.simulate_procedure(
                stored,
                lung,
                errors=model,
                procedure=followed,
                samples=samples or PROCEDURES,
                seed=seed,
                radius_mm=radius,
                processes=processes,
            )
        terminal.tell(_procedure_record(found) | _resting_record(rested))
        terminal.say(lazy.Headline.of(None, found).chance_text)
        terminal.show([*_procedure_tables(found), _resting_table(rested)])
        return ExitCode.OK
    samples = samples or lazy.DEFAULT_SAMPLES
    with progress("deviating the plan"):
        report = lazy.assess(stored, lung, model=model, samples=samples, seed=seed, radius_mm=radius)
    with progress("looking for the largest errors"):
        kept = lazy.find_tolerances(
            stored, lung, model=model, probability=probability, seed=seed, radius_mm=radius
        )
    terminal.tell(record(report, kept) | _resting_record(rested))
    terminal.say(lazy.Headline.of(None, report).chance_text)
    planned = stored.chance
    if planned is not None and planned.procedure != followed.name:
        terminal.say(
            f"It was planned for '{planned.procedure}', with which {of_hundred(planned.share)} of 100 were "
            f"counted: state it as --procedure to simulate it anew"
        )
    terminal.show(
        [_outcome_table(report), _sensitivity_table(report), _tolerance_table(kept), _resting_table(rested)]
    )
    return ExitCode.OK


def record(report: lazy.RiskReport, kept: tuple[lazy.Tolerance, ...]) -> dict[str, object]:
    """Return a report and tolerances as plain values."""
    return _estimate_record(report) | {
        "reaches": report.reaches.to_mapping(),
        "forbidden": list(report.forbidden),
        "rare": {
            name: {"probability": rare.value, "interval_95": list(rare.interval)}
            | picked(rare, "effective_samples centres")
            for name, rare in report.rare.items()
        },
        "sensitivity": [
            picked(each, "kind first_order total")
            | {"changes": each.changes.to_mapping(), "succeeds_with_it_alone": each.alone.to_mapping()}
            for each in report.sensitivity
        ],
        "tolerances": [
            picked(each, "kind unit stated probability largest margin")
            | {"succeeds_with_it_alone": report.alone[each.kind].to_mapping()}
            for each in kept
        ],
    }


def _resting_record(rows: Sequence[lazy.RestingRow]) -> dict[str, object]:
    """Return what the shaft at rest on the wall does to a plan, as plain values."""
    return {"resting_scope": [asdict(each) for each in rows]}


def _resting_table(rows: Sequence[lazy.RestingRow]) -> Table:
    shown = [
        (each.name, f"{each.value:.2f} {each.unit}", "" if each.limit is None else each.words)
        for each in rows
    ]
    return terminal.table("The scope left to itself rests on the wall", ("", "found", "limit"), shown)


def _outcome_table(report: lazy.RiskReport) -> Table:
    rows = [
        _share_row("succeeds", report.succeeds),
        _share_row(report.tissue or f"ends within {report.radius_mm:.2f} mm", report.reaches),
    ]
    for name, share in report.touches.items():
        words = name if name.startswith("stays") else f"touches {name}"
        words = words if name in report.forbidden else f"{words} (allowed)"
        if name in report.rare:
            rare = report.rare[name]
            said = f"{range_of_hundred(rare.interval)}, as {rare.effective_samples:.0f} events"
            rows.append((f"{words} (weighted)", of_hundred(rare.value, up=True), said))
        else:
            rows.append(_share_row(words, share, fails=True))
    rows += [(f"{percent(share)} end within", f"{miss:.2f}", "mm") for share, miss in report.miss_mm.items()]
    title = f"{report.samples} deviated plans, errors of '{report.model.label}'; {_goal_words(report)}"
    return terminal.table(title, ("", "%", "95 % interval"), rows)


def _goal_words(report: lazy.RiskReport | lazy.ProcedureReport) -> str:
    goal = report.tissue or f"goal {report.radius_mm:.2f} mm"
    return f"{goal}: {report.radius_origin}"


def _sensitivity_table(report: lazy.RiskReport) -> Table:
    rows = [
        (
            each.kind.replace("_", " "),
            of_hundred(each.alone.value),
            of_hundred(each.changes.value),
            f"{each.first_order:.2f}",
            f"{each.total:.2f}",
        )
        for each in report.sensitivity
    ]
    headings = ("kind of error", "alone succeeds, %", "outcome changes, %", "first order", "total effect")
    return terminal.table("What decides: each kind alone, and drawn anew among all others", headings, rows)


def _tolerance_table(kept: tuple[lazy.Tolerance, ...]) -> Table:
    rows = [
        (
            each.kind.replace("_", " "),
            each.unit,
            f"{each.stated:g}",
            of_hundred(each.alone.value),
            f"{'at least ' if each.largest >= lazy.LARGEST[each.unit] else ''}{each.largest:.2f}",
            "{:.2f}, {:.2f}".format(*each.margin),
        )
        for each in kept
    ]
    headings = (
        "one kind alone", "unit", "stated", "succeeds, %",
        f"largest for {100.0 * kept[0].probability:g} %", "never fails within",
    )  # fmt: skip
    return terminal.table("Tolerance", headings, rows)


def _share_row(name: str, share: Share, *, fails: bool = False) -> terminal.Row:
    """Return name, per cent and interval of a share, which is rounded up where it fails."""
    return name, of_hundred(share.value, up=fails), range_of_hundred(share.interval)


def _estimate_record(report: lazy.RiskReport | lazy.ProcedureReport) -> dict[str, object]:
    """Return what estimates of single plans and of procedures have in common."""
    return {
        "errors": {**lazy.to_mapping(report.model), "name": report.model.label},
        **picked(report, "samples seed"),
        "counts_as_success": lazy.chance_of(report).success_words,
        **picked(report, "radius_mm radius_origin"),
        "succeeds": report.succeeds.to_mapping(),
        "touches": {name: share.to_mapping() for name, share in report.touches.items()},
        "miss_mm": {f"{share:g}": miss for share, miss in report.miss_mm.items()},
    }


def _procedure_record(report: lazy.ProcedureReport) -> dict[str, object]:
    """Return a report as plain values."""
    return _estimate_record(report) | {
        "procedure": lazy.to_mapping(report.procedure),
        "ends": {name: share.to_mapping() for name, share in report.ends.items()},
        "placements": report.placements,
        "stages": [
            {
                "stage": each.stage,
                "replans": each.replans,
                "without_path": each.without_path.to_mapping(),
                "corrected_mm": None if math.isnan(each.corrected_mm) else each.corrected_mm,
            }
            for each in report.stages
        ],
    }


def _procedure_tables(report: lazy.ProcedureReport) -> list[Table]:
    """Return how procedures ended, and what each stage corrected."""
    rows = [_share_row("success", report.succeeds)]
    rows += [_share_row(name, share, fails=True) for name, share in report.failures]
    rows += [
        (f"{percent(share)} of the inserted end within", f"{miss:.2f}", "mm")
        for share, miss in report.miss_mm.items()
    ]
    title = (
        f"{report.samples} procedures '{report.procedure.name}', errors of '{report.model.label}'; "
        f"{_goal_words(report)}"
    )
    found = [terminal.table(title, ("ends with", "%", "95 % interval"), rows)]
    if report.stages:
        stages = [
            (
                each.stage,
                f"{each.replans / report.samples:.2f}",
                of_hundred(each.without_path.value, up=True),
                "" if math.isnan(each.corrected_mm) else f"{each.corrected_mm:.2f}",
            )
            for each in report.stages
        ]
        headings = ("planned again from", "times", "without a path, %", "would have missed by, mm (median)")
        title = f"The bronchoscope is placed {report.placements:.2f} times"
        found.append(terminal.table(title, headings, stages))
    return found


def start_region(
    plan: PlanFile,
    patient: PatientOfPlan,
    *,
    distance: Positive = 5.0,
    tilt: Positive = 15.0,
    poses: Samples = 10_000,
    iterations: SamplesOrNone = 100,
    radius: NotNegative | None = None,
    scope: bool = False,
    seed: Seed = 0,
    masks: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Tell from which poses near its start the needle of a stored plan still reaches the target, clear.

    Args:
        distance: Starts are tried up to so many mm away.
        tilt: Starts are tried up to so many degrees tilted.
        poses: About how many starts are tried.
        iterations: Of the search where nothing simpler finds a path; 0 for none.
        radius: How far in mm from the target a path may end, 0 for not at all; by default the radius of the
            goal, as of `risk`.
        scope: Whether poses of the scope's tip are tried as well, which takes some seconds.
        seed: Seed of the search.
    """
    stored, lung = masks.load_plan(plan, patient)
    with progress("trying start poses"):
        region = lazy.safe_start_region(
            stored, lung, radius_mm=radius, offset_mm=distance, tilt_deg=tilt, poses=poses,
            iterations=iterations, seed=seed,
        )  # fmt: skip
    of_scope = None
    if scope:
        with progress("trying poses of the scope"):
            of_scope = lazy.safe_scope_region(stored, lung, seed=seed)
    told = {} if of_scope is None else {"scope": of_scope.record()}
    terminal.tell({**region.record(), **told})
    terminal.say(f"{region.words}.")
    if of_scope is not None:
        terminal.say(f"{of_scope.words}.")
    found = [(words, str(count)) for words, count in region.tried.counts.items()]
    counts = terminal.table(f"{region.tried.kinds.size} starts were tried", ("found", "starts"), found)
    terminal.show([_proved_table(region), _tried_table(region), counts])
    return ExitCode.OK


def _proved_table(region: lazy.StartRegion) -> Table:
    import numpy as np

    proved = region.proved
    chosen = sorted({*np.linspace(0, len(proved.offsets_mm) - 1, 6).astype(int).tolist(), proved.best} - {-1})
    rows = [
        (
            f"{proved.offsets_mm[n]:.2f}",
            f"{np.degrees(proved.tilts_rad[n]):.2f}",
            "*" if n == proved.best else "",
        )
        for n in chosen
        if n < len(proved.offsets_mm)
    ]
    return terminal.table(
        "Proved: every start up to both has a clear path; * most of them", ("mm", "degrees", ""), rows
    )


def _tried_table(region: lazy.StartRegion) -> Table:
    import numpy as np

    tried, shares = region.tried, region.tried.table()
    steps = np.arange(1, len(shares) + 1) / len(shares)
    headings = ("up to", *(f"{angle:.0f}°" for angle in np.degrees(tried.tilt_rad) * steps))
    rows = [
        (f"{far:.1f} mm", *("–" if np.isnan(share) else of_hundred(share) for share in row))
        for far, row in zip(tried.offset_mm * steps, shares.tolist(), strict=True)
    ]
    return terminal.table("Tried: % of the starts with a clear path, ring by ring", headings, rows)
