"""Plan the rest from a measured pose: tubes and needle from a scope's tip, or a needle from a tube's tip."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from anatomy import poses
from anatomy.errors import FrameError, TargetError
from anatomy.lung import Lung
from anatomy.records import frozen_record
from anatomy.typed import Bool, Float, Int
from lungaccess.coupled.kernels.direct_arcs import cost_bounds, evaluate_arcs
from lungaccess.coupled.kernels.local_search import MAX_VIAS, improve
from lungaccess.coupled.search.aimed_tubes import AimedFromPose
from lungaccess.coupled.search.local_search import TubeChoice, path_through, tube_arguments
from lungaccess.one_stage.needle import needle_question
from lungaccess.one_stage.obstruction import reason_in_words
from lungaccess.plans.assemble import (
    needle_clearance_mm,
    needle_part,
    stated_costs,
    tube_clearance_mm,
    tube_part,
)
from lungaccess.plans.evaluator import CandidateEvaluator
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.parts import NeedlePath, TubeDeployment
from lungaccess.problem.system import System
from lungaccess.problem.target import Target
from lungaccess.problem.task import Task
from stages.needle import (
    ArcPath,
    Objective,
    OptimalSearch,
    easiest_obstruction,
    find_obstruction,
    map_integral,
    violation,
    workspace_lengths,
)
from stages.tube import Deployment, Deployments, design_arrays, enumerate_deployments

SKEW = 0.02
"""A measured rotation may be off by so much, about a degree; it is replaced by the nearest rotation."""
SEARCHED = 30
"""So many deployments get a search of the needle where no direct arc is clear: some ten milliseconds."""
SEARCH_ITERATIONS = 300
"""Iterations of such a search, as the first of the coupled search."""
TRIES = 400
"""Variations of rotation, insertions and needle that improve the first answer: some milliseconds."""
NEEDLE_ITERATIONS = 1500
"""Iterations of the needle's search from a measured tip, as in a replan during insertion."""


DeploymentRank = Callable[[Float, Deployments], Float]
"""Tells from the row `(1, 9)` of a scope tip and N deployments how good `(N,)` each is."""


@frozen_record
class RestOfPlan:
    """What is left to do from a measured pose: proved clear and within all limits.

    Parameters
    ----------
    task : Task
        What was asked.
    lps_from_measured : (4, 4) float64
        The pose as it was taken: that of the scope's tip, or of the tube's tip where there is no deployment.
    deployment : Deployment or None
        Of the tubes, where they are left to do.
    path : ArcPath
        Of the needle, or without one of the tubes in tissue.
    branch : int
        Branch whose wall is exempt at the exit; -1 for none.
    """

    task: Task
    lps_from_measured: Float
    deployment: Deployment | None
    path: ArcPath
    branch: int

    @cached_property
    def tube(self) -> TubeDeployment | None:
        """The tubes as a plan states them, None where they stand already."""
        if self.deployment is None:
            return None
        return tube_part(self.task, self.lps_from_measured, self.deployment)

    @cached_property
    def needle(self) -> NeedlePath | None:
        """The needle as a plan states it; None where the system has none, and the tubes end at the target."""
        return None if self.task.system.needle is None else needle_part(self.path)

    @cached_property
    def clearance_mm(self) -> Mapping[str, Mapping[str, float]]:
        """As that of a plan."""
        clearance = {}
        if self.task.system.needle is not None:
            clearance["needle"] = needle_clearance_mm(self.task, self.path, self.branch)
        if self.deployment is not None:
            clearance["tube"] = tube_clearance_mm(self.task, self.lps_from_measured, self.deployment)
        return clearance

    @cached_property
    def costs(self) -> Mapping[str, float]:
        """As those of a plan."""
        return stated_costs(self.task, self.deployment, self.path)

    @property
    def objective(self) -> str:
        """The objective in words."""
        return str(self.task.objective)

    @property
    def cost(self) -> float:
        """Cost under the objective."""
        return float(self.costs[self.objective])

    def record(self) -> dict[str, Any]:
        """Return plain JSON values; poses in LPS mm, angles in rad."""
        from lungaccess.plans.file import plain

        return {
            "found": True,
            "lps_from_measured": self.lps_from_measured.tolist(),
            "tube": None if self.tube is None else plain(self.tube),
            "needle": None if self.needle is None else plain(self.needle),
            "pierced_branch": self.branch,
            "clearance_mm": {name: dict(each) for name, each in self.clearance_mm.items()},
            "objective": self.objective,
            "costs": dict(self.costs),
        }


