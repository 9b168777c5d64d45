"""Algorithm 1 of [Kuntz2015] as printed, with FCL on surface meshes instead of clearance fields."""

import math
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.planning.coupled.kuntz2015_fcl.needle import NeedleRRT
from lungaccess.planning.coupled.kuntz2015_fcl.obstacles import Obstacles
from lungaccess.planning.coupled.kuntz2015_fcl.tubes import TubeValidator, path_of
from lungaccess.planning.coupled.search.base import SearchInParts, Step
from lungaccess.planning.coupled.search.kuntz2015 import Placement, random_placements
from lungaccess.plans.candidate import Candidate
from lungaccess.plans.evaluator import CandidateEvaluator
from lungaccess.problem.task import Task
from stages.needle import ArcPath
from stages.tube import Deployment, design_arrays, shape_or_reason

PHASE = "reference"
FOUND = "found"
OUT_OF_WORKSPACE = "the target lies outside the needle's workspace"
NO_PATH = "the RRT found no path"
"""What can become of a placement, besides the reasons why tubes are refused."""
RRT_ITERATIONS = 50
"""About what 0.05 s of [Kuntz2015] hold here."""


@frozen_record
class Refusal:
    """A plan of the reference that the planner's proof refuses: whether its tubes or its needle."""

    stage: str
    candidate: Candidate


class ReferenceSearch(SearchInParts):
    """Random placements, FCL, a needle RRT each, keep the best: the yardstick of the planner.

    The algorithm is as printed, but for what the paper leaves open or safety asks for.  The scope takes poses
    where it fits and an airway in lung tissue lies ahead, as in `KuntzSearch`; after line 8 the tubes are
    validated too.  A path that is found is yielded only if the planner's proof accepts it.

    Args:
        task, atlas, rejects: See `lungaccess.planning.coupled.search.kuntz2015.KuntzSearch`.
        rrt_iterations: Samples of each RRT: the same seed then gives the same plans.
        rrt_time_s: Processor time of each RRT instead, 0.05 in the paper.  Such a run cannot be repeated
            exactly.
        obstacles: Those of another search in the same lung; its meshes, which take long to make, are then
            shared.

    Attributes:
        counts: What became of the placements: `FOUND`, or why none was.
        spent_s: Processor time by part: "placement", "tubes", "needle", "proof".
        refused_by_proof: Paths that were found and are not yielded.

    Raises:
        SettingsError: If an RRT has no budget.
    """

    def __init__(
        self,
        task: Task,
        atlas: Atlas,
        *,
        rejects: bool = True,
        rrt_iterations: int = RRT_ITERATIONS,
        rrt_time_s: float | None = None,
        obstacles: Obstacles | None = None,
    ) -> None:
        if not (rrt_iterations if rrt_time_s is None else rrt_time_s) > 0:
            raise SettingsError("The RRT has no budget", expected="rrt_iterations or rrt_time_s above 0")
        if task.needle_planner:
            raise SettingsError(
                f"The needle planner {task.needle_planner} is named for the reference mode",
                expected="none: its RRT moves among surface meshes",
                remedy="Leave it out, or choose the method atlas or kuntz2015",
            )
        system = task.system
        self.task, self._atlas, self._rejects = task, atlas, rejects
        self._evaluator = CandidateEvaluator(task)
        super().__init__(self._evaluator.blocked)
        self.obstacles = obstacles or obstacles_for(task)
        self._budget = (rrt_iterations, None) if rrt_time_s is None else (None, rrt_time_s)
        self._tubes, self._design = TubeValidator(system, self.obstacles), design_arrays(system.tubes)
        needle = system.require_needle("Algorithm 1 of [Kuntz2015]")
        required_mm = needle.radius_mm + system.margins.total_mm
        self._needle_rrt = NeedleRRT(needle, required_mm, self.obstacles)
        self.counts: Counter[str] = Counter()
        self.spent_s: defaultdict[str, float] = defaultdict(float)
        self.refused_by_proof: list[Refusal] = []

    def further_steps(self) -> Iterator[Step]:
        """Draw placements without end; each is an iteration, and none depends on those before it."""
        began = time.thread_time()
        placements = random_placements(self.task, self._atlas, self.share[0])
        for iteration, placement in enumerate(placements, start=1):
            found = self._attempt(placement, began)
            proved = None if found is None else self._proved(found)
            cost = math.inf if proved is None else self._evaluator.cost(proved)
            yield self.incumbent.improved(Step(iteration=iteration, phase=PHASE, candidate=proved, cost=cost))
            began = time.thread_time()

    def _attempt(self, placement: Placement, began: float) -> Candidate | None:
        """Carry out lines 8 and 9 for a placement that has been drawn since `began`."""
        tip = placement.tip
        frame, rotation = tip.lps_from_scope_tip, placement.rotation_rad
        shape = shape_or_reason(self._design, placement.insertions_mm[::-1], placement.rotations_rad[::-1])
        if isinstance(shape, str):
            self._spend("placement", began)
            self.counts[shape] += 1
            return None
        reached = not self._rejects or self._evaluator.reaches(path_of(frame, rotation, shape).frames()[-1])
        began = self._spend("placement", began)
        if not reached:
            self.counts[OUT_OF_WORKSPACE] += 1
            return None
        deployment = self._tubes.validate(frame, rotation, shape)
        began = self._spend("tubes", began)
        if isinstance(deployment, str):
            self.counts[deployment] += 1
            return None
        path = self._path(deployment, placement.needle_seed)
        self._spend("needle", began)
        self.counts[NO_PATH if path is None else FOUND] += 1
        return None if path is None else Candidate(tip=tip, deployment=deployment, path=path)

    def _path(self, deployment: Deployment, seed: int) -> ArcPath | None:
        """Carry out line 9."""
        iterations, time_s = self._budget
        return self._needle_rrt.plan(
            deployment.lps_from_tip,
            self.task.target.lps_mm,
            deployment.branch,
            np.random.Generator(np.random.PCG64(seed)),
            iterations=iterations,
            time_s=time_s,
        )

    def _proved(self, found: Candidate) -> Candidate | None:
        """Return what was found with the tubes and the needle as the planner proves them."""
        began, own = time.thread_time(), found.deployment
        deployment = self._evaluator.tubes.validate_shape(
            found.tip.lps_from_scope_tip, own.rotation_rad, own.shape
        )
        stage = "tubes" if isinstance(deployment, str) else ""
        if not isinstance(deployment, str):
            path = replace(found.path, lps_from_start=deployment.lps_from_tip)
            if self._evaluator.proves(deployment, path):
                self._spend("proof", began)
                return Candidate(tip=found.tip, deployment=deployment, path=path)
            stage = "needle"
        self._spend("proof", began)
        self.refused_by_proof.append(Refusal(stage=stage, candidate=found))
        return None

    def _spend(self, part: str, began: float) -> float:
        now = time.thread_time()
        self.spent_s[part] += now - began
        return now


def obstacles_for(task: Task) -> Obstacles:
    """Return the solids that a task's tubes and needle may touch."""
    system, needle = task.system, task.system.require_needle("Algorithm 1 of [Kuntz2015]")
    reach = system.tubes.max_extension_mm + needle.exit_exemption_mm
    widest = max(system.tubes.outermost.radius_mm, needle.radius_mm)
    return Obstacles(
        task.lung, with_fissures=task.with_fissures, reach_mm=reach + widest + system.margins.total_mm
    )
