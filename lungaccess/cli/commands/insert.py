"""The command `lungaccess insert`: the needle of a plan inserted with errors, watched by a tracker."""

from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from rich.table import Table

from anatomy.base.errors import SettingsError
from anatomy.base.files import require_writable_folder
from anatomy.base.words import of_hundred, percent, range_of_hundred
from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import Count, Hertz, NotNegative, Positive, Samples, Seed
from lungaccess.cli.options import ErrorsText, PatientOfPlan, PatientOptions, PlanFile, require_picture
from lungaccess.cli.progress import progress

if TYPE_CHECKING:
    from lungaccess.planning.procedure.insertion import InsertionStudy


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
    output: PatientOptions = PatientOptions(),
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
    from lungaccess.judging.checking import check
    from lungaccess.planning.procedure import insert_plan
    from lungaccess.plans.plan import Plan
    from lungaccess.problem.error_files import load_errors
    from lungaccess.problem.procedures import NeedleSteering
    from lungaccess.showing.report.insertion import insertion_webp, insertions_png

    passes = Plan.load(plan).passes
    if not 1 <= number <= len(passes):
        raise SettingsError(f"--pass is {number}", expected=f"a pass of the plan, 1 to {len(passes)}")
    stored = passes[number - 1]
    steering = NeedleSteering(
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
    lung = output.load(patient)
    model = None if errors is None else load_errors(errors)
    with progress("inserting needles"):
        found = insert_plan(
            stored, lung, steering, errors=model, samples=samples, seed=seed, tolerance_mm=tolerance
        )
    accepted = check(stored, lung).accepted
    files = []
    if film is not None:
        files.append(str(insertion_webp(found, lung, film)))
    if picture is not None:
        files.append(str(insertions_png(found, lung, picture)))
    record = found.to_mapping()
    if output.json:
        terminal.show_json({**record, "plan_accepted": accepted, "files": files})
    else:
        if not accepted:
            terminal.say("The check REFUSES this plan: `lungaccess check` says why.")
        terminal.show([_table(found, record)])
        if files:
            terminal.say(f"Written: {', '.join(files)}")
    return ExitCode.of(accepted)


def _table(found: "InsertionStudy", record: dict[str, Any]) -> Table:
    columns = [record["open_loop"], record["closed_loop"]]
    hits = [", ".join(f"{name} {n}" for name, n in each["hits"].items()) or "none" for each in columns]
    reached = [each["reached"] for each in columns]
    rows = [
        ("reached, %", *(of_hundred(each["probability"]) for each in reached)),
        ("95 % interval", *(range_of_hundred(each["interval_95"]) for each in reached)),
        ("hit", *hits),
        ("no path left", *(f"{each['outcomes']['no path left']}" for each in columns)),
        ("tip error, median, mm", *(f"{each['tip_error_median_mm']:.2f}" for each in columns)),
        ("95 % within, mm", *(f"{each['tip_error_95_mm']:.2f}" for each in columns)),
        ("curvature known to, median, %", "not", _known(found)),
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


def _known(found: "InsertionStudy") -> str:
    """Return by how much the believed factor of the curvature differs from the true one, in words."""
    bent = [run for run in found.closed_loop.insertions if run.factor > 0.0]
    off = [abs(run.believed_factor / run.factor - 1.0) for run in bent]
    return of_hundred(median(off)) if off else "none bends"
