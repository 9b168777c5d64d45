"""The commands `lungaccess study ...`: sweeps of patients, targets, devices, planners and seeds."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter
from rich.table import Table

from anatomy.base.errors import SettingsError
from anatomy.base.words import of_hundred
from lungaccess.cli import lazy, terminal
from lungaccess.cli.examples import epilogue
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import Processes
from lungaccess.cli.progress import progress

study = App(
    name="study",
    help="Run many plans from one file, into one file of results.",
    help_epilogue=epilogue("study run"),
)


@study.command(help_epilogue=epilogue("study run"))
def run(
    study: Path,
    *,
    out: Path = Path("results.db"),
    scheduler: str | None = None,
    workers: Annotated[Processes | None, Parameter(name="--workers")] = None,
) -> ExitCode:
    """Make the runs of a study that the results do not have yet; exit code 1 if one could not be made.

    Stop it at any time and start it again: it goes on from what is stored.

    Args:
        study: TOML file of the study.
        out: Results file (SQLite); made if it is not there.
        scheduler: Address of a running dask scheduler, such as tcp://host:8786; this machine if not given.
        workers: How many processes on this machine; as many as it has cores if not given.
    """
    asked = lazy.read_study(study)
    with progress(asked.name) as shown:
        done = lazy.run_study(asked, out, scheduler=scheduler, workers=workers, progress=shown.step)
    groups = lazy.summarise(out)
    terminal.tell(asdict(done) | {"results": str(out), "groups": [asdict(group) for group in groups]})
    terminal.show([_table(asked.name, groups)])
    terminal.console.print(
        f"{done.runs} runs: {done.stored_before} were stored, {done.added} added in {done.wall_s:.1f} s. "
        f"Written to {out}"
    )
    if done.other_kernels:
        terminal.console.print(
            f"{done.other_kernels} of the stored runs were made with other kernels than those here, "
            f"{lazy.software_kernels()}, or do not say with which. For runs of one kind, write to another "
            "file.",
            style="yellow",
        )
    if done.failed:
        terminal.console.print(f"{done.failed} could not be made; start the study again.", style="bold red")
    return ExitCode.of(not done.failed)


@study.command(help_epilogue=epilogue("study show"))
def show(results: Path) -> ExitCode:
    """Show what is stored, by case and planner.

    Args:
        results: Results file.
    """
    groups = lazy.summarise(results)
    terminal.tell([asdict(group) for group in groups])
    terminal.show([_table(str(results), groups)])
    return ExitCode.OK


@study.command(help_epilogue=epilogue("study export"))
def export(results: Path, *, csv: Path | None = None, parquet: Path | None = None) -> ExitCode:
    """Write the tables of the results as CSV or Parquet.

    Args:
        results: Results file.
        csv: Folder for runs.csv, progress.csv, findings.csv, rejections.csv and plans.csv.
        parquet: Folder for the same as Parquet.
    """
    if csv is None and parquet is None:
        raise SettingsError(
            "Nothing to export to was given",
            expected="--csv FOLDER or --parquet FOLDER",
            remedy="Add one of them",
        )
    written = [] if csv is None else lazy.export_csv(results, csv)
    written += [] if parquet is None else lazy.export_parquet(results, parquet)
    terminal.tell({"written": [str(path) for path in written]})
    for path in written:
        terminal.say(f"Written to {path}")
    return ExitCode.OK


@study.command(help_epilogue=epilogue("study compare"))
def compare(first: Path, second: Path) -> ExitCode:
    """Compare two results files, but for times and memory; exit code 1 if they differ.

    Args:
        first, second: Results files.
    """
    found = lazy.differences(first, second)
    terminal.tell(found)
    for each in found:
        terminal.say(each)
    terminal.console.print("They differ." if found else "They hold the same runs with the same answers.")
    return ExitCode.of(not found)


def _table(title: str, groups: "list[lazy.Group]") -> Table:
    headings = (
        "case", "planner", "runs", "failed", "solved, %", "accepted, %", "first, s", "run, s", "cost",
        "succeeds, %",
    )  # fmt: skip
    rows = [
        (
            group.case, group.planner, f"{group.runs}", f"{group.failed}", of_hundred(group.solved_share),
            of_hundred(group.accepted_share) if group.first_plan_s else "",
            "" if group.first_plan_s is None else f"{group.first_plan_s[0]:.3f}", f"{group.run_s:.2f}",
            "" if group.cost is None else f"{group.cost:.4g}",
            "" if group.success is None else of_hundred(group.success),
        )
        for group in groups
    ]  # fmt: skip
    columns = len(headings) - all(group.success is None for group in groups)
    return terminal.table(title, headings[:columns], [row[:columns] for row in rows])
