"""Plan again from poses as they are tracked, one after another: what is prepared once serves all of them."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from functools import cached_property

import numpy as np

from anatomy.base.errors import LungaccessError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.base.words import of_hundred
from anatomy.lung import Lung
from anatomy.poses import poses_on_pieces
from lungaccess.planning.one_stage import ScopeReplanner, measured_pose, replan_from_tube
from lungaccess.planning.procedure import WATCHED, Measurements, Policy
from lungaccess.plans.curves import SHORTEST_MM, STEP_MM, needle_pieces, tube_pieces
from lungaccess.plans.parts import TubeDeployment
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import System
from lungaccess.problem.target import Target, point_target
from lungaccess.problem.task import Task
from stages.needle import ArcPath, Belief, Commands, Objective, Query, Replanner, Unknown, needle_environment

SCOPE_TIP, TUBE_TIP, NEEDLE_TIP, TARGET = (
    "ScopeTipTracked", "TubeTipTracked", "NeedleTipTracked", "TargetTracked",
)  # fmt: skip
"""Names of the tracked poses; of the target only the place counts."""
TRACKED = (SCOPE_TIP, TUBE_TIP, NEEDLE_TIP)
ITERATIONS = 300
"""Of the needle's search from a tracked tip: more made no difference in simulated insertions."""
UNKNOWN = Unknown(
    start=np.diag(np.repeat([5.0, math.radians(10.0)], 3) ** 2),
    factor_ln=0.4, roll_rad=math.radians(5.0), tip_mm=WATCHED.position_mm,
    tip_rad=math.radians(WATCHED.direction_deg),
)  # fmt: skip
"""A needle in unknown tissue: nine of ten bend 0.5 to 2 times as told, and none begins quite as planned
[assumption]."""
LOST_MM = 10.0
"""A needle that is so far from where it is believed, or was drawn back so far, is followed anew."""
PATH_STEP_MM = 1.0
"""Distance of the points of a path that is sent."""


@frozen_record
class Answer:
    """What came of one tracked pose.

    Args:
        name: Which pose it was.
        words: What came of it, for people.
        tubes_lps, needle_lps ((N, 3) float64 or None): Points of the way from there, LPS mm, proved clear;
            None for what is not left to do, or without one.
        processor_s: Processor time that it took.
    """

    name: str
    words: str
    tubes_lps: Float | None
    needle_lps: Float | None
    processor_s: float

    @property
    def found(self) -> bool:
        """Whether there is a way."""
        return self.tubes_lps is not None or self.needle_lps is not None


