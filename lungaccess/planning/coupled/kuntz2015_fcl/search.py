"""Algorithm 1 of [Kuntz2015] as printed, with FCL on surface meshes instead of clearance fields."""

import itertools
import math
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float, Labels
from anatomy.structures import AIRWAY, LUMEN, OUTSIDE
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.planning.coupled.kuntz2015_fcl.needle import (
    SAGITTA_MM,
    NeedleRRT,
    Obstacles,
    branch_of,
    chord_mm,
)
from lungaccess.planning.coupled.search.base import ParallelSearch, Step
from lungaccess.planning.coupled.search.needle_planner import Placement, random_placements
from lungaccess.plans.candidate import Candidate
from lungaccess.plans.evaluator import CandidateEvaluator
from lungaccess.problem.system import System
from lungaccess.problem.task import Task
from stages.needle import ArcPath, arc_transform
from stages.tube import (
    REASONS,
    Deployment,
    TubeShape,
    design_arrays,
    kernels,
    pieces_of_arcs,
    shape_or_reason,
)

PHASE = "reference"
FOUND = "found"
OUT_OF_WORKSPACE = "the target lies outside the needle's workspace"
NO_PATH = "the RRT found no path"
"""What can become of a placement, besides the reasons why tubes are refused."""
RRT_ITERATIONS = 50
"""About what 0.05 s of [Kuntz2015] hold here."""


@frozen_record
class _Refusal:
    """A plan of the reference that the planner's proof refuses: whether its tubes or its needle."""

    stage: str
    candidate: Candidate


