"""Run a study on a cluster of dask.distributed, new or running; only this process writes the results file."""

import contextlib
import functools
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from anatomy.base.cache import stated_cache
from anatomy.base.errors import LungaccessError, SettingsError
from anatomy.base.records import frozen_value
from anatomy.base.unfinished import sole_writer
from lungaccess.plans.version import software_kernels
from lungaccess.running.study.results import ResultsFile
from lungaccess.running.study.runs import CRASH, UNKNOWN, Answer, Problem, Run, runs_of
from lungaccess.running.study.settings import Study, StudyError
from stages.needle import require_planner

if TYPE_CHECKING:
    from distributed import Client

Progress = Callable[[str, float | None], None]


@frozen_value
class StudyDone:
    """What a start of a study did.

    The study has `runs`, of which the file had `stored_before`.  The start `added` some.  Those that `failed`
    could not be made; the next start makes them again.  Of what was stored before, `other_kernels` runs were
    made with other kernels than those here, or do not say with which: their figures may differ from what
    would be found now.
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

    The results file is made if it is not there.  A dask scheduler at an address, or else so many processes on
    this machine, make the runs; all cores if None.  Every machine has the cache of prepared anatomies and
    atlases.

    Raises:
        SettingsError: If both a scheduler and a number of workers are given.
        StudyError: If dask is not installed, or the scheduler does not answer.
        FileError: If the results file cannot be read or written, or another process adds to it; what is
            stored by then stays.
        LungaccessError: If a patient, a system or a target of the study cannot be read.
    """
    say = progress or (lambda _words, _share: None)
    with open_results(path, scheduler=scheduler, workers=workers, cache=cache) as maker:
        return maker.make(list(runs_of(study, cache=cache, progress=lambda words: say(words, None))), say)


@contextlib.contextmanager
def open_results(
    path: Path, *, scheduler: str | None, workers: int | None, cache: Path | None
) -> "Iterator[RunMaker]":
    """Open a results file, for runs that are added to it; parameters and errors are those of `run_study`."""
    if workers is not None and scheduler is not None:
        raise SettingsError(
            f"--workers is {workers} and --scheduler is {scheduler}",
            expected="one of them: a scheduler has workers of its own",
            remedy="Leave out --workers",
        )
    _require_dask()
    cache = cache or stated_cache()  # Workers of another machine do not have the environment of this one.
    with ResultsFile(path, create=True) as results, contextlib.ExitStack() as stack:
        stack.enter_context(sole_writer(path, path.parent, f".{path.name}.lock"))
        yield RunMaker(results, cache, lambda: stack.enter_context(connect(scheduler, workers)))


class RunMaker:
    """Makes the runs that a results file does not have; workers start with the first that is missing."""

    def __init__(self, results: ResultsFile, cache: Path | None, start: "Callable[[], Client]") -> None:
        self.results, self._cache, self._client = results, cache, functools.cache(start)
        self._began = time.perf_counter()

    def make(self, runs: Sequence[Run], say: Progress) -> StudyDone:
        """Make those of the runs that are missing, and store them one by one."""
        from lungaccess.running.study.one_run import answer

        results = self.results
        stored = results.finished_keys()
        missing = [run for run in runs if run.key not in stored]
        others = results.made_with_other_kernels({run.key for run in runs} & stored, software_kernels())
        for name in {run.planner.of_the_needle for run in missing if run.planner.is_of_ompl}:
            require_planner(name)
        added = failed = 0
        if missing:
            say("starting workers", None)
            client = self._client()
            with _interruptions_noted() as stop_if_interrupted:
                _prepare(client, missing, self._cache, say)
                for done, (run, found) in enumerate(each_done(client, answer, missing, self._cache), start=1):
                    made = found if isinstance(found, Answer) else _failed(run, found)
                    new = results.add(run, made)
                    added += new
                    failed += new and made.failed
                    say(f"{done} of {len(missing)} runs, {run.problem.case}", done / len(missing))
                    stop_if_interrupted()
        return StudyDone(
            runs=len(runs),
            stored_before=len(runs) - len(missing),
            other_kernels=others,
            added=added,
            failed=failed,
            wall_s=time.perf_counter() - self._began,
        )


def _prepare(client: "Client", runs: Sequence[Run], cache: Path | None, say: Progress) -> None:
    """Let one worker for each patient, scope and tubes make the atlas, before all of them need it."""
    from lungaccess.running.study.one_run import prepare

    problems: dict[Any, Problem] = {}
    for problem in (run.problem for run in runs if run.planner.kind == "plan"):
        system = problem.system
        devices = (system.scope, system.tubes, system.margins, system.fissures_allowed)
        problems.setdefault((problem.patient, devices), problem)
    if not client.nthreads():
        say("waiting for a worker", None)
        client.wait_for_workers(1)
    what = "enumerating what scope and tubes can do"
    say(what, None)
    for done, (problem, error) in enumerate(each_done(client, prepare, [*problems.values()], cache), start=1):
        if isinstance(error, LungaccessError):
            raise error
        if error is not None:
            raise StudyError(
                f"The atlas of {problem.case} could not be made ({error})",
                expected="workers with about 6 GiB of free memory",
                remedy="Start fewer workers with --workers",
            ) from error
        say(f"{what}: {done} of {len(problems)}, {problem.case}", None)


