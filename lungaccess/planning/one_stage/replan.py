"""Plan the rest from a measured pose: tubes and needle from a scope's tip, or a needle from a tube's tip."""

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from anatomy import poses
from anatomy.base.errors import FrameError, TargetError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float, Int
from anatomy.lung import Lung
from lungaccess.planning.coupled.kernels.direct_arcs import cost_bounds, evaluate_arcs
from lungaccess.planning.coupled.kernels.local_search import MAX_VIAS, improve
from lungaccess.planning.coupled.search.aimed_tubes import AimedFromPose
from lungaccess.planning.coupled.search.direct_arcs import costs_of_tubes
from lungaccess.planning.coupled.search.local_search import TubeChoice, path_through, tube_arguments
from lungaccess.planning.one_stage.needle import needle_question, reason_in_words
from lungaccess.plans import assemble
from lungaccess.plans.candidate import with_tool_in_place
from lungaccess.plans.evaluator import TOO_LITTLE, CandidateEvaluator
from lungaccess.plans.kernels.tissue import taken_at
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.parts import NeedlePath, TubeDeployment
from lungaccess.plans.tissue import wanted_of
from lungaccess.problem.system import System
from lungaccess.problem.target import Target
from lungaccess.problem.task import Task, objective_of
from stages.needle import (
    DEFAULT,
    ArcPath,
    Objective,
    OptimalSearch,
    easiest_obstruction,
    find_obstruction,
    map_integral,
    violation,
    workspace_lengths,
)
from stages.tube import Deployment, Enumerator, SiteEnumerator, design_arrays


@frozen_record
class RestOfPlan:
    """What is left to do from a measured pose: proved clear and within all limits.

    The pose, as it was taken, is that of the scope's tip, or of the tube's tip where there is no deployment
    left.  The path is that of the needle, or without one of the tubes in tissue.  `branch` is that whose wall
    is exempt at the exit; -1 for none.
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
        return assemble.tube_part(self.task, self.lps_from_measured, self.deployment)

    @cached_property
    def needle(self) -> NeedlePath | None:
        """The needle as a plan states it; None where the system has none, and the tubes end at the target."""
        return None if self.task.system.needle is None else assemble.needle_part(self.path)

    @cached_property
    def clearance_mm(self) -> Mapping[str, Mapping[str, float]]:
        """As that of a plan."""
        clearance = {}
        if self.task.system.needle is not None:
            clearance["needle"] = assemble.needle_clearance_mm(self.task, self.path, self.branch)
        if self.deployment is not None:
            clearance["tube"] = assemble.tube_clearance_mm(self.task, self.lps_from_measured, self.deployment)
        return clearance

    @cached_property
    def costs(self) -> Mapping[str, float]:
        """As those of a plan."""
        return assemble.stated_costs(self.task, self.lps_from_measured, self.deployment, self.path)

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


SEARCHED = 30
"""So many deployments get a search of the needle where no direct arc is clear: some ten milliseconds."""
TRIES = 400
"""Variations of rotation, insertions and needle that improve the first answer: some milliseconds."""


class ScopeReplanner:
    """Plans tubes and needle from one tip of the scope after another; see `replan_from_scope`."""

    def __init__(self, task: Task, *, tries: int = TRIES, searches: int = SEARCHED) -> None:
        self._task, self._evaluator = task, CandidateEvaluator(task)
        self._tries, self._searches = tries, searches
        self._enumerate: Enumerator | None = None
        if task.system.needle is not None:
            self._enumerate = SiteEnumerator(
                task.lung, task.system.tubes, task.system.margins, with_fissures=task.with_fissures
            ).deployments

    def replan(self, lps_from_scope_tip: Float) -> RestOfPlan:
        """Return the rest from a rigid pose `(4, 4)`; NoPlan if there is none."""
        frame, evaluator = lps_from_scope_tip, self._evaluator
        evaluator.blocked.clear()
        search = (
            AimedFromPose(evaluator, frame)
            if self._enumerate is None
            else _FromScope(evaluator, self._enumerate, frame, self._tries, self._searches)
        )
        found = search.best()
        if found is None:
            raise NoPlan(f"No plan from the scope's tip as measured: {search.why}", reasons=search.reasons)
        deployment, path = found
        return RestOfPlan(
            task=self._task,
            lps_from_measured=frame,
            deployment=deployment,
            path=with_tool_in_place(self._task.system, path),
            branch=deployment.branch,
        )


class _FromScope:
    """The search from one pose of the scope."""

    def __init__(
        self, evaluator: CandidateEvaluator, enumerator: Enumerator, frame: Float, tries: int, searches: int
    ) -> None:
        self._evaluator, self._frame, self._task = evaluator, frame, evaluator.task
        self._tries, self._searches = tries, searches
        self._target = self._task.target.lps_mm
        self._row = np.concatenate([frame[:3, 3], frame[:3, 2], frame[:3, 0]])[None]
        self._outside = 0
        self.entries = enumerator(self._row[0], self._in_workspace)
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
        near, every, (x, y, z) = self._near, self.entries, self._target.tolist()
        bounds, some = np.zeros(len(near)), every.only(near)
        cost_bounds(self._evaluator.needle_arrays, every.positions[near], self._near_mm, (x, y, z), bounds)
        before = costs_of_tubes(self._evaluator, np.repeat(self._row, some.count, axis=0), some)
        order = np.argsort(bounds + before, kind="stable")
        near = near[order]
        # An arc that costs more than a clear one is of use only where the cheaper ones are not proved.
        for slack in (1.0, math.inf):
            blockers, costs = np.zeros(len(near), dtype=np.int64), np.zeros(len(near))
            evaluate_arcs(
                self._evaluator.needle_arrays, every.positions[near], every.tangents[near],
                every.branch[near], before[order], (x, y, z), slack, math.inf, blockers, costs,
            )  # fmt: skip
            clear = np.flatnonzero((blockers == 0) & np.isfinite(costs))
            found = None
            for entry in near[clear[np.argsort(costs[clear], kind="stable")]].tolist():
                deployment = self._deployment(entry)
                path = path_through(deployment, np.zeros((0, 3)), self._target)
                if self._evaluator.allows(self._frame, deployment, path):
                    found = deployment, path
                    break
            if found is not None or not len(clear):
                break
        self._evaluator.count_blockers(blockers)
        return found

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
            # Iterations of such a search, as the first of the coupled search.
            search.advance(300)
            if search.path is None:
                continue
            if self._evaluator.allows(self._frame, deployment, search.path):
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
        before = self._evaluator.cost_from(self._frame, deployment, path)
        if self._evaluator.cost_from(self._frame, found, better) >= before:
            return deployment, path
        return (found, better) if self._evaluator.proves(found, better) else (deployment, path)

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


SKEW = 0.02
"""A measured rotation may be off by so much, about a degree; it is replaced by the nearest rotation."""
NEEDLE_ITERATIONS = 1500
"""Iterations of the needle's search from a measured tip, as in a replan during insertion."""


