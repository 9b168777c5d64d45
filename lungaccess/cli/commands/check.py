"""The commands `lungaccess check`, `window` and `insert`: what a stored plan keeps, and what it does not."""

from __future__ import annotations

from pathlib import Path
from statistics import median
from typing import Annotated, Any

from cyclopts import Parameter
from rich.table import Table

from anatomy.base.errors import SettingsError
from anatomy.base.files import require_suffix, require_writable_folder
from anatomy.base.words import of_hundred, percent, range_of_hundred
from lungaccess.cli import lazy, terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import Count, Hertz, NotNegative, Positive, Samples, Seed
from lungaccess.cli.options import (
    ErrorOptions,
    ErrorsText,
    PatientOfPlan,
    PatientOptions,
    PlanFile,
    require_picture,
)
from lungaccess.cli.plan_search import check_tables, show_findings, show_headline
from lungaccess.cli.progress import progress


def check(
    plan: Path,
    patient: PatientOfPlan,
    *,
    system: str | None = None,
    curve: str | None = None,
    out: Path | None = None,
    errors: ErrorOptions = ErrorOptions(),
    everything: Annotated[bool, Parameter(name="--all", negative="")] = False,
    masks: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Check a stored plan by independent code; exit code 0 if it is accepted, 1 if it is refused.

    Args:
        plan: The plan.json to check.
        system: Check against this preset or TOML file instead of the devices stated in the plan.
        curve: Check the plan with a curve that was edited in 3D Slicer, scene.mrml#needle, and say what
            broke.
        out: Where the plan with the edited needle goes if it is accepted.
        everything: List every finding, not only the nearest limits.
    """
    if curve is not None:
        if system or errors.errors or errors.procedure:
            raise SettingsError(
                "--curve is asked for with --system, --errors or --procedure",
                expected="an edited curve alone, which is checked with the devices of the plan",
                remedy="Save the plan with --out, and check that",
            )
        return _check_curve(plan, patient, curve, out, masks, everything=everything)
    if out is not None:
        raise SettingsError(
            "--out is given without --curve",
            expected="an edited curve",
            remedy="Add --curve scene.mrml#needle",
        )

    stored, model = lazy.Plan.load(plan), errors.given()
    device = None if system is None else lazy.load_system(system)
    followed = errors.given_procedure()
    lung = masks.load(patient, thick_slices=True)
    appraisal = lazy.appraise(stored, lung, errors=model, procedure=followed, system=device)
    terminal.tell({**appraisal.to_mapping(), **appraisal.check.to_mapping()})
    show_headline(appraisal.headline)
    show_findings(appraisal)
    if everything:
        terminal.show(check_tables(appraisal.check))
    return ExitCode.of(appraisal.accepted)


def _check_curve(
    plan: Path, patient: Path, text: str, out: Path | None, masks: PatientOptions, *, everything: bool
) -> ExitCode:
    saved = lazy.parse_reference(text)
    if saved is None:
        raise SettingsError(
            f"--curve is {text!r}",
            expected="a file of 3D Slicer and the name of a curve in it",
            remedy="Write --curve scene.mrml#needle",
        )
    stored, curve = lazy.Plan.load(plan), lazy.read_named_curve(saved)
    lung = masks.load(patient, thick_slices=True)
    edited = lazy.check_curve(stored, lung, curve)
    report = edited.report
    if out is not None and report.accepted:
        edited.plan.save(out)
    terminal.tell({"device": edited.device, "edited": edited.words, **report.to_mapping()})
    terminal.say(edited.words)
    show_headline(lazy.Headline.of(report, None))
    for finding in (*report.refusals, *report.unchecked):
        terminal.say(f"{finding}")
    if everything:
        terminal.show(check_tables(report))
    if out is not None and report.accepted:
        terminal.say(f"Written to {out}")
    return ExitCode.of(report.accepted)


def window(
    plan: Path,
    patient: PatientOfPlan,
    *,
    tolerance: NotNegative = 2.0,
    out: Path | None = None,
    tissue_carries_needle: bool = False,
    picture: Path | None = None,
    masks: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Show in which phases of the breath a plan is proved clear and on target; exit code 1 if in none.

    The patient needs a motion: [motion] in its patient.toml.

    Args:
        plan: The plan.json.
        tolerance: Largest distance in mm to the moving target, at most 2.
        out: A plan.json to write, the plan with its window.
        tissue_carries_needle: Show what the breath does to the needle once it is in place, as a figure.
        picture: A PNG to write, the window on a clock.
    """
    from dataclasses import asdict, replace

    for file, suffix in ((out, ".json"), (picture, ".png")):
        if file is not None:
            require_suffix(file, suffix)
    stored, lung = masks.load_plan(plan, patient)
    found = lazy.breathing_window(stored, lung, tolerance_mm=tolerance)
    in_place = lazy.carried_needle(stored, lung, found) if tissue_carries_needle else None
    if out is not None:
        replace(stored, window=found).save(out)
    if picture is not None:
        lazy.window_png(found, picture)
    told = {} if in_place is None else {"needle_in_tissue_not_proved": asdict(in_place)}
    terminal.tell({**lazy.plain(found), "share": found.share, "words": found.words, **told})
    terminal.say(found.words)
    rows = [(f"{of_hundred(a, up=True)} to {percent(b)}", percent(b - a)) for a, b in found.phases.tolist()]
    rows += [("not decided", percent(found.undecided_share))]
    tables = [terminal.table(f"Window of breathing: {found.motion_source}", ("phases", "share"), rows)]
    if in_place is not None:
        tables.append(_in_place(in_place))
    terminal.show(tables)
    return ExitCode.of(len(found.phases) > 0)


def _in_place(needle: lazy.CarriedNeedle) -> Table:
    rows = [
        ("its end to the moving target", f"{needle.end_miss_mm:.1f} mm"),
        ("shift of its begin from the tubes", f"{needle.shift_at_tubes_mm:.1f} mm"),
        ("bend there", f"{needle.bend_at_tubes_deg:.0f}°"),
        ("smallest radius of curvature", f"{needle.least_radius_mm:.0f} mm"),
        ("length of its way through tissue", f"{100.0 * needle.length_factor:.1f} %"),
    ]
    title = "In place, carried by tissue: worst of the breath, sampled, not proved"
    return terminal.table(title, ("", ""), rows)


def insert(
    plan: PlanFile,
    patient: PatientOfPlan,
    *,
    noise: NotNegative = 0.5,
    tilt: NotNegative = 0.6,
    rate: Hertz = 20.0,
    latency: NotNegative = 0.1,
    lost: NotNegative = 0.0,
    speed: Positive = 2.0,
    replan_every: NotNegative = 2.0,
    number: Annotated[Count, Parameter(name="--pass")] = 1,
    errors: ErrorsText = None,
    tolerance: NotNegative = 2.0,
    samples: Samples = 50,
    seed: Seed = 0,
    film: Path | None = None,
    picture: Path | None = None,
    masks: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Insert the needle of a plan with errors, blindly and planned again by what a tracker sees.

    Args:
        noise: Noise of the tracked tip along each axis, mm.
        tilt: Noise of its direction about each of two axes, degrees.
        rate: Measurements a second.
        latency: Age of a measurement when it is used, s.
        lost: Share of the measurements that are lost, 0 to 1.
        speed: Speed of the insertion, mm/s.
        replan_every: Least insertion between two replans, mm.
        number: Which pass of the plan, where it has several.
        tolerance: A tip that ends no farther from the target has reached it, mm.
        samples: How many needles are inserted, each in both ways.
        seed: Seed of the first needle; the others count on.
        film: WebP file for a film of the first needle, blindly and tracked.
        picture: PNG file for the true paths and tip errors of all.
    """
    passes = lazy.Plan.load(plan).passes
    if not 1 <= number <= len(passes):
        raise SettingsError(f"--pass is {number}", expected=f"a pass of the plan, 1 to {len(passes)}")
    stored = passes[number - 1]
    steering = lazy.NeedleSteering(
        closed_loop=True, measure_every_mm=speed / rate, replan_every_mm=replan_every, position_mm=noise,
        direction_deg=tilt, target_mm=noise, latency_mm=latency * speed, lost_share=lost,
    )  # fmt: skip
    if film is not None and film.suffix.lower() != ".webp":
        raise SettingsError(
            f"--film is {film}", expected="a file name that ends in .webp", remedy="Choose insert.webp"
        )
    if film is not None:
        require_writable_folder(film.parent)
    if picture is not None:
        require_picture(picture)
    lung = masks.load(patient)
    model = None if errors is None else lazy.load_errors(errors)
    with progress("inserting needles"):
        found = lazy.insert_plan(
            stored, lung, steering, errors=model, samples=samples, seed=seed, tolerance_mm=tolerance
        )
    accepted = lazy.check(stored, lung).accepted
    files = []
    if film is not None:
        files.append(str(lazy.insertion_webp(found, lung, film)))
    if picture is not None:
        files.append(str(lazy.insertions_png(found, lung, picture)))
    record = found.to_mapping()
    terminal.tell({**record, "plan_accepted": accepted, "files": files})
    if not accepted:
        terminal.say("The check REFUSES this plan: `lungaccess check` says why.")
    terminal.show([_table(found, record)])
    if files:
        terminal.say(f"Written: {', '.join(files)}")
    return ExitCode.of(accepted)


def _table(found: lazy.InsertionStudy, record: dict[str, Any]) -> Table:
    columns = [record["open_loop"], record["closed_loop"]]
    hits = [", ".join(f"{name} {n}" for name, n in each["hits"].items()) or "none" for each in columns]
    reached = [each["reached"] for each in columns]
    # By how much the believed factor of the curvature differs from the true one.
    bent = [run for run in found.closed_loop.insertions if run.factor > 0.0]
    off = [abs(run.believed_factor / run.factor - 1.0) for run in bent]
    rows = [
        ("reached, %", *(of_hundred(each["probability"]) for each in reached)),
        ("95 % interval", *(range_of_hundred(each["interval_95"]) for each in reached)),
        ("hit", *hits),
        ("no path left", *(f"{each['outcomes']['no path left']}" for each in columns)),
        ("tip error, median, mm", *(f"{each['tip_error_median_mm']:.2f}" for each in columns)),
        ("95 % within, mm", *(f"{each['tip_error_95_mm']:.2f}" for each in columns)),
        ("curvature known to, median, %", "not", of_hundred(median(off)) if off else "none bends"),
        ("replans", *(f"{each['replans']}" for each in columns)),
        ("of them without a path", *(f"{each['replans_without_path']}" for each in columns)),
    ]
    title = f"{record['samples']} needles, each inserted in both ways"
    made = terminal.table(title, ("", "blind", "tracked"), rows)
    tracker = found.steering
    made.caption = (
        f"Tracker: {tracker.position_mm:g} mm and {tracker.direction_deg:g}°, "
        f"every {tracker.measure_every_mm:g} mm, {tracker.latency_mm:g} mm late, "
        f"{percent(tracker.lost_share)} lost. Errors of needle and target: {found.errors.label}."
    )
    return made
