"""What the tests of each file compile and how long they run, to decide which belong into `tests/tiers.toml`.

`pytest --compile-times` in a fresh checkout says it; a kernel counts for the file that needs it first.
"""

from __future__ import annotations

import time
from collections import Counter

import pytest
from numba.core import event


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option."""
    parser.addoption("--compile-times", action="store_true", help="seconds of compiling and running, by file")


def pytest_configure(config: pytest.Config) -> None:
    """Measure where it is asked for."""
    if config.option.compile_times:
        config.pluginmanager.register(_CompileTimes())


class _CompileTimes(event.Listener):
    """Adds up processor time between the beginning and the end of the outermost compilation."""

    def __init__(self) -> None:
        self._depth, self._began_s, self._spent_s = 0, 0.0, 0.0
        self._compiling_s: Counter[str] = Counter()
        self._all_s: Counter[str] = Counter()
        event.register("numba:compile", self)

    def on_start(self, event: event.Event) -> None:
        if self._depth == 0:
            self._began_s = time.thread_time()
        self._depth += 1

    def on_end(self, event: event.Event) -> None:
        self._depth -= 1
        if self._depth == 0:
            self._spent_s += time.thread_time() - self._began_s

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self) -> object:
        report = yield
        report.compiling_s, self._spent_s = self._spent_s, 0.0
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        file = report.nodeid.partition("::")[0]
        self._compiling_s[file] += getattr(report, "compiling_s", 0.0)
        self._all_s[file] += report.duration

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        terminalreporter.section("seconds of compiling (processor) and in all (by the clock)")
        for file, compiling_s in self._compiling_s.most_common():
            terminalreporter.write_line(f"{compiling_s:8.1f} {self._all_s[file]:8.1f}  {file}")