def replan_from_scope(
    lung: Lung,
    system: System,
    lps_from_scope_tip: ArrayLike,
    target: Target,
    *,
    objective: str | Objective = DEFAULT,
    seed: int = 0,
    tries: int = TRIES,
    searches: int = SEARCHED,
) -> RestOfPlan:
    """Plan tubes and needle from where the tip of the scope really is.

    With a tool the needle goes on until the tool is at the target, and takes enough of the nodule.  The
    deployments from this one pose are enumerated as in an atlas, as far as the target lies in the needle's
    workspace; the cheapest clear direct arc is the first answer, or what the needle's own search finds, and a
    local search improves it.  Without a needle the tubes are aimed at the target.  The same input and seed
    give the same answer.

    Args:
        lps_from_scope_tip ((4, 4) float64): As measured: +z forward, +x the way a positive bend turns the
            tip.
        tries: Variations of rotation, insertions and needle that improve the first answer; 0 for none.
        searches: Deployments from which the needle's own search starts where no direct arc is clear.

    Raises:
        NoPlan: If there is none; counts the reasons.
        FrameError: If the pose is not one, within SKEW.
        TargetError: If pose or target lie outside the images, or the target in an obstacle.
    """
    frame = measured_pose(lung, lps_from_scope_tip, "scope")
    task = _task(lung, system, target, objective, seed)
    return ScopeReplanner(task, tries=tries, searches=searches).replan(frame)


def replan_from_tube(
    lung: Lung,
    system: System,
    lps_from_tip: ArrayLike,
    target: Target,
    *,
    objective: str | Objective = DEFAULT,
    seed: int = 0,
    iterations: int = NEEDLE_ITERATIONS,
) -> RestOfPlan:
    """Plan the needle from where the tip of the tubes really is; see `replan_from_scope`.

    SettingsError is raised if the system has no needle: then nothing is left to plan.  A tip near an airway
    is taken to have pierced its wall, as `plan_needle` does.  The needle's search begins with the direct arc.
    """
    frame = measured_pose(lung, lps_from_tip, "tube")
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
    if path is not None:
        path = with_tool_in_place(system, path)
        last = path.frames()[-1]
        query = replace(asked.query, target=last[:3, 3]) if system.tool is not None else asked.query
        proved = math.isfinite(map_integral(lung.cost, path)) and not violation(
            asked.environment, query, path
        )
        path = path if proved else None
    wanted = None if system.tool is None else wanted_of(lung, target.lps_mm, system.tool)
    if path is not None and wanted is not None and taken_at(wanted, last) < wanted.least:
        raise NoPlan("No needle path from the tube's tip as measured", reasons={f"needle: {TOO_LITTLE}": 1})
    if path is None:
        blocked = blocked or easiest_obstruction(asked.environment, asked.query)
        why = "the search found no clear path" if blocked is None else reason_in_words(blocked)
        raise NoPlan(f"No needle path from the tube's tip as measured: {why}", reasons={f"needle: {why}": 1})
    return RestOfPlan(
        task=task, lps_from_measured=frame, deployment=None, path=path, branch=asked.query.branch
    )


def _task(lung: Lung, system: System, target: Target, objective: str | Objective, seed: int) -> Task:
    weighed = objective_of(lung, objective)
    return Task(lung=lung, system=system, target=target, objective=weighed, method="replan", seed=seed)


def measured_pose(lung: Lung, pose: ArrayLike, what: str) -> Float:
    """Return the nearest rigid pose `(4, 4)` to a measured one, LPS mm; `what` device it is of, for messages.

    Raises:
        FrameError: If it is not a rigid pose within SKEW.
        TargetError: If it lies outside the images.
    """
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