def _failed(run: Run, error: BaseException) -> Answer:
    from distributed import KilledWorker

    return Answer(
        key=run.key,
        outcome=type(error).__name__,
        status=CRASH if isinstance(error, KilledWorker) else UNKNOWN,
        failed=True,
        message=f"{error}",
    )


T = TypeVar("T")
LEAST_RUNS = 4
"""Runs are also handed over while the workers are still starting."""
RETRIES = 2
"""How often dask tries a run again at once: workers and disks may fail for a moment."""
CONNECT_S = 20.0
"""A scheduler that does not answer for so long is taken to be absent."""
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
DASK_CONFIG = {
    # Dask would warn whenever this process is busy with a patient.
    "distributed.admin.tick.limit": "1h",
    # It keeps as many events, with the runs that they concern: memory grows until the logs are full.
    "distributed.admin.low-level-log-length": 100,
    "distributed.admin.log-length": 200,
    # Set before a worker starts: numba refuses to compile if it finds another number later.
    **{f"distributed.nanny.pre-spawn-environ.{name}": 1 for name in ONE_THREAD},
}


def _require_dask() -> None:
    """Raise StudyError unless the libraries of studies are installed."""
    try:
        import distributed  # noqa: F401
    except ImportError as error:
        raise StudyError(
            f"Studies need a library that is not installed ({error})",
            expected="dask.distributed",
            remedy="pip install 'lungaccess[study]'",
        ) from error


@contextlib.contextmanager
def connect(scheduler: str | None, workers: int | None) -> "Iterator[Client]":
    """Connect to a scheduler, or start processes on this machine and stop them afterwards."""
    import dask
    from distributed import Client, LocalCluster

    with contextlib.ExitStack() as stack:
        stack.enter_context(dask.config.set(DASK_CONFIG))
        try:
            if scheduler is None:
                # Patients are mapped from files: dask would take that memory for a leak and stop a worker.
                with _interruptions_ignored():
                    cluster = LocalCluster(
                        n_workers=workers or os.cpu_count() or 1,
                        threads_per_worker=1,
                        processes=True,
                        memory_limit=0,
                        dashboard_address="127.0.0.1:0",
                        silence_logs=50,
                    )
                stack.enter_context(cluster)
                client = Client(cluster)
            else:
                client = Client(scheduler, timeout=CONNECT_S)
        except (OSError, ValueError, TypeError) as error:
            raise StudyError(
                f"No dask scheduler answers at {scheduler or 'this machine'} ({error})",
                expected="an address such as tcp://host:8786 where `dask scheduler` runs",
                remedy="Start it, or leave --scheduler out",
            ) from error
        yield stack.enter_context(client)


@contextlib.contextmanager
def _interruptions_ignored() -> Iterator[None]:
    """Ignore Ctrl-C, as processes that are started meanwhile will for all their life: it is for this one."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def _interruptions_noted() -> Iterator[Callable[[], None]]:
    """Yield a function that raises KeyboardInterrupt if Ctrl-C was pressed, or SIGTERM came, in the meantime.

    Python drops exceptions that are raised while an object is being deleted, as dask's futures are all the
    time: such an interruption would be lost.
    """
    pressed = threading.Event()

    def stop_if_interrupted() -> None:
        if pressed.is_set():
            raise KeyboardInterrupt

    def note(*_signal: object) -> None:
        pressed.set()
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield stop_if_interrupted
        return
    ours = [
        each
        for each in (signal.SIGINT, signal.SIGTERM)
        if signal.getsignal(each) is signal.default_int_handler
    ]
    for each in ours:
        signal.signal(each, note)
    try:
        yield stop_if_interrupted
    finally:
        for each in ours:
            signal.signal(each, signal.default_int_handler)


def each_done(
    client: "Client", work: Callable[..., Any], asked: Sequence[T], *more: Any
) -> Iterator[tuple[T, Any]]:
    """Yield each piece of work with what became of it, in the order in which they end.

    `work` receives a piece and `more`, on a worker; what became of it is what it returned, or the error that
    it raised at every try.  Only a few pieces wait at the scheduler at any time.  StudyError is raised if the
    scheduler is lost.
    """
    from distributed import as_completed

    waiting, under_way = iter(asked), dict[str, T]()
    finished = as_completed(with_results=True, raise_errors=False)
    limit, asked_s = LEAST_RUNS, -math.inf
    while True:
        # Asking takes a round trip to the scheduler; workers seldom come or go.
        if time.monotonic() - asked_s > 5.0:
            # One run is made, and two are waiting where they are needed next: so no worker is ever idle.
            limit, asked_s = max(LEAST_RUNS, 3 * len(client.nthreads())), time.monotonic()
        for piece in islice(waiting, max(0, limit - len(under_way))):
            future = client.submit(work, piece, *more, pure=False, retries=RETRIES)
            under_way[future.key] = piece
            finished.add(future)
        if not under_way:
            return
        future, result = next(finished)
        if future.status in ("cancelled", "lost"):
            raise StudyError(
                "The dask scheduler was lost",
                remedy="Start the study again, it goes on from what is stored",
                expected="a scheduler that runs until the study ends",
            )
        # Dask hands over an error as `sys.exc_info` returns it.
        yield under_way.pop(future.key), result if future.status == "finished" else result[1]
        future.release()
