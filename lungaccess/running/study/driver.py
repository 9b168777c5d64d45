"""Run a study on a cluster of dask.distributed; only this process writes the results file."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_value
from lungaccess.plans.version import software_kernels
from lungaccess.running.study.answers import CRASH, UNKNOWN, Answer
from lungaccess.running.study.cluster import Backlog, connect, interruptions_noted, require_dask
from lungaccess.running.study.results import ResultsFile
from lungaccess.running.study.runs import Problem, Run, runs_of
from lungaccess.running.study.settings import Study, StudyError
from stages.needle import require_planner

if TYPE_CHECKING:
    from distributed import Client

RETRIES = 2
"""How often a run that could not be made is tried again at once: workers and disks may fail for a moment."""
Progress = Callable[[str, float | None], None]


@frozen_value
class StudyDone:
    """What a start of a study did.

    The study has `runs`, of which the file had `stored_before`.  The start `added` some: fewer than the rest
    if another process stored some meanwhile.  Those that `failed` could not be made; the next start makes
    them again.  Of what was stored before, `other_kernels` runs were made with other kernels than those here,
    or do not say with which: their figures may differ from what would be found now.
    """

    runs: int
    stored_before: int
    other_kernels: int
    added: int
    failed: int
    wall_s: float


def run_study(
    study: Study,
    path: Path,
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    cache: Path | None = None,
    progress: Progress | None = None,
) -> StudyDone:
    """Make the runs of a study that a results file does not have, and store them there one by one.

    The results file is made if it is not there.

    Parameters
    ----------
    scheduler : str, optional
        Address of a running dask scheduler; processes on this machine if None.
    workers : int, optional
        How many processes on this machine; as many as there are cores if None.
    cache : Path, optional
        Folder of prepared anatomies and atlases, on every machine; the usual one if None.
    progress : callable, optional
        Receives what is being done, and the share of the missing runs that is done.

    Raises
    ------
    SettingsError
        If both a scheduler and a number of workers are given.
    StudyError
        If dask is not installed, or the scheduler does not answer.
    FileError
        If the results file cannot be read or written; what is stored by then stays.
    LungaccessError
        If a patient, a system or a target of the study cannot be read.
    """
    if workers is not None and scheduler is not None:
        raise SettingsError(
            f"--workers is {workers} and --scheduler is {scheduler}",
            expected="one of them: a scheduler has workers of its own",
            remedy="Leave out --workers",
        )
    began = time.perf_counter()
    say = progress or (lambda _words, _share: None)
    require_dask()
    with ResultsFile(path, create=True) as results:
        runs = list(runs_of(study, cache=cache, progress=lambda words: say(words, None)))
        stored = results.finished_keys()
        missing = [run for run in runs if run.key not in stored]
        there = {run.key for run in runs} & stored
        others = results.made_with_other_kernels(there, software_kernels())
        for name in {run.planner.of_the_needle for run in missing if run.planner.is_of_ompl}:
            require_planner(name)
        added = failed = 0
        if missing:
            say("starting workers", None)
            with connect(scheduler, workers) as client, interruptions_noted() as stop_if_interrupted:
                _prepare(client, missing, cache, say)
                for done, (run, answer) in enumerate(_answers(client, missing, cache), start=1):
                    new = results.add(run, answer)
                    added += new
                    failed += new and answer.failed
                    say(f"{done} of {len(missing)} runs, {run.problem.case}", done / len(missing))
                    stop_if_interrupted()
    return StudyDone(
        runs=len(runs),
        stored_before=len(runs) - len(missing),
        other_kernels=others,
        added=added,
        failed=failed,
        wall_s=time.perf_counter() - began,
    )


def _prepare(client: Client, runs: list[Run], cache: Path | None, say: Progress) -> None:
    """Let one worker for each patient and system make the atlas, before all of them need it."""
    problems: dict[Any, Problem] = {}
    for run in runs:
        if run.planner.kind == "plan":
            problems.setdefault((run.problem.patient, run.problem.system), run.problem)
    from concurrent.futures import CancelledError

    from distributed import KilledWorker

    from lungaccess.running.study.one_run import prepare

    for problem in problems.values():
        if not client.nthreads():
            say("waiting for a worker", None)
            client.wait_for_workers(1)
        say(f"enumerating what scope and tubes can do: {problem.case}", None)
        try:
            client.submit(prepare, problem, cache, pure=False, retries=RETRIES).result()
        except (KilledWorker, CancelledError) as error:
            raise StudyError(
                f"The atlas of {problem.case} could not be made ({error})",
                expected="workers with about 6 GiB of free memory",
                remedy="Start fewer workers with --workers",
            ) from error


def _answers(client: Client, runs: list[Run], cache: Path | None) -> Iterator[tuple[Run, Answer]]:
    """Yield each run's answer as it comes; only a few runs wait at the scheduler at any time."""
    from distributed import as_completed

    from lungaccess.running.study.one_run import answer

    waiting, under_way = iter(runs), dict[str, Run]()
    finished = as_completed(with_results=True, raise_errors=False)
    backlog = Backlog(client)
    while True:
        for run in islice(waiting, max(0, backlog.limit() - len(under_way))):
            key = task_key(run)
            future = client.submit(answer, run, cache, key=key, pure=False, retries=RETRIES)
            under_way[key] = run
            finished.add(future)
        if not under_way:
            return
        future, result = next(finished)
        run = under_way.pop(future.key)
        if future.status in ("cancelled", "lost"):
            raise StudyError(
                "The dask scheduler was lost",
                remedy="Start the study again, it goes on from what is stored",
                expected="a scheduler that runs until the study ends",
            )
        yield run, result if future.status == "finished" else _failed(run, result)
        future.release()


def task_key(run: Run) -> str:
    """Return what dask calls a run; it keeps statistics by the word before the dash, one for all runs."""
    return f"run-{run.key}"


def _failed(run: Run, raised: Any) -> Answer:
    """Return what is stored of a run that could not be made; dask hands over what `sys.exc_info` returns."""
    from distributed import KilledWorker

    error = raised[1] if isinstance(raised, tuple) else raised
    crashed = isinstance(error, KilledWorker)
    return Answer(
        key=run.key,
        outcome=type(error).__name__,
        status=CRASH if crashed else UNKNOWN,
        failed=True,
        message=f"{error}",
    )
