"""Processes that help another one: they end when it ends, however it ends."""

import multiprocessing
import os
import signal
import sys
import threading
import time

LOOK_EVERY_S = 0.5
"""A process that outlives its parent by less is no nuisance, and looking takes microseconds."""


def end_with_parent() -> None:
    """Make this process leave Ctrl-C to its parent, end at once on SIGTERM, and end when its parent is gone.

    To be called first, in the main thread.
    """
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
        time.sleep(LOOK_EVERY_S)
    os._exit(1)
