"""What planners did in a benchmark, and OMPL's log of it."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence

from anatomy.base.records import frozen_value
from stages.needle.path import ArcPath

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
        Why it is none: see `stages.needle.violations`.
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