def replan_from_scope(
    lung: Lung,
    system: System,
    lps_from_scope_tip: ArrayLike,
    target: Target,
    *,
    objective: str | Objective = "inverse_clearance",
    seed: int = 0,
    tries: int = TRIES,
    searches: int = SEARCHED,
    rank: DeploymentRank | None = None,
) -> RestOfPlan:
    """Plan tubes and needle from where the tip of the scope really is.

    The deployments from this one pose are enumerated as in an atlas, as far as the target lies in the
    needle's workspace; the cheapest clear direct arc is the first answer, or what the needle's own search
    finds, and a local search improves it.  Without a needle the tubes are aimed at the target.  The same
    input and seed give the same answer.

    Parameters
    ----------
    lps_from_scope_tip : (4, 4) float64
        The pose as measured: +z forward, +x the way a positive bend turns the tip, up in the picture.
    tries : int
        Variations of rotation, insertions and needle that improve the first answer; 0 for a faster one.
    searches : int
        Deployments from which the needle's own search starts where no direct arc is clear.
    rank : callable, optional
        Tells from the row `(1, 9)` of the scope tip and N deployments with a clear direct arc how good each
        is; the best is taken, instead of the cheapest, and not varied.

    Raises
    ------
    NoPlan
        If there is none; counts the reasons.
    FrameError
        If the pose is not one, within SKEW.
    TargetError
        If pose or target lie outside the images, or the target in an obstacle.
    """
    frame = _rigid(lung, lps_from_scope_tip, "scope")
    task = _task(lung, system, target, objective, seed)
    evaluator = CandidateEvaluator(task)
    search = (
        _FromScope(evaluator, frame, tries, searches, rank)
        if system.needle
        else AimedFromPose(evaluator, frame)
    )
    found = search.best()
    if found is None:
        raise NoPlan(f"No plan from the scope's tip as measured: {search.why}", reasons=search.reasons)
    deployment, path = found
    return RestOfPlan(
        task=task, lps_from_measured=frame, deployment=deployment, path=path, branch=deployment.branch
    )


def replan_from_tube(
    lung: Lung,
    system: System,
    lps_from_tip: ArrayLike,
    target: Target,
    *,
    objective: str | Objective = "inverse_clearance",
    seed: int = 0,
    iterations: int = NEEDLE_ITERATIONS,
) -> RestOfPlan:
    """Plan the needle from where the tip of the tubes really is; see `replan_from_scope`.

    SettingsError is raised if the system has no needle: then nothing is left to plan.

    A tip near an airway is taken to have pierced its wall, as `plan_needle` does.

    Parameters
    ----------
    lps_from_tip : (4, 4) float64
        The pose as measured; +z is the direction of insertion.
    iterations : int
        Of the needle's search, which begins with the direct arc.
    """
    frame = _rigid(lung, lps_from_tip, "tube")
    task = _task(lung, system, target, objective, seed)
    asked = needle_question(lung, system, frame, target.lps_mm)
    blocked = find_obstruction(asked.environment, asked.query)
    path = None
    if blocked is None or not blocked.proved:
        weighed = task.objective if lung.cost is not None else task.objective.without_map
        search = OptimalSearch(asked.environment, asked.query, seed=seed, objective=weighed)
        while search.iterations < iterations:
            before = search.iterations
            search.advance(iterations - before)
            if search.iterations == before:
                break
        path = search.path
    allowed = path is not None and math.isfinite(map_integral(lung.cost, path))
    if path is None or not allowed or violation(asked.environment, asked.query, path):
        blocked = blocked or easiest_obstruction(asked.environment, asked.query)
        why = "the search found no clear path" if blocked is None else reason_in_words(blocked)
        raise NoPlan(f"No needle path from the tube's tip as measured: {why}", reasons={f"needle: {why}": 1})
    return RestOfPlan(
        task=task, lps_from_measured=frame, deployment=None, path=path, branch=asked.query.branch
    )


