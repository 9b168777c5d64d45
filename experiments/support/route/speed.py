"""Speed of routes as in [Li2021]: replanning while the tubes breathe, and the repair in two processes."""

from __future__ import annotations

import itertools
import math
import time
from concurrent.futures import Executor

import numpy as np

from anatomy.base.errors import LungaccessError
from experiments.support.route.groups import Tubes, trials
from stages.scope.route.centreline import Centreline
from stages.scope.route.curve import Curve
from stages.scope.route.genetic import GeneticSettings, cut_segments, repair_genetic, search_segment
from stages.scope.route.planner import Replanner, plan_route
from stages.scope.route.proof import RouteLimits

REPEATS = 7
"""Of so many runs with one process and with two, the quickest counts: others may use the machine too."""


def replanning(group: list[Tubes], limits: RouteLimits, frames: int = 200) -> dict[str, float]:
    """Breathe with the tubes of the first solvable trials and count replans a second."""
    times = []
    for trial in trials(group, 4 * len(group), seed=7):
        line = trial.tubes.centreline
        route = plan_route(
            line, trial.start, trial.goal, limits, links=trial.tubes.links, require_proof=False
        )
        if not route.proved:
            continue
        replanner = Replanner(line, route)
        for frame in range(frames // (4 * len(group))):
            phase = 2.0 * np.pi * frame / 40.0
            nodes = np.array(line.nodes_mm)
            nodes[:, 0] += 4.0 * np.sin(phase + nodes[:, 1] / 60.0)
            nodes[:, 1] += 3.0 * np.sin(phase + nodes[:, 0] / 80.0)
            began = time.process_time()
            try:
                replanner.replan(nodes)
            except LungaccessError:
                continue
            times.append(time.process_time() - began)
    spent = np.array(times)
    return {
        "states": len(spent),
        "median_ms": 1e3 * float(np.median(spent)),
        "p95_ms": 1e3 * float(np.percentile(spent, 95)),
    }


def side_by_side(group: list[Tubes], limits: RouteLimits, processes: Executor, most: int) -> dict[str, float]:
    """Measure what two processes save the genetic repair on at most so many routes with several segments.

    The share that two free cores would save follows from the CPU times of the segments: at best the longer
    half is left.
    """
    settings = GeneticSettings()
    alone = together = cpu = longest = 0.0
    taken = 0
    for trial in trials(group, 60, seed=3):
        line, links = trial.tubes.centreline, trial.tubes.links
        tentative = plan_route(
            line, trial.start, trial.goal, limits, repair="none", links=links, require_proof=False
        ).tentative
        parts = cut_segments(tentative, line, limits, settings.margin_share)[1]
        if len(parts) < 2:
            continue
        spent = []
        for part in parts:
            began = time.process_time()
            search_segment(part, limits=limits, settings=settings, seed=1)
            spent.append(time.process_time() - began)
        cpu += sum(spent)
        longest += min(max(sum(half), sum(spent) - sum(half)) for half in _halves(spent))
        repair_genetic(tentative, line, limits, seed=1, executor=processes)
        best = _quickest_s(tentative, line, limits, (None, processes))
        alone, together = alone + best[0], together + best[1]
        taken += 1
        if taken == most:
            break
    if not taken:
        return {"routes": 0}
    saved, possible = 1.0 - together / alone, 1.0 - longest / cpu
    return {"routes": taken, "saved": saved, "possible": possible}


def _quickest_s(
    tentative: Curve, line: Centreline, limits: RouteLimits, executors: tuple[Executor | None, ...]
) -> list[float]:
    """Return the quickest of several repairs by each executor, by the clock; they take turns."""
    best = [math.inf] * len(executors)
    for _ in range(REPEATS):
        for n, workers in enumerate(executors):
            began = time.perf_counter()
            repair_genetic(tentative, line, limits, seed=1, executor=workers)
            best[n] = min(best[n], time.perf_counter() - began)
    return best


def _halves(times: list[float]) -> list[tuple[float, ...]]:
    """Return the choices which give some of the segments to the first of two processes."""
    return [half for n in range(len(times) + 1) for half in itertools.combinations(times, n)]
