"""The commands `lungaccess benchmark ...`: published queries run with several planners."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter

from anatomy.base.errors import LungaccessError, SettingsError
from lungaccess.cli import terminal
from lungaccess.cli.commands.benchmark_synthetic import synthetic
from lungaccess.cli.examples import epilogue
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import Count, Seconds
from lungaccess.cli.options import PatientOptions, SystemOptions
from lungaccess.cli.progress import progress

if TYPE_CHECKING:
    from anatomy.liver import LiverImages
    from anatomy.organ import Organ
    from anatomy.patient import PatientImages
    from lungaccess.problem.system import System
    from lungaccess.running.benchmark.runs import BenchmarkRow, Pose

Rules = Literal["ours", "unc"]
DEFAULT_PLANNERS = "rrt,optimal,resolution,decide,control.RRT"

benchmark = App(
    name="benchmark",
    help="Run published queries with several planners, or a benchmark of synthetic patients.",
    help_epilogue=epilogue("benchmark med-rad"),
)
benchmark.command(synthetic)


@benchmark.command(name="med-rad", help_epilogue=epilogue("benchmark med-rad"))
def med_rad(
    folder: Path,
    *,
    rules: Rules = "ours",
    planners: str = DEFAULT_PLANNERS,
    radius: str | None = None,
    seeds: Annotated[Count, Parameter(name="--seeds")] = 3,
    budget: Seconds = 1.0,
    peer: Path | None = None,
    out: Path | None = None,
    system: SystemOptions = SystemOptions(),
    output: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Plan the needle from each published start to each published target; exit code 1 if none is reached.

    Args:
        folder: A patient, or a folder of patients.
        rules: ours: proved clearance of the system's needle, with the exemption at the airway wall. unc: a
            needle of 2 mm that keeps from voxel centres, obstacles within 3 mm of the start ignored, 1 mm
            goal tolerance.
        planners: Names separated by commas: rrt, ao-rrt, optimal, resolution, decide; of OMPL control.RRT,
            control.EST, control.KPIECE1.
        radius: Least radii of curvature in mm, separated by commas; if not given, that of the system, or
            50,100,121 by the rules of unc.
        seeds: Runs of each planner that draws at random.
        budget: Processor time of a run in seconds.
        peer: JSON file of another planner's recorded results, shown beside.
        out: File for all runs: .csv, or .json, which holds the arcs of the paths, too.
    """
    from lungaccess.running.benchmark.published import read_peer
    from lungaccess.running.benchmark.runs import require_table_file, summary_rows, write_rows

    names = _planners(planners)
    device = system.load()
    radii = _radii(radius, rules, device)
    recorded = None if peer is None else read_peer(peer)
    if out is not None:
        require_table_file(out)
    rows = list(_rows(folder, rules, device, radii, names, range(seeds), budget, output))
    if out is not None:
        write_rows(rows, out)
    headings, lines = summary_rows(rows, recorded)
    if output.json:
        terminal.show_json(
            {
                "rules": rules,
                "system": device.name if rules == "ours" else None,
                "budget_cpu_s": budget,
                "queries": [dict(zip(headings, line, strict=True)) for line in lines],
            }
        )
    else:
        shown = f"by the rules of {rules}" + (f", {device.name}" if rules == "ours" else "")
        terminal.show_wide([terminal.table(f"Published needle queries {shown}", headings, lines)])
        if recorded is not None:
            terminal.say(
                "The peer's columns: recorded runs by the rules of unc, on another machine. Its times do not"
                " compare; success and length do, by equal rules. Lengths include what is left to the target."
            )
        if out is not None:
            terminal.say(f"All runs are in {out}")
    return ExitCode.of(any(row.solved for row in rows))


def _rows(
    folder: Path,
    rules: Rules,
    device: "System",
    radii: tuple[float, ...],
    planners: tuple[str, ...],
    seeds: range,
    budget_s: float,
    output: PatientOptions,
) -> "Iterator[BenchmarkRow]":
    """Run everything, and say meanwhile what is being run; a patient that cannot be read gets a row."""
    from lungaccess.running.benchmark.published import patients_of, published_queries, why_no_query
    from lungaccess.running.benchmark.runs import BenchmarkRow, run_query

    paths = list(patients_of(folder))
    for path in paths:
        try:
            pose, patient = _posing(path, rules, device, output)
        except LungaccessError as error:
            if len(paths) == 1:
                raise
            yield BenchmarkRow(patient=path.name, reason=f"not read: {error.found}")
            continue
        if why_no_query(patient):
            yield BenchmarkRow(patient=path.name, reason=why_no_query(patient))
        asked = [(query, mm) for query in published_queries(patient, path.name) for mm in radii]
        with progress(f"{path.name}: {len(asked)} queries") as shown:
            for number, (query, mm) in enumerate(asked):
                shown.step(f"{path.name}, start {query.start}, R = {mm:g} mm", number / len(asked))
                yield from run_query(*pose(query, mm), query, mm, planners, seeds, budget_s)


def _posing(
    path: Path, rules: Rules, device: "System", output: PatientOptions
) -> "tuple[Pose, Organ | PatientImages | LiverImages]":
    """Return what makes environments of a patient by the rules, and the patient."""
    from lungaccess.running.benchmark.runs import posed_by_unc, posed_in_lung

    if rules == "ours":
        lung = output.load_organ(path)
        return posed_in_lung(lung, device), lung
    from anatomy.io.liver import is_liver, load_liver
    from anatomy.io.patients import load_patient

    with progress(f"reading {path}"):
        images = load_liver(path) if is_liver(path) else load_patient(path)
    return posed_by_unc(images), images


def _planners(text: str) -> tuple[str, ...]:
    from stages.needle import NEEDLE_PLANNERS, OMPL_PLANNERS, has_ompl, require_planner

    names = tuple(name.strip() for name in text.split(",") if name.strip())
    if text == DEFAULT_PLANNERS and not has_ompl():
        names = tuple(name for name in names if name not in OMPL_PLANNERS)
        terminal.progress_console.print("The planners of OMPL are left out: OMPL is not installed.")
    for name in names:
        require_planner(name)
    if not names:
        raise SettingsError(
            "--planners names no planner",
            expected=", ".join(NEEDLE_PLANNERS),
            remedy="Name one or more, such as --planners rrt",
        )
    return names


def _radii(text: str | None, rules: Rules, device: "System") -> tuple[float, ...]:
    if text is None and rules == "ours":
        return (device.require_needle("The benchmark of needles").min_radius_of_curvature_mm,)
    try:
        # The radii of the peer's recorded runs.
        radii = tuple(float(part) for part in ("50,100,121" if text is None else text).split(","))
    except ValueError:
        radii = ()
    if not radii or not all(5.0 <= mm < float("inf") for mm in radii):
        raise SettingsError(
            f"--radius is {text!r}",
            expected="radii of 5 mm or more, separated by commas",
            remedy="State radii such as --radius 50,121",
        )
    return radii
