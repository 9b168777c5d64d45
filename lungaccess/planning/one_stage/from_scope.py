"""The search for tubes and needle from one tip of the scope after another."""

import math

import numpy as np

from anatomy.base.typed import Bool, Float, Int
from lungaccess.planning.coupled.kernels.direct_arcs import cost_bounds, evaluate_arcs
from lungaccess.planning.coupled.kernels.local_search import MAX_VIAS, improve
from lungaccess.planning.coupled.search.aimed_tubes import AimedFromPose
from lungaccess.planning.coupled.search.direct_arcs import costs_of_tubes
from lungaccess.planning.coupled.search.local_search import TubeChoice, path_through, tube_arguments
from lungaccess.planning.one_stage.rest import RestOfPlan
from lungaccess.plans.candidate import with_tool_in_place
from lungaccess.plans.evaluator import CandidateEvaluator
from lungaccess.plans.no_plan import NoPlan
from lungaccess.problem.task import Task
from stages.needle import ArcPath, OptimalSearch, workspace_lengths
from stages.tube import Deployment, Enumerator, SiteEnumerator, design_arrays

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
        near, (x, y, z) = self._near, self._target.tolist()
        bounds = np.zeros(len(near))
        cost_bounds(
            self._evaluator.needle_arrays, self.entries.positions[near], self._near_mm, (x, y, z), bounds
        )
        near = near[np.argsort(bounds + self._before(near), kind="stable")]
        # An arc that costs more than a clear one is of use only where the cheaper ones are not proved.
        for slack in (1.0, math.inf):
            blockers, costs = self._arcs(near, slack)
            clear = np.flatnonzero((blockers == 0) & np.isfinite(costs))
            found = self._first_proved(near[clear[np.argsort(costs[clear], kind="stable")]])
            if found is not None or not len(clear):
                break
        self._evaluator.count_blockers(blockers)
        return found

    def _arcs(self, entries: Int, slack: float) -> tuple[Int, Float]:
        """Return what blocks the direct arcs of some deployments, and what they cost; see `evaluate_arcs`."""
        every, (x, y, z) = self.entries, self._target.tolist()
        blockers, costs = np.zeros(len(entries), dtype=np.int64), np.zeros(len(entries))
        evaluate_arcs(
            self._evaluator.needle_arrays, every.positions[entries], every.tangents[entries],
            every.branch[entries], self._before(entries), (x, y, z), slack, math.inf, blockers, costs,
        )  # fmt: skip
        return blockers, costs

    def _before(self, entries: Int) -> Float:
        """Return what the tubes of some deployments cost before their arcs."""
        some = self.entries.only(entries)
        return costs_of_tubes(self._evaluator, np.repeat(self._row, some.count, axis=0), some)

    def _first_proved(self, entries: Int) -> tuple[Deployment, ArcPath] | None:
        for entry in entries.tolist():
            deployment = self._deployment(entry)
            path = path_through(deployment, np.zeros((0, 3)), self._target)
            if self._evaluator.allows(self._frame, deployment, path):
                return deployment, path
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
