"""The evaluator of candidates: it proves them by the tests of all stages, and computes their cost."""

import math
from collections import Counter
from functools import cached_property
from typing import NamedTuple

import numpy as np

from anatomy.base.typed import Float, Float32, Int
from anatomy.structures import AIRWAY, FISSURE, OUTSIDE, VESSEL
from lungaccess.plans.candidate import (
    Candidate,
    TipRows,
    fissure_chance,
    parts_in_tissue,
    tubes_in_tissue,
    wall_in_path_mm,
    with_tool_in_place,
)
from lungaccess.plans.costs import path_beyond, path_cost
from lungaccess.plans.kernels.tissue import Wanted, taken_at
from lungaccess.plans.tissue import wanted_of
from lungaccess.problem.task import Task
from stages.needle import (
    CURVATURE,
    NO_MAP,
    ArcPath,
    Limits,
    NeedleEnvironment,
    Objective,
    ObjectiveArrays,
    Obstacles,
    Query,
    direct_path,
    map_integral,
    needle_environment,
    violation,
    workspace_lengths,
)
from stages.scope import ScopeTip
from stages.tube import Deployment, DeploymentValidator, TubeShape


class NeedleArrays(NamedTuple):
    """A needle among obstacles, and what its path is to keep small, for the compiled kernels.

    Args:
        has_forbidden_voxels: Whether a cost map forbids voxels, by infinite costs, that the objective does
            not weigh.
        forbidden_map ((ni, nj, nk) float32): That cost map.
        of_tubes: What the tubes in tissue cost for each mm of their width.
    """

    obstacles: Obstacles
    limits: Limits
    objective: ObjectiveArrays
    has_forbidden_voxels: bool
    forbidden_map: Float32
    of_tubes: ObjectiveArrays


BLOCKERS = ((VESSEL, "a vessel"), (OUTSIDE, "the pleura"), (FISSURE, "a fissure"), (AIRWAY, "an airway"))
"""Names of obstacles; the first one of a voxel counts."""

TOO_LITTLE = "too little of the nodule in the tool"
"""The reason that stops a path whose tool is at the target and holds less of the nodule than it has to."""
TOO_LIKELY = "a fissure: crossed with more chance than is allowed"
"""The reason that stops what crosses a fissure with too much chance, or enters lung where none is known."""
TIP_OFF_MM = 1e-6
"""So far from the target may the tip of the tubes be by rounding where there is no needle."""