class TrackedReplanner:
    """Plans the rest of a plan from tracked poses; nothing that a pose can be makes it fail.

    Raises PlanFileError if the plan was made for another patient.

    Args:
        policy: What then decides about the tracked poses of scope, tubes and needle, as long as the target is
            where the plan has it; else the cheapest way is taken.
    """

    def __init__(self, plan: Plan, lung: Lung, policy: Policy | None = None) -> None:
        plan.require_lung(lung)
        self._plan, self._lung, self._policy = plan, lung, policy
        self._seen: dict[str, Float] = {}
        self._target = Target(lps_mm=np.asarray(plan.end_lps), origin=plan.target_origin)

    @property
    def target_lps(self) -> Float:
        """Where the target is now, `(3,)` LPS mm."""
        return self._target.lps_mm

    def warm_up(self) -> None:
        """Plan once from each planned pose, so that nothing is prepared or compiled later."""
        plan = self._plan
        for name, pose in (
            (SCOPE_TIP, plan.scope.lps_from_scope_tip), (TUBE_TIP, plan.tube.lps_from_tip),
            (NEEDLE_TIP, plan.tube.lps_from_tip),
        ):  # fmt: skip
            self.answer(name, np.asarray(pose))

    def answer(self, name: str, lps_from_device: Float) -> Answer:
        """Return what comes of a tracked pose `(4, 4)` LPS mm of a name of `TRACKED`, or of the target."""
        began = time.process_time()
        try:
            tubes, needle, words = self._planned(name, lps_from_device)
        except LungaccessError as reason:
            tubes, needle, words = None, None, f"no plan: {reason.found}"
        if name != TARGET:
            words = f"{words}; {self._to_target(name, lps_from_device)}"
        took = time.process_time() - began
        return Answer(name=name, words=words, tubes_lps=tubes, needle_lps=needle, processor_s=took)

    def _planned(self, name: str, pose: Float) -> tuple[Float | None, Float | None, str]:
        if name == TARGET:
            self._target = point_target(self._lung, pose[:3, 3], origin="tracked")
            self._policy = None
            self.__dict__.pop("_scope_replanner", None)
            return None, None, "target moved"
        if self._policy is not None:
            return self._decided(self._policy, name, pose)
        if name == NEEDLE_TIP:
            return self._from_needle(pose)
        if name == SCOPE_TIP:
            rest = self._scope_replanner.replan(measured_pose(self._lung, pose, "scope"))
        else:
            rest = replan_from_tube(
                self._lung, self._device, pose, self._target, objective=self._plan.objective,
                seed=self._plan.seed, iterations=ITERATIONS,
            )  # fmt: skip
        tubes = _tube_points(rest.tube, rest.lps_from_measured)
        needle = rest.path.sample(PATH_STEP_MM)[0] if rest.needle is not None else None
        return tubes, needle, f"plan: cost {rest.cost:.4g}, needle {rest.path.length_mm:.1f} mm"

    def _to_target(self, name: str, lps_from_device: Float) -> str:
        """Say how far the target is ahead of a device and aside of its axis; an alarm if beyond its bend."""
        x, y, ahead = lps_from_device[:3, :3].T @ (self.target_lps - lps_from_device[:3, 3])
        aside = math.hypot(x, y)
        words = f"target {ahead:.1f} mm ahead and {aside:.1f} mm aside"
        if name != NEEDLE_TIP or self._plan.system.needle is None:
            return words
        # One arc along the axis here leads to a point with the curvature 2 a / (a^2 + d^2).
        curvature = 2.0 * aside / max(aside**2 + ahead**2, SHORTEST_MM**2)
        beyond = ahead < 0.0 or curvature > self._plan.system.needle.max_curvature_per_mm
        return f"ALARM: {words}, beyond the bend of the needle" if beyond and aside > SHORTEST_MM else words

    def _decided(self, policy: Policy, name: str, pose: Float) -> tuple[Float | None, Float | None, str]:
        """Return what the policy says about a pose, after those of the stages before it."""
        stages = TRACKED[: TRACKED.index(name)]
        self._seen = {each: self._seen[each] for each in stages if each in self._seen} | {name: pose}
        scope, tubes, needle = ([self._seen[each]] if each in self._seen else [] for each in TRACKED)
        decision = policy.decide(Measurements.of(scope=scope, tubes=tubes, needle=needle))
        words = f"{decision.action}: {of_hundred(decision.chance)} of 100"
        if not decision.goes_on:
            return None, None, words
        out = _tube_points(decision.tube, decision.lps_from_device)
        if decision.needle is None:
            return out, None, words
        start = np.asarray(decision.needle.lps_from_start)
        path = ArcPath(lps_from_start=start, arcs=needle_pieces(decision.needle))
        return out, path.sample(PATH_STEP_MM)[0], words

    @property
    def _device(self) -> System:
        """The devices without a tool: what is planned again ends where it is told to, at the plan's aim."""
        return replace(self._plan.system, tool=None)

    @cached_property
    def _scope_replanner(self) -> ScopeReplanner:
        plan = self._plan
        task = Task(
            lung=self._lung, system=self._device, target=self._target, method="replan", seed=plan.seed,
            objective=Objective.of(plan.objective),
        )  # fmt: skip
        # Where no direct arc is clear, the needle's own search starts from ten deployments: ten milliseconds.
        return ScopeReplanner(task, tries=0, searches=10)

    @cached_property
    def _needle_replanner(self) -> Replanner:
        plan, system = self._plan, self._plan.system
        needle = system.require_needle("A tracked needle")
        environment = needle_environment(
            self._lung, needle, system.margins, with_fissures=plan.fissures_are_obstacles
        )
        start = np.asarray(plan.tube.lps_from_tip)
        query = Query(lps_from_start=start, target=self.target_lps, branch=plan.exemption.branch)
        path, objective = self._first_path, Objective.of(plan.objective)
        self._most_per_mm = needle.max_curvature_per_mm
        self._follow(query, path, 0.0)
        return Replanner(environment, query, path, objective=objective, iterations=ITERATIONS, seed=plan.seed)

    def _follow(self, query: Query, path: ArcPath, inserted_mm: float) -> None:
        """Take the needle to be at the start of a query, of unknown curvature, and to follow a path."""
        self._belief, self._inserted_mm = Belief(query, UNKNOWN), inserted_mm
        self._commands = Commands(path, self._most_per_mm)

    def _learn(self, pose: Float, inserted_mm: float) -> None:
        """Learn from a tracked pose where a needle is that follows the path last sent, and how it bends."""
        while self._inserted_mm < inserted_mm - SHORTEST_MM and not self._commands.finished:
            step = min(STEP_MM, inserted_mm - self._inserted_mm, self._commands.left_mm)
            self._commands.give(self._belief, None, step)
            self._inserted_mm += step
        off = float(np.linalg.norm(self._belief.frame[:3, 3] - pose[:3, 3]))
        if max(off, self._inserted_mm - inserted_mm) > LOST_MM:
            query = Query(lps_from_start=pose, target=self.target_lps)
            self._follow(query, self._needle_replanner.plan, inserted_mm)
        self._belief.correct(pose)

    def _from_needle(self, pose: Float) -> tuple[Float | None, Float | None, str]:
        """Plan the rest of a needle; what is inserted is taken from the place of the path that is nearest."""
        replanner = self._needle_replanner
        points, lengths = self._first_path.sample(STEP_MM)
        inserted = float(lengths[np.linalg.norm(points - pose[:3, 3], axis=1).argmin()])
        self._learn(pose, inserted)
        replanner.curvature_share = min(self._belief.factor, 1.0)
        found = replanner.replan(self._belief.frame, self.target_lps, inserted)
        if found.path is None:
            return None, None, f"no plan: {found.why}"
        self._commands = Commands(found.path, self._most_per_mm)
        words = (
            f"plan: {found.path.length_mm:.1f} mm left, ends {found.miss_mm:.2f} mm from the target; "
            f"bends {self._belief.factor:.2f} times as told"
        )
        return None, found.path.sample(PATH_STEP_MM)[0], words

    @cached_property
    def _first_path(self) -> ArcPath:
        start = np.asarray(self._plan.tube.lps_from_tip)
        return ArcPath(lps_from_start=start, arcs=needle_pieces(self._plan.needle))


def _tube_points(tube: TubeDeployment | None, lps_from_scope_tip: Float) -> Float | None:
    """Return points of the tubes for a path that is sent, LPS mm; None where they are not left to do."""
    if tube is None:
        return None
    return poses_on_pieces(lps_from_scope_tip, tube_pieces(tube), PATH_STEP_MM)[0][:, :3, 3]
