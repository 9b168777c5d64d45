"""How soon a needle RRT that finds a path finds it: the choice of T_RRT = 0.05 s in [Kuntz2015, sec. V]."""

from __future__ import annotations

import time
from typing import Any

from anatomy.base.typed import Float
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.planning.coupled.kuntz2015_fcl.needle import NeedleRRT, Obstacles
from lungaccess.planning.coupled.kuntz2015_fcl.search import ReferenceSearch
from lungaccess.plans.candidate import Candidate
from lungaccess.problem.task import Task
from stages.needle.path import ArcPath

LONG_S = 2.0
"""What the paper allowed each RRT."""
PAPER_S, PAPER_SHARE = 0.05, 95.0


class TimedRRT(NeedleRRT):
    """The needle RRT `plain` that notes how long each success took, in `found_s`."""

    def __init__(self, plain: NeedleRRT) -> None:
        vars(self).update(vars(plain))
        self.found_s: list[float] = []
        self.calls = 0

    def plan(self, lps_from_start: Float, goal_lps: Float, *args: Any, **options: Any) -> ArcPath | None:
        """See `NeedleRRT.plan`."""
        began = time.thread_time()
        path = super().plan(lps_from_start, goal_lps, *args, **options)
        self.calls += 1
        if path is not None:
            self.found_s.append(time.thread_time() - began)
        return path


class TimedSearch(ReferenceSearch):
    """Algorithm 1 with `LONG_S` for each RRT, and the processor time of each success."""

    def __init__(self, task: Task, atlas: Atlas, obstacles: Obstacles) -> None:
        super().__init__(task, atlas, rrt_time_s=LONG_S, obstacles=obstacles)
        self.rrt = TimedRRT(self._needle_rrt)
        self._needle_rrt = self.rrt

    def _proved(self, found: Candidate) -> Candidate | None:
        """Leave out the proof: only the RRT is looked at."""
        return found


def success_times(task: Task, atlas: Atlas, obstacles: Obstacles, *, wanted: int, limit_s: float) -> TimedRRT:
    """Run RRTs of a goal until so many have found a path, or so much processor time is spent."""
    search, began = TimedSearch(task, atlas, obstacles), time.process_time()
    for _step in search.steps():
        if len(search.rrt.found_s) >= wanted or time.process_time() - began > limit_s:
            break
    return search.rrt
