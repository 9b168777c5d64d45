"""Planners compared on one query by OMPL's own benchmark."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from ompl import tools

from anatomy.base.errors import SettingsError
from anatomy.base.files import atomic_write, require_writable_folder
from anatomy.base.records import frozen_value
from stages.needle.ompl.planner import NeedlePlanner, not_written
from stages.needle.ompl.problem import NeedleProblem
from stages.needle.path import ArcPath, Query


def benchmark(
    problem: NeedleProblem,
    query: Query,
    *,
    time_s: float,
    runs: int,
    planners: Sequence[str] | None = None,
    goal_tolerance_mm: float = 1.0,
    memory_mb: float = 1024.0,
    seed: int = 1,
    file: str | Path | None = None,
) -> dict[str, PlannerRuns]:
    """Run planners on one query with OMPL's `tools.Benchmark`.

    Parameters
    ----------
    time_s : float
        Time limit of a run.  Our planners end with their first path.
    runs : int
        Runs of each planner.
    planners : sequence of str, optional
        Names of `NeedleProblem.planners`; by default all.
    goal_tolerance_mm : float
        How far from the target a path of OMPL's planners may end.
    memory_mb : float
        Stop a run when the process uses so much more memory than at the start.
    seed : int
        Seed of the first run of our planners; each further run takes the next.
    file : path, optional
        Where to write OMPL's log, with two more properties for each run: whether its path is proved, and
        the length in mm (OMPL's own counts durations).

    Returns
    -------
    dict of PlannerRuns by name

    Raises
    ------
    SettingsError
        If there is no such planner, or nothing to run.
    FileError
        If the log cannot be written.
    """
    allocators = problem.planners()
    names = list(allocators) if planners is None else list(planners)
    unknown = [name for name in names if name not in allocators]
    if unknown or not names or runs < 1:
        raise SettingsError(
            f"Nothing to run {runs} times, or unknown planners: {unknown}",
            expected=f"at least one run, and planners out of {', '.join(allocators)}",
        )
    if file is not None:
        # Where it cannot write, OMPL writes elsewhere.
        require_writable_folder(Path(file).parent)
    problem.pose(query, goal_tolerance_mm=goal_tolerance_mm)
    outcomes: list[Outcome] = []

    def before(planner: Any) -> None:
        if isinstance(planner, NeedlePlanner):
            planner.seed = seed + len(outcomes) % runs

    def after(_planner: Any, _properties: Any) -> None:
        # The properties are a copy: what is set there is lost.
        path = problem.unproved_solution()
        outcomes.append(Outcome(path=path, violation="" if path is None else problem.violation(path)))

    bench = tools.Benchmark(problem.setup, "needle")
    for name in names:
        bench.addPlanner(allocators[name](problem.si))
    bench.setPreRunEvent(before)
    bench.setPostRunEvent(after)
    bench.benchmark(
        tools.Request(
            maxTime=time_s,
            maxMem=_peak_memory_mb() + memory_mb,
            runCount=runs,
            displayProgress=False,
            saveConsoleOutput=False,
            simplify=False,
        )
    )
    by_planner = [outcomes[n * runs : (n + 1) * runs] for n in range(len(names))]
    if file is not None:
        with atomic_write(file) as temporary:
            if not bench.saveResultsToFile(str(temporary)):
                raise not_written(file)
            log = temporary.read_text(encoding="utf-8")
            temporary.write_text(log_with_outcomes(log, by_planner), encoding="utf-8")
    records = bench.getRecordedExperimentData().planners
    return {
        name: summary(name, [float(run["time REAL"]) for run in record.runs], results)
        for name, record, results in zip(names, records, by_planner, strict=True)
    }


def _peak_memory_mb() -> float:
    import resource  # Here: Windows has none, nor has it OMPL.

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


PROPERTIES = ("proved BOOLEAN", "path length mm REAL")
_HEADING = "properties for each run"


@frozen_value
class Outcome:
    """What one run ended with.

    Parameters
    ----------
    path : ArcPath or None
        What the planner took for a solution.
    violation : str
        Why it is none: see `stages.needle.path`.
    """

    path: ArcPath | None = None
    violation: str = ""

    @property
    def proved_length_mm(self) -> float | None:
        """Length of the path if it is proved."""
        return None if self.path is None or self.violation else self.path.length_mm


@frozen_value
class PlannerRuns:
    """What one planner did.

    Parameters
    ----------
    times_s, lengths_mm : tuple of float
        Time and length of each run whose path is proved.
    refusals : tuple of str
        Why other paths that the planner took for solutions are none.
    """

    name: str
    runs: int
    times_s: tuple[float, ...]
    lengths_mm: tuple[float, ...]
    refusals: tuple[str, ...]

    @property
    def solved_share(self) -> float:
        """Share of the runs with a proved path."""
        return len(self.times_s) / self.runs


def summary(name: str, times_s: Iterable[float], outcomes: Sequence[Outcome]) -> PlannerRuns:
    """Gather the runs of one planner."""
    proved = [
        (time, outcome.proved_length_mm)
        for time, outcome in zip(times_s, outcomes, strict=True)
        if outcome.proved_length_mm is not None
    ]
    return PlannerRuns(
        name=name,
        runs=len(outcomes),
        times_s=tuple(time for time, _length in proved),
        lengths_mm=tuple(length for _time, length in proved),
        refusals=tuple(outcome.violation for outcome in outcomes if outcome.violation),
    )


def log_with_outcomes(log: str, outcomes: Iterable[Sequence[Outcome]]) -> str:
    """Add `PROPERTIES` to each run of OMPL's log, in the order of its planners and their runs."""
    lines, planners = iter(log.splitlines()), iter(outcomes)
    out = []
    for line in lines:
        count, _, heading = line.partition(" ")
        if heading != _HEADING:
            out.append(line)
            continue
        out.append(f"{int(count) + len(PROPERTIES)} {_HEADING}")
        out += [*itertools.islice(lines, int(count)), *PROPERTIES, next(lines)]
        for outcome in next(planners):
            length = outcome.proved_length_mm
            values = (int(length is not None), "" if length is None else f"{length:.6f}")
            out.append(next(lines) + "".join(f"{value}; " for value in values))
    return "\n".join(out) + "\n"
