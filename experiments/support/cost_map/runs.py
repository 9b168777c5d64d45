"""Searches of a needle with three objectives, judged by the cost map [Fu2018, fig. 7]."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from itertools import product

import numpy as np

from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.typed import Float
from anatomy.grid import Volume
from experiments.support.cost_map.case import Case
from experiments.support.cost_map.inflation import inflated_environment, refuting_labels
from experiments.support.cost_map.problems import LEAST_COST, TRIES, TRY_ITERATIONS, Scenario, candidates
from stages.needle.costs import map_integral, obstacle_clearance_mm, voxel_sum
from stages.needle.environment import NeedleEnvironment
from stages.needle.objective import SHORTEST, Objective
from stages.needle.path import ArcPath, Query
from stages.needle.search.base import RestartingRRT
from stages.needle.search.portfolio import PortfolioSearch

SLICE_ITERATIONS = 100
WARM_ITERATIONS = 10_000
PAPER_MODE_ITERATIONS = 30_000
COST_MAP, SHORTEST_PATH, INTENSITY = "cost map", "shortest path", "voxel intensity"


@frozen_record
class Run:
    """The paths of one search, each better than the last by its own objective, and what they cost.

    `times` are seconds of processor time; `sums` are those of eq. 1, `integrals` in mm, `lengths` in mm.
    """

    times: Float
    sums: Float
    integrals: Float
    lengths: Float
    paths: list[ArcPath]

    def at(self, values: Float, seconds: Float) -> Float:
        """Return the value of the best path at each time, NaN before the first."""
        n = np.searchsorted(self.times, seconds, side="right")
        return np.asarray(np.concatenate([[math.nan], values])[n])


def run(
    environment: NeedleEnvironment,
    costs: Volume,
    query: Query,
    objective: Objective,
    seed: int,
    limit_s: float,
) -> Run:
    """Search for `limit_s` seconds of processor time; judge the paths afterwards by `costs`."""
    search = PortfolioSearch(environment, query, seed=seed, objective=objective)
    times, paths = [], []
    began = time.process_time()
    while time.process_time() - began < limit_s:
        if search.advance(SLICE_ITERATIONS) and search.path is not None:
            times.append(time.process_time() - began)
            paths.append(search.path)
    return Run(
        times=np.array(times),
        sums=np.array([voxel_sum(costs, path) for path in paths]),
        integrals=np.array([map_integral(costs, path) for path in paths]),
        lengths=np.array([path.length_mm for path in paths]),
        paths=paths,
    )


def run_all(
    case: Case, scenario: Scenario, seeds: list[int], limit_s: float
) -> dict[tuple[str, str], list[Run]]:
    """Return the runs of a scenario by its name and each objective, one a seed."""
    on_intensity = replace(case.environment, cost_map=case.intensity)
    searched = {
        COST_MAP: (case.environment, Objective(voxel_sum=1.0)),
        SHORTEST_PATH: (case.environment, SHORTEST),
        INTENSITY: (on_intensity, Objective(voxel_sum=1.0)),
    }
    for where, objective in searched.values():
        # What is compiled or loaded now is not counted; guide paths come after the first path.
        warm = PortfolioSearch(where, scenario.query, objective=objective)
        while warm.iterations < WARM_ITERATIONS:
            warm.advance(SLICE_ITERATIONS)
    return {
        (scenario.name, variant): [
            run(where, case.costs, scenario.query, objective, seed, limit_s) for seed in seeds
        ]
        for variant, (where, objective) in searched.items()
    }


def changes_of_cost(case: Case, seed: int, count: int, limit_s: float) -> Float:
    """Return by how many percent planning on the map changes the sum of eq. 1 against the shortest path.

    One run of each in `count` problems, taken as they come; left out are those without a path, and where
    the shortest path costs less than `LEAST_COST`.
    """
    changes: list[float] = []
    for query in candidates(case, np.random.default_rng([seed, 1])):
        if len(changes) == count:
            break
        if not RestartingRRT(case.environment, query).advance(TRIES * TRY_ITERATIONS):
            continue
        shortest, mapped = (
            run(case.environment, case.costs, query, objective, seed, limit_s)
            for objective in (SHORTEST, Objective(voxel_sum=1.0))
        )
        if shortest.paths and mapped.paths and shortest.sums[-1] >= LEAST_COST:
            changes.append(100.0 * (mapped.sums[-1] / shortest.sums[-1] - 1.0))
    return np.array(changes)


def success_and_means(runs: list[Run], seconds: Float) -> tuple[Float, Float, Float]:
    """Return the share of runs with a path at each time, and the means over these of both costs."""
    sums = np.array([run.at(run.sums, seconds) for run in runs])
    integrals = np.array([run.at(run.integrals, seconds) for run in runs])
    found = np.isfinite(sums).sum(axis=0)
    with np.errstate(invalid="ignore"):
        return found / len(runs), np.nansum(sums, axis=0) / found, np.nansum(integrals, axis=0) / found


@frozen_value
class Proofs:
    """How many paths of some searches the proof refutes, and the least distance of all from obstacles, mm."""

    paths: int
    refuted: int
    least_mm: float


def paper_mode(case: Case, scenarios: list[Scenario], seeds: list[int]) -> Proofs:
    """Plan with the paper's inflated obstacles and lookups, and put every path to the proof."""
    inflated, paths = inflated_environment(case.environment), []
    for scenario, seed in product(scenarios, seeds):
        search = RestartingRRT(inflated, scenario.query, seed=seed, objective=SHORTEST)
        while (left := PAPER_MODE_ITERATIONS - search.iterations) > 0:
            if search.advance(left) and search.path is not None:
                paths.append(search.path)
    return proofs(case.environment, paths)


def proofs(environment: NeedleEnvironment, paths: list[ArcPath]) -> Proofs:
    """Put paths to the proof, and measure their distance from obstacles at samples of 0.05 mm."""
    refuted = int(np.count_nonzero(refuting_labels(environment, paths))) if paths else 0
    least = [
        float(obstacle_clearance_mm(environment.obstacles, path.sample(0.05)[0]).min()) for path in paths
    ]
    return Proofs(paths=len(paths), refuted=refuted, least_mm=min(least, default=math.inf))
