"""A vessel between start and goal, stated to OMPL: what the tests of this folder ask and expect."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from anatomy.base.typed import Float
from anatomy.lung import Lung
from anatomy.margins import Margins
from anatomy.structures import OUTSIDE, VESSEL
from stages.needle.environment import NeedleEnvironment, needle_environment
from stages.needle.path import ArcPath, Query
from stages.needle.search.base import Search
from tests.stages.scenes import Canvas

if TYPE_CHECKING:
    from stages.needle.ompl import NeedleProblem

GOAL = np.array([0.0, 0.0, 28.0])
NEAR = np.array([8.0, 0.0, -4.0])
ITERATIONS = 5000
OMPL_PLANNERS = ("control.RRT", "control.EST", "control.KPIECE1")
LONG_S = 60.0
"""No test waits so long: what it stands for is found within a second."""


def scene() -> Lung:
    """A vessel ball between start and goal; the lung ends at x = -28."""
    canvas = Canvas.empty([-32, -32, -32], [32, 32, 32], 1.0)
    canvas.add(canvas.ball([0, 0, 0], 4.0), VESSEL)
    canvas.add(canvas.points[..., 0] < -28, OUTSIDE)
    return canvas.lung()


def with_needle(environment: NeedleEnvironment, **more: float) -> NeedleEnvironment:
    return needle_environment(scene(), replace(environment.needle, **more), Margins(), with_fissures=False)


def start() -> Float:
    frame = np.eye(4)
    frame[:3, 3] = 0.0, 0.0, -28.0
    return frame


def query(target: Float = GOAL, **more: Any) -> Query:
    return Query(**{"lps_from_start": start(), "target": target, **more})


def ask(problem: NeedleProblem, seed: int = 1, **more: Any) -> ArcPath | None:
    return problem.plan(query(), **{"seed": seed, "iterations": ITERATIONS, **more})


def require(path: ArcPath | None) -> ArcPath:
    assert path is not None
    return path


def handed_over(problem: NeedleProblem) -> Any:
    return problem.own().getProblemDefinition().getSolutionPath()


def arcs_of(*arcs: tuple[float, float, float]) -> ArcPath:
    return ArcPath(lps_from_start=start(), arcs=np.array(arcs))


class Given:
    """A search that finds the paths it is given, one a slice."""

    def __init__(self, *paths: ArcPath) -> None:
        self.path: ArcPath | None = None
        self.cost = math.inf
        self.finished = False
        self._paths = list(paths)

    def advance(self, iterations: int) -> bool:
        self.path = self._paths.pop(0)
        self.finished = not self._paths
        return True


def given(*paths: ArcPath) -> Callable[[NeedleEnvironment, Query, int], Search]:
    return lambda _environment, _query, _seed: Given(*paths)


def ompls_benchmark(problem: NeedleProblem, log: Path | None = None) -> list[float]:
    """Return the shares of solved runs of our default planner in OMPL's own benchmark."""
    from ompl import tools

    problem.pose(query())
    bench = tools.Benchmark(problem.setup, "needle")
    bench.addPlanner(problem.planners()["rrt"](problem.si))
    bench.benchmark(
        tools.Request(
            maxTime=LONG_S,
            maxMem=1e5,
            runCount=3,
            displayProgress=False,
            simplify=False,
            saveConsoleOutput=False,
        )  # fmt: skip
    )
    if log is not None:
        bench.saveResultsToFile(str(log))
    (record,) = bench.getRecordedExperimentData().planners
    return [float(run["solved BOOLEAN"]) for run in record.runs]
