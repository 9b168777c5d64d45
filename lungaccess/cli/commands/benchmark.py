"""The commands `lungaccess benchmark ...`: published queries and synthetic patients, run and scored."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter

from anatomy.base.errors import LungaccessError, SettingsError
from anatomy.base.files import require_writable_folder
from lungaccess.cli import lazy, terminal
from lungaccess.cli.examples import epilogue
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import Count, CountOrNone, Processes, SamplesOrNone, Seconds
from lungaccess.cli.options import PatientOptions, SystemOptions
from lungaccess.cli.progress import progress
from lungaccess.cli.result_folder import claim_folder

NAME = "synthetic-v1"
synthetic = App(
    name=NAME,
    help="A benchmark that anybody may ship: 50 synthetic patients, 20 targets each, three devices.",
    help_epilogue=epilogue(f"benchmark {NAME} make"),
)


def names_of(text: str | None) -> tuple[str, ...]:
    """Return the names in a text that commas separate; none without a text; SettingsError if one is empty."""
    if text is None:
        return ()
    names = tuple(name.strip() for name in text.split(","))
    if not all(names):
        raise SettingsError(
            f"A name is empty in {text!r}",
            expected="names separated by commas",
            remedy="Leave the option out to take all",
        )
    return names


@synthetic.command(help_epilogue=epilogue(f"benchmark {NAME} make"))
def make(
    *,
    out: Path = Path("SYNTHETIC"),
    phantoms: str | None = None,
    ct: Annotated[bool, Parameter(negative="")] = False,
    tips: bool = True,
) -> ExitCode:
    """Write the cases as files: masks, targets, devices, and scope tips with the motions that lead there.

    What is there already stays; every phantom is compared with the hash of the manifest.

    Args:
        out: Folder of the cases.
        phantoms: Names separated by commas, such as adult-01,child-03; all fifty if not given.
        ct: Also the CTs, about 25 MB each; no rule needs them.
        tips: Also the scope tips, from which a planner without a bronchoscope of its own can start.
    """
    claim_folder(out, ())
    with progress("making synthetic patients") as shown:
        made = lazy.write_benchmark(out, names_of(phantoms), with_ct=ct, with_tips=tips, progress=shown.step)
    terminal.tell({"folder": str(out), "phantoms": [each.name for each in made]})
    terminal.say(
        f"Written to {out}: {len(made)} phantoms, their queries in case.json, the rules in benchmark.json"
    )
    terminal.say(f"Run a method with: lungaccess benchmark {NAME} run {out}")
    return ExitCode.OK


@synthetic.command(help_epilogue=epilogue(f"benchmark {NAME} run"))
def run(
    folder: Path,
    *,
    methods: str = "atlas",
    phantoms: str | None = None,
    devices: str | None = None,
    targets: Annotated[Count | None, Parameter(name="--targets")] = None,
    iterations: Annotated[Count | None, Parameter(name="--iterations")] = 100,
    time_s: Annotated[Seconds | None, Parameter(name="--time")] = None,
    out: Path = Path("results.db"),
    answers: Path | None = None,
    scheduler: str | None = None,
    workers: Annotated[Processes | None, Parameter(name="--workers")] = None,
) -> ExitCode:
    """Run methods of lungaccess on the cases, as a study; stop it at any time and start it again.

    Exit code 1 if a run could not be made.

    Args:
        folder: The cases, as `make` wrote them.
        methods: METHOD or METHOD+NEEDLE_PLANNER, separated by commas, such as
            atlas,kuntz2015,kuntz2015+control.RRT.
        phantoms: Names separated by commas; those of the folder if not given.
        devices: Presets separated by commas; all three if not given.
        targets: The first so many of each lung of a phantom; all ten if not given.
        iterations: Budget of a query beyond the direct arcs, which can be repeated exactly.
        time_s: Budget in seconds beside it, for planners of OMPL.
        out: Results file (SQLite); made if it is not there.
        answers: Folder for one submission a method, METHOD.json, to be scored.
        scheduler: Address of a running dask scheduler; this machine if not given.
        workers: How many processes on this machine.
    """
    devices_asked = {"systems": names_of(devices)} if devices is not None else {}
    study = lazy.benchmark_study(
        folder, names_of(methods), phantoms=names_of(phantoms), targets=targets, iterations=iterations,
        time_s=time_s, **devices_asked,
    )  # fmt: skip
    with progress(NAME) as shown:
        done = lazy.run_study(study, out, scheduler=scheduler, workers=workers, progress=shown.step)
    written = [] if answers is None else _write_answers(out, answers)
    terminal.tell(asdict(done) | {"results": str(out), "answers": [str(path) for path in written]})
    terminal.say(
        f"{done.runs} runs: {done.stored_before} were stored, {done.added} added, {done.failed} could not be "
        f"made. Written to {out}"
    )
    for path in written:
        terminal.say(f"Score with: lungaccess benchmark {NAME} score {path} {folder}")
    return ExitCode.of(not done.failed)


def _write_answers(results: Path, folder: Path) -> list[Path]:
    require_writable_folder(folder)
    written = []
    for each in lazy.submissions_of(results):
        written.append(folder / f"{each.planner}.json")
        lazy.write_submission(each, written[-1])
    return written


@synthetic.command(help_epilogue=epilogue(f"benchmark {NAME} score"))
def score(
    submission: Path,
    folder: Path,
    *,
    samples: SamplesOrNone = 1000,
    certify: CountOrNone = 0,
    only_answered: Annotated[bool, Parameter(negative="")] = False,
    out: Path | None = None,
) -> ExitCode:
    """Score a submission by the independent check alone; exit code 1 if an answer is refused.

    Args:
        submission: JSON file of poses and arcs; docs/reference/submission.md describes it.
        folder: The cases, as `make` wrote them.
        samples: Deviated plans for the chance of success of each; 0 for no estimate.
        certify: Budget, in ranges of deployments, of the proof that a target claimed unreachable is so; 0 for
            no proof.
        only_answered: Leave out queries without an answer, which otherwise count as not solved.
        out: File for the scores of all queries: .json, from which `sheet` compares planners, or .csv.
    """
    if out is not None:
        lazy.require_table_file(out)
    handed_in = lazy.read_submission(submission)
    with progress(f"scoring {handed_in.planner}") as shown:
        scores = list(
            lazy.score_submission(
                handed_in, folder, samples=samples, certify_boxes=certify,
                only_answered=only_answered, progress=shown.step,
            )
        )  # fmt: skip
    if out is not None:
        lazy.write_scores(scores, out)
    refusals = [each for each in scores if each.status == lazy.REFUSED]
    _show_sheet(scores)
    for each in refusals:
        terminal.say(f"{each.query} is refused: {each.reason}")
    if out is not None:
        terminal.say(f"All scores are in {out}")
    return ExitCode.of(not refusals)


@synthetic.command(help_epilogue=epilogue(f"benchmark {NAME} sheet"))
def sheet(
    *scores: Path, csv: Path | None = None, brief: Annotated[bool, Parameter(negative="")] = False
) -> ExitCode:
    """Print the score sheet of one or several planners.

    Args:
        scores: JSON files that `score --out` wrote.
        csv: Also write the sheet as a .csv or .json file.
        brief: One line a planner, without families and devices.
    """
    if not scores:
        raise SettingsError("No scores were given", expected="one or more files", remedy="Name scores.json")
    rows = [each for path in scores for each in lazy.read_scores(path)]
    if csv is not None:
        lazy.write_sheet(lazy.score_sheet(rows, by_family=not brief), csv)
    _show_sheet(rows, by_family=not brief)
    return ExitCode.OK


@synthetic.command(help_epilogue=epilogue(f"benchmark {NAME} schema"))
def schema() -> ExitCode:
    """Print the JSON Schema of a submission."""
    terminal.show_json(lazy.submission_schema())
    return ExitCode.OK


def _show_sheet(scores: list[lazy.Score], *, by_family: bool = True) -> None:
    lines = lazy.score_sheet(scores, by_family=by_family)
    about = {"benchmark": NAME, "manifest_sha256": lazy.manifest_sha256()}
    refused = {each.query: each.reason for each in scores if each.reason}
    terminal.tell({**about, "sheet": [asdict(line) for line in lines], "refused": refused})
    terminal.show_wide([terminal.table(f"Scores of {NAME}", lazy.HEADINGS, [line.cells() for line in lines])])


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
    masks: PatientOptions = PatientOptions(),
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
    names = _planners(planners)
    device = system.load()
    radii = _radii(radius, rules, device)
    recorded = None if peer is None else lazy.read_peer(peer)
    if out is not None:
        lazy.require_table_file(out)
    rows = list(_rows(folder, rules, device, radii, names, range(seeds), budget, masks))
    if out is not None:
        lazy.write_rows(rows, out)
    headings, lines = lazy.summary_rows(rows, recorded)
    terminal.tell(
        {
            "rules": rules,
            "system": device.name if rules == "ours" else None,
            "budget_cpu_s": budget,
            "queries": [dict(zip(headings, line, strict=True)) for line in lines],
        }
    )
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
    device: lazy.System,
    radii: tuple[float, ...],
    planners: tuple[str, ...],
    seeds: range,
    budget_s: float,
    masks: PatientOptions,
) -> Iterator[lazy.BenchmarkRow]:
    """Run everything, and say meanwhile what is being run; a patient that cannot be read gets a row."""
    paths = list(lazy.patients_of(folder))
    for path in paths:
        try:
            pose, patient = _posing(path, rules, device, masks)
        except LungaccessError as error:
            if len(paths) == 1:
                raise
            yield lazy.BenchmarkRow(patient=path.name, reason=f"not read: {error.found}")
            continue
        if lazy.why_no_query(patient):
            yield lazy.BenchmarkRow(patient=path.name, reason=lazy.why_no_query(patient))
        asked = [(query, mm) for query in lazy.published_queries(patient, path.name) for mm in radii]
        with progress(f"{path.name}: {len(asked)} queries") as shown:
            for number, (query, mm) in enumerate(asked):
                shown.step(f"{path.name}, start {query.start}, R = {mm:g} mm", number / len(asked))
                yield from lazy.run_query(*pose(query, mm), query, mm, planners, seeds, budget_s)


def _posing(
    path: Path, rules: Rules, device: lazy.System, masks: PatientOptions
) -> tuple[lazy.Pose, lazy.Organ | lazy.PatientImages | lazy.LiverImages]:
    if rules == "ours":
        lung = masks.load_organ(path)
        return lazy.posed_in_lung(lung, device), lung
    from anatomy.io.patients import load_patient

    with progress(f"reading {path}"):
        images = lazy.load_liver(path) if lazy.is_liver(path) else load_patient(path)
    return lazy.posed_by_unc(images), images


def _planners(text: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    if text == DEFAULT_PLANNERS and not lazy.has_ompl():
        names = tuple(name for name in names if name not in lazy.OMPL_PLANNERS)
        terminal.progress_console.print("The planners of OMPL are left out: OMPL is not installed.")
    for name in names:
        lazy.require_planner(name)
    if not names:
        raise SettingsError(
            "--planners names no planner",
            expected=", ".join(lazy.NEEDLE_PLANNERS),
            remedy="Name one or more, such as --planners rrt",
        )
    return names


def _radii(text: str | None, rules: Rules, device: lazy.System) -> tuple[float, ...]:
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
