"""Who makes the runs of a study: a cluster of dask, or without dask processes of this machine."""

from __future__ import annotations

import contextlib
import importlib.util
import math
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from typing import TYPE_CHECKING, Any, TypeVar

from anatomy.base.child_process import end_with_parent
from lungaccess.running.study.settings import StudyError

if TYPE_CHECKING:
    from distributed import Client

T = TypeVar("T")
RETRIES = 2
"""How often dask tries a run again at once: workers and disks may fail for a moment."""
RUNS_A_WORKER = 3
"""One run is made, and two are waiting where they are needed next: so no worker is ever idle."""
LEAST_RUNS = 4
"""Runs are also handed over while the workers are still starting."""
COUNT_WORKERS_EVERY_S = 5.0
"""Asking takes a round trip to the scheduler; workers seldom come or go."""
CONNECT_S = 20.0
"""A scheduler that does not answer for so long is taken to be absent."""
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
INTERRUPTIONS = (signal.SIGINT, signal.SIGTERM)
DASK_CONFIG = {
    # Dask would warn whenever this process is busy with a patient.
    "distributed.admin.tick.limit": "1h",
    # It keeps as many events, with the runs that they concern: memory grows until the logs are full.
    "distributed.admin.low-level-log-length": 100,
    "distributed.admin.log-length": 200,
    # Set before a worker starts: numba refuses to compile if it finds another number later.
    **{f"distributed.nanny.pre-spawn-environ.{name}": 1 for name in ONE_THREAD},
}


class DaskWorkers:
    """The workers of a dask scheduler, where only a few pieces of work wait at any time."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._asked_s, self._limit = -math.inf, LEAST_RUNS

    def each(self, work: Callable[..., Any], asked: Sequence[T], *more: Any) -> Iterator[tuple[T, Any]]:
        """Yield each piece with what the work returned for it, or the error, in the order in which they end.

        Raises
        ------
        StudyError
            If the scheduler is lost.
        """
        import distributed

        waiting, under_way = iter(asked), dict[str, T]()
        finished = distributed.as_completed(with_results=True, raise_errors=False)
        while True:
            for piece in islice(waiting, max(0, self._most() - len(under_way))):
                future = self._client.submit(work, piece, *more, pure=False, retries=RETRIES)
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
            # Of an error dask hands over what `sys.exc_info` returns.
            yield under_way.pop(future.key), result[1] if isinstance(result, tuple) else result
            future.release()

    def _most(self) -> int:
        """Return the largest number of pieces that may be under way."""
        if time.monotonic() - self._asked_s > COUNT_WORKERS_EVERY_S:
            self._limit = max(LEAST_RUNS, RUNS_A_WORKER * len(self._client.nthreads()))
            self._asked_s = time.monotonic()
        return self._limit


class PoolWorkers:
    """Processes of this machine that need no library."""

    def __init__(self, pool: ProcessPoolExecutor) -> None:
        self._pool = pool

    def each(self, work: Callable[..., Any], asked: Sequence[T], *more: Any) -> Iterator[tuple[T, Any]]:
        """Yield each piece as `DaskWorkers.each` does.

        Raises
        ------
        StudyError
            If a process is lost.
        """
        under_way = {self._pool.submit(work, piece, *more): piece for piece in asked}
        for future in as_completed(under_way):
            error = future.exception()
            if isinstance(error, BrokenProcessPool):
                raise StudyError(
                    f"A process of the study was lost ({error})",
                    expected="processes that nothing ends, with enough memory",
                    remedy="Start it again with fewer --workers: it goes on from what is stored",
                ) from error
            yield under_way.pop(future), error or future.result()


Workers = DaskWorkers | PoolWorkers
"""Who makes the runs."""


def dask_is_installed() -> bool:
    """Tell whether the library of clusters is there."""
    return importlib.util.find_spec("distributed") is not None


@contextlib.contextmanager
def connect(scheduler: str | None, workers: int | None) -> Iterator[Workers]:
    """Connect to a scheduler, or start processes on this machine and stop them afterwards."""
    number = workers or os.cpu_count() or 1
    if scheduler is not None or dask_is_installed():
        with connect_dask(scheduler, number) as client:
            yield DaskWorkers(client)
        return
    others, spawn = multiprocessing.active_children(), multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(number, mp_context=spawn, initializer=end_with_parent) as pool:
        try:
            yield PoolWorkers(pool)
        except BaseException:
            for each in set(multiprocessing.active_children()) - set(others):
                each.terminate()
            raise


@contextlib.contextmanager
def connect_dask(scheduler: str | None, workers: int) -> Iterator[Client]:
    """Connect to a scheduler of dask, or start one with processes on this machine."""
    import dask
    from distributed import Client, LocalCluster

    with contextlib.ExitStack() as stack:
        stack.enter_context(dask.config.set(DASK_CONFIG))
        try:
            if scheduler is None:
                # Patients are mapped from files: dask would take that memory for a leak and stop a worker.
                with _interruptions_ignored():
                    cluster = LocalCluster(
                        n_workers=workers,
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
def interruptions_noted() -> Iterator[Callable[[], None]]:
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
    ours = [each for each in INTERRUPTIONS if signal.getsignal(each) is signal.default_int_handler]
    for each in ours:
        signal.signal(each, note)
    try:
        yield stop_if_interrupted
    finally:
        for each in ours:
            signal.signal(each, signal.default_int_handler)