def _task(lung: Lung, system: System, target: Target, objective: str | Objective, seed: int) -> Task:
    weighed = Objective.of(objective)
    return Task(lung=lung, system=system, target=target, objective=weighed, method="replan", seed=seed)


class _FromScope:
    """The search from one pose of the scope."""

    def __init__(
        self,
        evaluator: CandidateEvaluator,
        frame: Float,
        tries: int,
        searches: int,
        rank: DeploymentRank | None,
    ) -> None:
        self._evaluator, self._frame, self._task = evaluator, frame, evaluator.task
        self._tries, self._searches, self._rank = tries if rank is None else 0, searches, rank
        system, self._target = self._task.system, self._task.target.lps_mm
        self._row = np.concatenate([frame[:3, 3], frame[:3, 2], frame[:3, 0]])[None]
        self._outside = 0
        self.entries = enumerate_deployments(
            self._task.lung, system.tubes, system.margins, self._row,
            with_fissures=self._task.with_fissures, worthwhile=self._in_workspace,
        )  # fmt: skip
        lengths = self._lengths(self.entries.positions, self.entries.tangents)
        near = np.flatnonzero(np.isfinite(lengths))
        self._near: Int = near[np.argsort(lengths[near], kind="stable")]
        self._near_mm = lengths[self._near]

    def _lengths(self, positions: Float, tangents: Float) -> Float:
        """Return the shortest lengths of needle to the target from tips, infinite outside the workspace."""
        return workspace_lengths(self._evaluator.environment, positions, tangents, self._target)

    def _in_workspace(self, positions: Float, tangents: Float) -> Bool:
        holds = np.isfinite(self._lengths(positions, tangents))
        self._outside = int(np.count_nonzero(~holds))
        return holds

    def best(self) -> tuple[Deployment, ArcPath] | None:
        """Return the cheapest deployment and path found, None if there is none."""
        first = self._direct() or self._searched()
        return None if first is None else self._improved(*first)

    def _direct(self) -> tuple[Deployment, ArcPath] | None:
        """Return the proved direct arc of least estimated cost, those of the least bounds looked at first."""
        near, entries, needle = self._near, self.entries, self._evaluator.needle_arrays
        x, y, z = self._target.tolist()
        bounds = np.zeros(len(near))
        cost_bounds(needle, entries.positions[near], self._near_mm, (x, y, z), bounds)
        near = near[np.argsort(bounds, kind="stable")]
        blockers, costs = np.zeros(len(near), dtype=np.int64), np.zeros(len(near))
        # An arc that costs more than a clear one is of use only where the cheaper ones are not proved.
        for slack in (1.0, math.inf) if self._rank is None else (math.inf,):
            evaluate_arcs(
                needle, entries.positions[near], entries.tangents[near], entries.branch[near], (x, y, z),
                slack, math.inf, blockers, costs,
            )  # fmt: skip
            clear = np.flatnonzero((blockers == 0) & np.isfinite(costs))
            worst = costs[clear]
            if self._rank is not None:
                worst = -self._rank(self._row, entries.only(near[clear]))
            for n in clear[np.argsort(worst, kind="stable")].tolist():
                deployment = self._deployment(int(near[n]))
                path = path_through(deployment, np.zeros((0, 3)), self._target)
                if self._evaluator.proves(deployment, path):
                    return deployment, path
            if not len(clear):
                break
        self._evaluator.count_blockers(blockers)
        return None

    def _searched(self) -> tuple[Deployment, ArcPath] | None:
        """Return the first path that the needle's own search finds, the nearest deployments first."""
        for entry in self._near[: self._searches].tolist():
            deployment = self._deployment(int(entry))
            search = OptimalSearch(
                self._evaluator.environment,
                self._evaluator.query(deployment),
                seed=self._task.seed,
                objective=self._evaluator.objective,
            )
            search.advance(SEARCH_ITERATIONS)
            if search.path is not None and self._evaluator.proves(deployment, search.path):
                return deployment, search.path
        return None

    def _improved(self, deployment: Deployment, path: ArcPath) -> tuple[Deployment, ArcPath]:
        """Return what a local search makes of it, if that is cheaper and proved."""
        vias, points = np.zeros((MAX_VIAS, 3)), path.frames()[1:-1, :3, 3]
        if len(points) > MAX_VIAS or not self._tries:
            return deployment, path
        vias[: len(points)] = points
        design, (x, y, z) = design_arrays(self._task.system.tubes), self._target.tolist()
        choice = TubeChoice.of(design, deployment, 0.0)
        if choice is None:
            return deployment, path
        state = np.array([self._task.seed], dtype=np.uint64)
        count, cost = improve(
            tube_arguments(self._evaluator, design)(choice), self._evaluator.needle_arrays, self._row,
            np.ones(1, dtype=np.bool_), choice.x, vias, len(points), (x, y, z), self._tries, state,
        )  # fmt: skip
        if not math.isfinite(cost):
            return deployment, path
        found = self._evaluator.tubes.choose(self._frame, *choice.numbers)
        if isinstance(found, str):
            return deployment, path
        better = path_through(found, vias[:count], self._target)
        cheaper = self._evaluator.cost(better) < self._evaluator.cost(path)
        return (found, better) if cheaper and self._evaluator.proves(found, better) else (deployment, path)

    def _deployment(self, entry: int) -> Deployment:
        found = self._evaluator.tubes.choose(self._frame, *self.entries.choice(entry))
        if isinstance(found, str):
            raise NoPlan(f"The tubes are refused on a second look: {found}", reasons={f"tube: {found}": 1})
        return found

    @property
    def why(self) -> str:
        """What prevents a plan, in words."""
        if not self.entries.count and self.entries.candidates:
            most = max(self.entries.refused, key=lambda name: self.entries.refused[name], default="")
            return f"no deployment of the tubes towards the target is allowed there, mostly because {most}"
        if not len(self._near):
            return "the target lies outside the needle's workspace for every deployment of the tubes"
        return "every needle path tried from the tubes is blocked"

    @property
    def reasons(self) -> dict[str, int]:
        """How many deployments and arcs each reason ruled out."""
        reasons = {f"tube: {why}": count for why, count in self.entries.refused.items()}
        outside = self._outside + self.entries.count - len(self._near)
        reasons["needle: deployments whose workspace does not hold the target"] = outside
        named = self._evaluator.blocked.items()
        return reasons | {f"needle: arcs stopped by {name}": n for name, n in named if name != "nothing"}


def _rigid(lung: Lung, pose: ArrayLike, what: str) -> Float:
    """Return the nearest rigid pose to a measured one."""
    matrix = np.array(pose, dtype=np.float64)
    good = matrix.shape == (4, 4) and bool(np.isfinite(matrix).all())
    turn = matrix[:3, :3] if good else np.zeros((3, 3))
    left, _sizes, right = np.linalg.svd(turn)
    nearest = left @ right
    if not good or np.linalg.det(turn) <= 0.0 or np.abs(nearest - turn).max() > SKEW:
        raise FrameError(
            f"The measured pose of the {what}'s tip is not a rigid pose",
            expected=f"a 4x4 matrix with a right-handed rotation (off by at most {SKEW:g}) and mm",
            remedy="Check that the matrix is neither transposed, scaled nor mirrored",
        )
    if not lung.grid.contains(matrix[:3, 3]).all():
        raise TargetError(
            f"The {what}'s tip as measured lies outside the images, at LPS {matrix[:3, 3].round(1).tolist()}",
            expected="a pose inside the lung",
            remedy="Check the frame of its numbers, RAS or LPS, and the registration",
        )
    return poses.pose(matrix[:3, 3], nearest[:, 2], nearest[:, 0])
