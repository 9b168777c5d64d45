"""The dask cluster of a study: a scheduler that runs somewhere, or processes on this machine."""

import contextlib
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from typing import TYPE_CHECKING, Any, TypeVar

from lungaccess.running.study.settings import StudyError

if TYPE_CHECKING:
    from distributed import Client

T = TypeVar("T")
RETRIES = 2
"""How often dask tries a run again at once: workers and disks may fail for a moment."""
LEAST_RUNS = 4
"""Runs are also handed over while the workers are still starting."""
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


def require_dask() -> None:
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


def each_done(
    client: "Client", work: Callable[..., Any], asked: Sequence[T], *more: Any
) -> Iterator[tuple[T, Any]]:
    """Yield each piece of work with what became of it, in the order in which they end.

    Only a few pieces wait at the scheduler at any time.

    Args:
        work: Receives a piece and `more`, on a worker.

    Yields:
        The piece with what `work` returned for it, or the error that it raised at every try.

    Raises:
        StudyError: If the scheduler is lost.
    """
    from distributed import as_completed

    waiting, under_way = iter(asked), dict[str, T]()
    finished = as_completed(with_results=True, raise_errors=False)
    backlog = Backlog(client)
    while True:
        for piece in islice(waiting, max(0, backlog.limit() - len(under_way))):
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


class Backlog:
    """The largest number of runs that the scheduler may hold, by the number of its workers."""

    def __init__(self, client: "Client") -> None:
        self._client = client
        self._asked_s = -math.inf
        self._limit = LEAST_RUNS

    def limit(self) -> int:
        """Return the largest number of runs that may be under way."""
        # Asking takes a round trip to the scheduler; workers seldom come or go.
        if time.monotonic() - self._asked_s > 5.0:
            # One run is made, and two are waiting where they are needed next: so no worker is ever idle.
            self._limit = max(LEAST_RUNS, 3 * len(self._client.nthreads()))
            self._asked_s = time.monotonic()
        return self._limit