class ReferenceSearch(ParallelSearch):
    """Random placements, FCL, a needle RRT each, keep the best: the yardstick of the planner.

    The algorithm is as printed, but for what the paper leaves open or safety asks for.  The scope takes poses
    where it fits and an airway in lung tissue lies ahead, as in `KuntzSearch`; after line 8 the tubes are
    validated too.  A path that is found is yielded only if the planner's proof accepts it.  SettingsError is
    raised if an RRT has no budget.

    Args:
        rrt_iterations: Samples of each RRT: the same seed then gives the same plans.
        rrt_time_s: Processor time of each RRT instead, 0.05 in the paper, which cannot be repeated exactly.
        obstacles: Those of another search in the same lung, whose meshes take long to make.

    Attributes:
        counts: What became of the placements: `FOUND`, or why none was.
        spent_s: Processor time by part: "placement", "tubes", "needle", "proof".
        refused_by_proof: Paths that were found and are not yielded.
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
        self._needle_rrt = NeedleRRT(needle, needle.radius_mm + system.margins.total_mm, self.obstacles)
        self.counts: Counter[str] = Counter()
        self.spent_s: defaultdict[str, float] = defaultdict(float)
        self.refused_by_proof: list[_Refusal] = []

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
        iterations, time_s = self._budget
        rng = np.random.Generator(np.random.PCG64(placement.needle_seed))
        about = deployment.lps_from_tip, self.task.target.lps_mm, deployment.branch, rng
        path = self._needle_rrt.plan(*about, iterations=iterations, time_s=time_s)
        self._spend("needle", began)
        self.counts[NO_PATH if path is None else FOUND] += 1
        return None if path is None else Candidate(tip=tip, deployment=deployment, path=path)

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
        self.refused_by_proof.append(_Refusal(stage=stage, candidate=found))
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


NEAR_TISSUE = "the tube comes too near a vessel, the pleura or a fissure"
"""The meshes of these are one solid, so that the reason does not tell them apart."""


class TubeValidator:
    """Validates shapes of the tubes by the rules of `stages.tube`, but none of its fields."""

    def __init__(self, system: System, obstacles: Obstacles) -> None:
        self._system = system
        self._obstacles = obstacles
        self._mediastinal = obstacles.lung.tree.mediastinal

    def validate(self, lps_from_scope_tip: Float, rotation_rad: float, made: TubeShape) -> Deployment | str:
        """Return the deployment of a shape from a scope tip, or the reason why it is refused."""
        shape = path_of(lps_from_scope_tip, rotation_rad, made)
        # Spacing of the samples whose voxels are looked up, about a tenth of a voxel.
        points, at_mm = shape.sample(0.05)
        labels = self._obstacles.lung.grid.values_at(self._obstacles.lung.labels, points, OUTSIDE)
        first = self._first_outside(points, at_mm, (labels & LUMEN) != 0)
        if first == 0:
            return REASONS[kernels.NO_EXIT]
        branch = int(branch_of(labels[first - 1 : first])[0])
        if self._mediastinal[branch]:
            return REASONS[kernels.LEAVES_MEDIASTINAL]
        exit_mm = self._border_mm(points, at_mm, first)
        refused = self._contained(labels[first:], at_mm[first:] - exit_mm, branch)
        if refused:
            return refused
        lung, frame = self._obstacles.lung, frame_at(shape, exit_mm)
        pose = tuple(float(v) for v in (*frame[:3, 3], *frame[:3, 2]))
        angle = float(kernels.wall_angle(lung.labels, lung.geometry, pose))
        if angle < math.radians(self._system.tubes.min_wall_angle_deg):
            return REASONS[kernels.FLAT_EXIT]
        contact_mm = self._contact_mm(points[:first], at_mm[:first], made)
        refused = self._clear(shape, made, contact_mm, exit_mm, branch)
        if refused:
            return refused
        wall_run_mm = self._wall_run_mm(shape, made, exit_mm)
        if wall_run_mm > self._system.tubes.max_wall_run_mm:
            return REASONS[kernels.LONG_WALL_RUN]
        # The frame of the tip is carried along the tubes without turning.
        unturned = arc_transform(0.0, -float(made.arcs[-1, kernels.DIRECTION]), 0.0)
        return Deployment(
            rotation_rad=rotation_rad,
            outer_mm=float(made.insertions_mm[-1]),
            inner_mm=float(made.insertions_mm[0]),
            lps_from_tip=shape.frames()[-1] @ unturned,
            branch=branch,
            exit_mm=exit_mm,
            wall_angle_rad=angle,
            wall_run_mm=wall_run_mm,
            lateral_sweep_mm=made.lateral_sweep_mm,
            shape=made,
        )

    def _first_outside(self, points: Float, at_mm: Float, inside: Bool) -> int:
        """Return the first sample beyond the lumen, behind corners of voxels; 0 if there is none."""
        crossings = np.flatnonzero(inside[1:] != inside[:-1]) + 1
        if not inside[0] or not len(crossings):
            return 0
        for left, back in itertools.zip_longest(crossings[::2], crossings[1::2]):
            if back is None:
                return int(left)
            out_mm = self._border_mm(points, at_mm, back) - self._border_mm(points, at_mm, left)
            if out_mm > kernels.CORNER_MM:
                return int(left)
        return 0

    def _border_mm(self, points: Float, at_mm: Float, sample: int) -> float:
        """Return the arc length at which the axis crosses the border of the lumen before a sample."""
        # Points between two label samples among which the exit is found, about 0.001 mm from each other.
        share = np.linspace(0.0, 1.0, 51)
        begin, end = points[sample - 1 : sample + 1]
        lung, points = self._obstacles.lung, begin + share[:, None] * (end - begin)
        inside = (lung.grid.values_at(lung.labels, points, OUTSIDE) & LUMEN) != 0
        last = int(np.argmax(inside != inside[0])) - 1
        return float(at_mm[sample - 1] + share[last] * (at_mm[sample] - at_mm[sample - 1]))

    def _contained(self, labels: Labels, beyond_mm: Float, branch: int) -> str:
        """Return why the axis beyond the exit lies in something, or an empty text."""
        own = branch_of(labels) == branch
        if beyond_mm[-1] < kernels.WALL_ZONE_MM:
            return REASONS[kernels.NO_EXIT]
        if (labels & LUMEN).any():
            return REASONS[kernels.REENTERS_LUMEN]
        if (labels & self._obstacles.forbidden).any():
            return NEAR_TISSUE
        if (((labels & AIRWAY) != 0) & ~own).any():
            return REASONS[kernels.NEAR_OTHER_BRANCH]
        return ""

    def _wall_run_mm(self, shape: ArcPath, made: TubeShape, exit_mm: float) -> float:
        """Return how much of the tube beyond the exit is nearer to an airway than its radius, if not less."""
        run, at, pieces = 0.0, exit_mm, pieces_of(made)
        while at < shape.length_mm:
            _begin, end, radius = next((piece for piece in pieces if at < piece[1]), pieces[-1])
            beyond = self._obstacles.airways.distance_mm(frame_at(shape, at)[:3, 3]) - radius
            step = min(
                max(abs(beyond), kernels.RUN_STEP_MM),
                shape.length_mm - at if end >= shape.length_mm else end - at,
            )
            run += step if beyond < kernels.RUN_STEP_MM else 0.0
            at += step
        return run

    def _contact_mm(self, points: Float, at_mm: Float, made: TubeShape) -> float:
        """Return the arc length from which on the tube is never clear of the wall, up to its exit."""
        radii, ends = made.arcs[:, kernels.RADIUS], np.cumsum(made.arcs[:, kernels.LENGTH])
        # Every so many samples it is asked whether the tube touches the wall from inside.
        for n in range(len(points) - 1, 0, -5):
            radius = radii[min(int(np.searchsorted(ends, at_mm[n])), len(radii) - 1)]
            if self._obstacles.lumen.depth_mm(points[n]) >= radius:
                return float(at_mm[n])
        return 0.0

    def _clear(self, shape: ArcPath, made: TubeShape, contact_mm: float, exit_mm: float, branch: int) -> str:
        """Return what the tubes touch from their contact with the wall on, or an empty text."""
        margin = self._system.margins.total_mm + made.required_beside_mm
        for begin, end, radius in pieces_of(made):
            distance = radius + margin + SAGITTA_MM
            if max(begin, contact_mm) < end:
                line = line_between(shape, max(begin, contact_mm), end)
                if self._obstacles.tissue.is_near(line, distance):
                    return NEAR_TISSUE
            if max(begin, exit_mm) < end:
                line = line_between(shape, max(begin, exit_mm), end)
                if self._obstacles.other_airways(branch).is_near(line, distance):
                    return REASONS[kernels.NEAR_OTHER_BRANCH]
        return ""


def path_of(lps_from_scope_tip: Float, rotation_rad: float, made: TubeShape) -> ArcPath:
    """Return the centreline of a shape, all tubes turned by a rotation, from a scope tip."""
    return ArcPath(lps_from_start=lps_from_scope_tip, arcs=pieces_of_arcs(made.arcs, rotation_rad))


def pieces_of(made: TubeShape) -> list[tuple[float, float, float]]:
    """Return begin and end in mm, and radius in mm, of each arc of a shape."""
    lengths, radii = made.arcs[:, kernels.LENGTH], made.arcs[:, kernels.RADIUS]
    ends = np.cumsum(lengths)
    return list(zip((ends - lengths).tolist(), ends.tolist(), radii.tolist(), strict=True))


def frame_at(path: ArcPath, at_mm: float) -> Float:
    """Return the frame `(4, 4)` of a path at an arc length."""
    frame = np.asarray(path.lps_from_start)
    for length, roll, curvature in path.arcs:
        here = min(float(length), at_mm)
        frame = frame @ arc_transform(here, roll, curvature)
        at_mm -= here
    return frame


def line_between(path: ArcPath, begin_mm: float, end_mm: float) -> Float:
    """Return points `(N, 3)` of a path between two arc lengths, within SAGITTA_MM of it."""
    points, at_mm = path.sample(chord_mm(float(path.arcs[:, 2].max())))
    between = points[(at_mm > begin_mm) & (at_mm < end_mm)]
    ends = [frame_at(path, at)[None, :3, 3] for at in (begin_mm, end_mm)]
    return np.concatenate([ends[0], between, ends[1]])
