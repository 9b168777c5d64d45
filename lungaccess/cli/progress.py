"""Progress on standard error: what is being done, how much of it is done, and about how long it takes."""

from types import TracebackType
from typing import Self

from rich.progress import BarColumn, Progress, ProgressColumn, SpinnerColumn, Task, TaskID, TextColumn
from rich.text import Text

from lungaccess.cli import lazy
from lungaccess.cli.terminal import progress_console, safe

LEAST_SHARE = 0.02
"""From less than this share no time is extrapolated: its error would be larger than the time itself."""

COMPILING_ONCE = "Compiling kernels, once per installation; that takes some minutes and counts for no budget."


class _Times(ProgressColumn):
    """Time that has passed, and the time left as far as it can be estimated."""

    def render(self, task: Task) -> Text:
        """Return the text of the column."""
        passed = task.finished_time if task.finished else task.elapsed
        words = f"{passed or 0.0:.0f} s"
        left = remaining_s(passed or 0.0, task.completed, task.total)
        if left is not None and not task.finished:
            words += f", about {left:.0f} s left"
        return Text(words)


def remaining_s(passed_s: float, completed: float, total: float | None) -> float | None:
    """Return the time left if all goes on as before; None if too little is done for an estimate.

    Examples:
        >>> remaining_s(10.0, 0.25, 1.0)
        30.0
        >>> remaining_s(10.0, 0.0, 1.0) is None
        True
    """
    if not total or completed < LEAST_SHARE * total:
        return None
    return max(passed_s * (total - completed) / completed, 0.0)


def _bar(*more: ProgressColumn) -> Progress:
    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        # Leaves room for the description and the times on a line of 80 characters.
        BarColumn(bar_width=24),
        _Times(),
        *more,
        console=progress_console,
        transient=True,
    )


class _Shown:
    """Something whose progress is shown within a `with` statement, or which kernel is compiled meanwhile."""

    _progress: Progress
    _task: TaskID
    _announced = False
    """Whether this process has said that kernels are compiled."""

    def __enter__(self) -> Self:
        self._interrupted_words: str | None = None
        self._compilations = lazy.watching_compilations(self._compiling)
        self._compilations.__enter__()
        lazy.first_compilation.tell = self._compiling
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()
        self._compilations.__exit__(kind, error, trace)

    def _compiling(self, kernel: str | None) -> None:
        """Show which kernel is compiled, or how many are; with None what was shown before."""
        if not _Shown._announced:
            _Shown._announced = True
            self._progress.console.print(COMPILING_ONCE, highlight=False)
        if self._interrupted_words is None:
            self._interrupted_words = self._progress.tasks[0].description
        words = f"compiling kernels, once per installation: {kernel}"
        self._progress.update(
            self._task, description=self._interrupted_words if kernel is None else safe(words)
        )
        if kernel is None:
            self._interrupted_words = None


class StepDisplay(_Shown):
    """Shows work in steps; the bar moves back and forth as long as nobody knows which share is done."""

    def __init__(self, description: str) -> None:
        self._description = description
        self._progress = _bar()
        self._task = self._progress.add_task(safe(description), total=None)

    def step(self, words: str, share: float | None = None) -> None:
        """Say what is being done now, and the share of all that is done; None if it is not known."""
        description = safe(f"{self._description}: {words}" if words else self._description)
        if share is None:
            self._progress.update(self._task, description=description, total=None)
        else:
            self._progress.update(self._task, description=description, total=1.0, completed=share)

    def share(self, share: float) -> None:
        """Say which share is done."""
        self.step("", share)


progress = StepDisplay
"""Makes a display of work in steps, for a `with` statement."""


class SearchDisplay(_Shown):
    """Shows a search while it runs: what it does, how much of the budget is used, how small `what` is."""

    def __init__(self, time_s: float | None, iterations: int | None, what: str = "cost") -> None:
        self._time_s, self._iterations, self._what = time_s, iterations, what
        self._found = False
        self._progress = _bar(TextColumn("{task.fields[best]}"))
        total = float(iterations) if iterations is not None else time_s
        self._task = self._progress.add_task("searching", total=total, best="no plan yet")

    def update(self, description: str, elapsed_s: float, iteration: int, best_cost: float | None) -> None:
        """Show the state of the search."""
        done = float(iteration) if self._iterations is not None else elapsed_s
        self._found = self._found or best_cost is not None
        words = "improving the plan" if self._found else "no plan yet"
        self._progress.update(self._task, description=description, completed=done, best=words)

    def better(self, elapsed_s: float, value: str) -> None:
        """Leave a line about a better plan above the bar; without a value it is the first clear one."""
        said = f"{self._what} {value}" if value else "a first clear plan"
        self._progress.console.print(f"  {elapsed_s:8.2f} s   {said}", highlight=False)

    def interrupted(self) -> None:
        """Leave a line that says that the user ended the search."""
        self._progress.console.print("  interrupted: the best plan so far is kept")