class CandidateEvaluator:
    """Proves and costs the candidates of one task, from the numbers that a plan will state."""

    def __init__(self, task: Task) -> None:
        self.task = task
        system, fissures = task.system, task.with_fissures
        self.tubes = DeploymentValidator(task.lung, system.tubes, system.margins, with_fissures=fissures)
        self.blocked: Counter[str] = Counter()

    @cached_property
    def environment(self) -> NeedleEnvironment:
        """What the needle collides with, and its limits; SettingsError if the system has no needle."""
        task = self.task
        needle = task.system.require_needle("A search for paths of the needle")
        return needle_environment(task.lung, needle, task.system.margins, with_fissures=task.with_fissures)

    def cost(self, candidate: Candidate) -> float:
        """Return the cost of a candidate, proved or not, under the task's objective."""
        return self.cost_from(candidate.tip.lps_from_scope_tip, candidate.deployment, candidate.path)

    def cost_from(self, lps_from_scope_tip: Float, deployment: Deployment, path: ArcPath) -> float:
        """Return the cost of tubes from a scope tip, and a path beyond them, under the task's objective.

        The path is one to the target, as that of a candidate, and goes on as far as a tool needs it.
        """
        task, path = self.task, with_tool_in_place(self.task.system, path)
        return path_cost(
            task.lung,
            path,
            task.objective,
            with_fissures=task.with_fissures,
            wall_mm=wall_in_path_mm(task.system, deployment),
            parts=parts_in_tissue(task.system, lps_from_scope_tip, deployment, path),
        )

    def evaluate(self, candidate: Candidate) -> float:
        """Return the cost of a candidate, infinite if its proof fails."""
        return self.cost(candidate) if self.accepts(candidate) else math.inf

    def beside(self) -> "CandidateEvaluator":
        """Return one for further passes of a plan, which may take less than is enough as planned."""
        other = CandidateEvaluator(self.task)
        if self.wanted is not None:
            other.wanted = self.wanted._replace(least=0.0)
        return other

    def aim(self, tip_lps: Float) -> Float:
        """Return where devices from a place of the scope's tip are to end, `(3,)` LPS mm: at the target."""
        return self.task.target.lps_mm

    def end_of(self, path: ArcPath) -> Float:
        """Return where a path has to end, `(3,)` LPS mm: at the target."""
        return self.task.target.lps_mm

    def accepts(self, candidate: Candidate) -> bool:
        """Tell whether a candidate is proved; its cost only has to be finite."""
        return self.allows(candidate.tip.lps_from_scope_tip, candidate.deployment, candidate.path)

    def allows(self, lps_from_scope_tip: Float, deployment: Deployment, path: ArcPath) -> bool:
        """Tell whether a path is proved, and no tube enters an infinite cost that the objective weighs."""
        if not self.proves(deployment, path):
            return False
        most = self.task.system.max_fissure_chance
        if most is not None:
            aimed = with_tool_in_place(self.task.system, path)
            chance = fissure_chance(self.task.system, self.task.lung, lps_from_scope_tip, deployment, aimed)
            if chance is None or chance > most:
                self.blocked[TOO_LIKELY] += 1
                return False
        weighs_tubes = self.task.lung.cost is not None and self.objective.tissue > 0.0
        return not weighs_tubes or math.isfinite(self.cost_from(lps_from_scope_tip, deployment, path))

    def proves(self, deployment: Deployment, path: ArcPath) -> bool:
        """Tell whether a path ends at the target, keeps all limits, is clear, and enters no infinite cost.

        With a tool the path goes on until the tool is at the target: all of it is proved, and enough of the
        nodule has to be in the tool.  Without a needle the deployment is proved clear by its own validation.
        A voxel of infinite cost may not be entered, whatever the objective is, but in the wall that the tubes
        pierce.
        """
        needle, end, wanted = self.task.system.needle, self.end_of(path), self.wanted
        if wanted is not None:
            path = with_tool_in_place(self.task.system, path)
            last = path.frames()[-1]
            end = last[:3, 3]
            if taken_at(wanted, last) < wanted.least:
                self.blocked[TOO_LITTLE] += 1
                return False
        if needle is None:
            kept = np.abs(deployment.lps_from_tip[:3, 3] - end).max() <= TIP_OFF_MM
        else:
            kept = path.arcs[:, CURVATURE].max() <= needle.max_curvature_per_mm
            kept = kept and not violation(self.environment, self.query(deployment, end), path)
        if not kept:
            return False
        beyond = path_beyond(path, wall_in_path_mm(self.task.system, deployment))
        return math.isfinite(map_integral(self.task.lung.cost, beyond))

    def aimed(self, tip: ScopeTip, rotation_rad: float, shape: int | TubeShape) -> Candidate | None:
        """Return a deployment that is to end at the target itself, None if it is refused; see `direct`."""
        deployment = self.tubes.choose(tip.lps_from_scope_tip, rotation_rad, shape)
        if isinstance(deployment, str):
            return None
        path = tubes_in_tissue(tip.lps_from_scope_tip, deployment)
        return Candidate(tip=tip, deployment=deployment, path=path)

    def direct(
        self, tip: ScopeTip, rotation_rad: float, shape: int | TubeShape, end: Float | None = None
    ) -> Candidate | None:
        """Return a deployment with a direct arc to the target, None if the deployment is refused.

        Args:
            rotation_rad, shape: As those of `DeploymentValidator.choose`.
            end ((3,) float64): Where the arc ends, LPS mm; at the aim if None.
        """
        deployment = self.tubes.choose(tip.lps_from_scope_tip, rotation_rad, shape)
        if isinstance(deployment, str):
            return None
        aim = self.aim(tip.lps_from_scope_tip[:3, 3]) if end is None else end
        return Candidate(tip=tip, deployment=deployment, path=direct_path(deployment.lps_from_tip, aim))

    def reaches(self, lps_from_tip: Float) -> bool:
        """Tell whether the target lies in the needle's workspace at a start pose."""
        length = workspace_lengths(
            self.environment, lps_from_tip[None, :3, 3], lps_from_tip[None, :3, 2], self.task.target.lps_mm
        )
        return bool(np.isfinite(length[0]))

    def query(self, deployment: Deployment, end: Float | None = None) -> Query:
        """Return what is asked of the needle's searches from the tubes' tip; to the target if no end."""
        goal = self.task.target.lps_mm if end is None else end
        return Query(lps_from_start=deployment.lps_from_tip, target=goal, branch=deployment.branch)

    def count_blockers(self, blockers: Int) -> None:
        """Add to `blocked` what stopped direct arcs, by their labels `(N,)`."""
        self.blocked.update(blocker_counts(blockers))

    @cached_property
    def wanted(self) -> Wanted | None:
        """What has to be in the system's tool as planned; None without one."""
        task, tool = self.task, self.task.system.tool
        return None if tool is None else wanted_of(task.lung, task.target.lps_mm, tool)

    @cached_property
    def tip_rows(self) -> TipRows:
        """Scope tips beside a tip."""
        return TipRows(self.task.lung, self.task.system.scope)

    @property
    def objective(self) -> Objective:
        """The task's objective for the kernels, which weigh a cost map only where there is one."""
        objective = self.task.objective
        return objective.without_map if self.task.lung.cost is None else objective

    @cached_property
    def needle_arrays(self) -> NeedleArrays:
        """The needle, its environment and the objective for the kernels."""
        costs, objective = self.task.lung.cost, self.objective
        unseen = costs is not None and not objective.looks_at_map and not np.isfinite(costs.array).all()
        return NeedleArrays(
            self.environment.obstacles,
            self.environment.limits,
            self.environment.objective_arrays(objective),
            unseen,
            costs.array if unseen and costs is not None else NO_MAP,
            objective.arrays_of_tubes(None if costs is None else costs.array),
        )


def blocker_counts(blockers: Int) -> Counter[str]:
    """Return how many of direct arcs each name stops, from their labels `(N,)`."""
    labels, counts = np.unique(blockers, return_counts=True)
    named: Counter[str] = Counter()
    for label, count in zip(labels.tolist(), counts.tolist(), strict=True):
        named[blocker_name(label)] += count
    return named


def blocker_name(label: int) -> str:
    """Name what blocks an arc: 0 nothing, -1 the limits of the needle, else a voxel label."""
    if label == 0:
        return "nothing"
    if label < 0:
        return "the needle's limits"
    return next(name for bit, name in BLOCKERS if label & bit)
