"""A clock that stands still while kernels are compiled or loaded, and news of what is being compiled.

A kernel is compiled when it is first called, and kept on disk; in the next process it is loaded from there.
Either takes time that says nothing about the problem being solved, so budgets of searches do not count it.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from numba.core import event


class _KernelTime(event.Listener):  # type: ignore[misc]
    """Adds up the time in which this process gets kernels; one inside another counts once."""

    def __init__(self) -> None:
        self.total_s, self.total_cpu_s = 0.0, 0.0
        self._depth, self._began, self._began_cpu = 0, 0.0, 0.0

    def on_start(self, event: event.Event) -> None:
        """Begin an interval, unless one has begun."""
        if self._depth == 0:
            self._began, self._began_cpu = time.perf_counter(), time.process_time()
        self._depth += 1

    def on_end(self, event: event.Event) -> None:
        """End the interval with the outermost event."""
        self._depth -= 1
        if self._depth == 0:
            self.total_s += time.perf_counter() - self._began
            self.total_cpu_s += time.process_time() - self._began_cpu


_kernel_time = _KernelTime()
event.register("numba:compiler_lock", _kernel_time)


def working_s() -> float:
    """Return seconds from an unknown start, without those in which kernels were compiled or loaded."""
    return time.perf_counter() - _kernel_time.total_s


def working_cpu_s() -> float:
    """Return seconds of this process's processor time, without those in which kernels were made or loaded."""
    return time.process_time() - _kernel_time.total_cpu_s


class _Names(event.Listener):  # type: ignore[misc]
    """Tells the name of each kernel whose compilation begins, and None when the outermost one ends."""

    def __init__(self, tell: Callable[[str | None], None]) -> None:
        self._tell = tell
        self._depth = 0

    def on_start(self, event: event.Event) -> None:
        """Tell the name of a kernel."""
        self._depth += 1
        self._tell(event.data["dispatcher"].py_func.__name__)

    def on_end(self, event: event.Event) -> None:
        """Tell that nothing is compiled any more."""
        self._depth -= 1
        if self._depth == 0:
            self._tell(None)


@contextmanager
def watching_compilations(tell: Callable[[str | None], None]) -> Iterator[None]:
    """Call `tell` in the block with the name of each kernel that is compiled, not loaded; None after it."""
    listener = _Names(tell)
    event.register("numba:compile", listener)
    try:
        yield
    finally:
        event.unregister("numba:compile", listener)
