"""Processes that help another one: they end when it ends, however it ends."""

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from multiprocessing.connection import Connection
from typing import Any

from anatomy.base.errors import AnatomyError


def end_with_parent() -> None:
    """Make this process leave Ctrl-C to its parent, and end on SIGTERM or with it; called first of all."""
    forked = multiprocessing.parent_process()
    parent = os.getppid() if forked is None or forked.pid is None else forked.pid
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    forked = multiprocessing.parent_process()
    if sys.platform == "win32" and forked is not None:
        forked.join()  # A number of a process says nothing there: it stays, and may become that of another.
        os._exit(1)
    while os.getppid() == parent:
        # A process that outlives its parent by less is no nuisance, and looking takes microseconds.
        time.sleep(0.5)
    os._exit(1)


def can_fork() -> bool:
    """Tell whether processes can begin with all that this one has in memory; on Windows they cannot."""
    return "fork" in multiprocessing.get_all_start_methods()


@contextlib.contextmanager
def forked(work: Callable[..., None], parts: Iterable[tuple[Any, ...]]) -> Iterator[list[Connection]]:
    """Do parts of some work in forked processes, which end with the block; yield a pipe to each.

    `work` gets the arguments of a part and the other end of its pipe, and calls `end_with_parent` first.
    """
    context = multiprocessing.get_context("fork")
    ends, workers = [], []
    try:
        for part in parts:
            here, there = context.Pipe()
            worker = context.Process(target=work, args=(*part, there), daemon=True)
            worker.start()
            there.close()
            ends.append(here)
            workers.append(worker)
        yield ends
    finally:
        for worker in workers:
            worker.terminate()
            worker.join()


def received(end: Connection, what: str) -> Any:
    """Return what a process sends that does a part of something; AnatomyError if it has ended instead."""
    try:
        return end.recv()
    except EOFError as reason:
        raise AnatomyError(
            f"A process of the {what} has ended before its time",
            expected=f"processes that run until the {what} ends",
            remedy="Give it more memory, or fewer processes with --processes",
        ) from reason
