"""What all searches share: their steps, and the desk that judges needle paths."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from anatomy.structures import AIRWAY, FISSURE, OUTSIDE, VESSEL
from anatomy.typed import Float, Int
from lungaccess.plans.assemble import Candidate, Task
from lungaccess.plans.costs import path_cost
from stages.needle import (
    CURVATURE,
    ArcPath,
    NeedleEnvironment,
    Query,
    map_integral,
    needle_environment,
    violation,
    workspace_lengths,
)
from stages.tube import Deployment

if TYPE_CHECKING:
    from stages.needle.ompl import NeedleProblem

BLOCKERS = ((VESSEL, "a vessel"), (OUTSIDE, "the pleura"), (FISSURE, "a fissure"), (AIRWAY, "an airway"))


@dataclass(frozen=True, kw_only=True)
class Step:
    """What one step of a search did: its number, and a better candidate if it found one."""

    iteration: int
    phase: str
    candidate: Candidate | None = None
    cost: float = math.inf


class NeedleDesk:
    """Judges needle paths for one task: is it in the workspace, is it clear, what does it cost."""

    def __init__(self, task: Task) -> None:
        self.task = task
        self.environment: NeedleEnvironment = needle_environment(
            task.lung, task.system.needle, task.system.margins, with_fissures=task.with_fissures
        )
        self.blocked: Counter[str] = Counter()

    def cost(self, path: ArcPath) -> float:
        """Return the cost of a path under the task's objective."""
        task = self.task
        return path_cost(task.lung, path, task.objective, with_fissures=task.with_fissures)

    def reaches(self, lps_from_tip: Float) -> bool:
        """Tell whether the target lies in the workspace of a start pose."""
        length = workspace_lengths(
            self.environment, lps_from_tip[None, :3, 3], lps_from_tip[None, :3, 2], self.task.target.lps_mm
        )
        return bool(np.isfinite(length[0]))

    def search(self, deployment: Deployment, seed: int, iterations: int) -> ArcPath | None:
        """Return a path of the RRT, if it finds one."""
        return self._problem.plan(self.query(deployment), seed=seed, iterations=iterations)

    @cached_property
    def _problem(self) -> NeedleProblem:
        from stages.needle.ompl import NeedleProblem

        return NeedleProblem(self.environment)

    def proved(self, deployment: Deployment, path: ArcPath) -> bool:
        """Prove the path once more, from the numbers that the plan will state, and all limits of the needle.

        A voxel of infinite cost may not be entered, whatever the objective is.
        """
        if path.arcs[:, CURVATURE].max() > self.task.system.needle.max_curvature_per_mm:
            return False
        if violation(self.environment, self.query(deployment), path):
            return False
        return math.isfinite(map_integral(self.task.lung.cost, path))

    def query(self, deployment: Deployment) -> Query:
        """Return what is asked of the needle's searches from the tip of the tubes."""
        return Query(
            lps_from_start=deployment.lps_from_tip, target=self.task.target.lps_mm, branch=deployment.branch
        )

    def finished(self, iteration: int, phase: str, candidate: Candidate | None) -> Step:
        """Prove and price a candidate; a step without one if the proof fails."""
        if candidate is None or not self.proved(candidate.deployment, candidate.path):
            return Step(iteration=iteration, phase=phase)
        return Step(iteration=iteration, phase=phase, candidate=candidate, cost=self.cost(candidate.path))

    def count_blockers(self, blockers: Int) -> None:
        """Count what stands in the way of direct arcs."""
        labels, counts = np.unique(blockers, return_counts=True)
        for label, count in zip(labels, counts, strict=True):
            self.blocked[blocker_name(int(label))] += int(count)


def blocker_name(label: int) -> str:
    """Name what blocks an arc: 0 nothing, -1 the limits of the needle, else a voxel label."""
    if label == 0:
        return "nothing"
    if label < 0:
        return "the needle's limits"
    return next(name for bit, name in BLOCKERS if label & bit)
