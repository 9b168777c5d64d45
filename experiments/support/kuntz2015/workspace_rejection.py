"""What workspace rejection saves in reference mode, beside the 7.6 of [Kuntz2015, sec. V].

The paper took 5.63 s to find 15 paths to one goal, and 42.62 s without its line 8: a factor of 7.6.  Here
the same is measured: processor time until so many paths are found, on the same placements with and without
line 8, each RRT limited to 0.05 s.  The goal is one that is easily reached, as the paper's fig. 6 shows one:
of random peripheral targets, those that the most deployments have in their needle's workspace.

Two factors are stated.  Of all time, as the paper's; and of the RRTs alone, because the printed
algorithm tests no tubes for collisions and here they are tested in either case.
"""

from __future__ import annotations

import time
from collections.abc import Mapping

import numpy as np

from anatomy.base.records import frozen_value
from anatomy.base.typed import Float
from anatomy.lung import Lung
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.planning.coupled.kuntz2015_fcl.needle import Obstacles
from lungaccess.planning.coupled.kuntz2015_fcl.search import FOUND, ReferenceSearch, obstacles_for
from lungaccess.problem.task import Task
from stages.needle.environment import needle_environment, workspace_lengths

RRT_TIME_S = 0.05
PAPER_PATHS, PAPER_S = 15, (5.63, 42.62)


@frozen_value
class Run:
    """One search: paths found, placements, and processor time by part."""

    paths: int
    placements: int
    spent_s: Mapping[str, float]

    @property
    def total_s(self) -> float:
        """Processor time of all parts."""
        return float(sum(self.spent_s.values()))


def run_until(search: ReferenceSearch, paths: int, limit_s: float) -> Run:
    """Search until so many paths are found, or so much processor time is spent."""
    began, iteration = time.process_time(), 0
    for step in search.steps():
        iteration = step.iteration
        if search.counts[FOUND] >= paths or time.process_time() - began > limit_s:
            break
    return Run(paths=search.counts[FOUND], placements=iteration, spent_s=search.spent_s)


def prepared_obstacles(task: Task, atlas: Atlas) -> Obstacles:
    """Return the solids with the meshes that are needed, so that no run is charged for making them."""
    obstacles = obstacles_for(task)
    obstacles.prepare()
    for branch in np.unique(atlas.deployments.branch):
        obstacles.other_airways(int(branch))
    return obstacles


def goals_by_ease(lung: Lung, atlas: Atlas, points: Float) -> Float:
    """Return the points, that in the workspace of the most deployments first."""
    system, entries = atlas.system, atlas.deployments
    environment = needle_environment(lung, system.needle, system.margins, with_fissures=atlas.with_fissures)
    held = [
        int(np.isfinite(workspace_lengths(environment, entries.positions, entries.tangents, point)).sum())
        for point in points
    ]
    return np.asarray(points[np.argsort(held)[::-1]])


def compare(
    task: Task, atlas: Atlas, obstacles: Obstacles, paths: int, limit_s: float
) -> tuple[Run, Run] | None:
    """Return a run with line 8 and one without; None if the first finds too few paths."""
    first, second = (
        ReferenceSearch(task, atlas, rejects=rejects, rrt_time_s=RRT_TIME_S, obstacles=obstacles)
        for rejects in (True, False)
    )
    with_it = run_until(first, paths, limit_s)
    if with_it.paths < paths:
        return None
    return with_it, run_until(second, paths, 20.0 * limit_s)
