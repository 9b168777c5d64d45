"""Stochastic local search over scope pose, tubes and needle together, in compiled batches."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from anatomy.base.typed import Float, UInt64
from lungaccess.planning.coupled.kernels.candidate import INSERTED, ROTATION, SCOPE_POSE
from lungaccess.planning.coupled.kernels.local_search import MAX_VIAS, improve
from lungaccess.plans.candidate import Candidate
from lungaccess.plans.evaluator import CandidateEvaluator
from stages.needle import ArcPath, direct_path
from stages.scope import TipRow, evenly
from stages.tube import (
    Deployment,
    DesignArrays,
    ShapeArrays,
    TubeEnvironment,
    TubeShape,
    deployed,
    design_arrays,
    shape_arrays,
    shape_of_arrays,
    tube_constants,
    tube_environment,
)

TubeArguments = tuple[TubeEnvironment, Float, DesignArrays, ShapeArrays, ShapeArrays]
"""Tubes for the kernels; see `lungaccess.planning.coupled.kernels.candidate`."""

SHIFTS_MM = evenly(0.25, 4.0)
"""How much farther the scope may stop: a fraction of the 1 mm between the tips of an atlas, and several times
as far as the next."""
PERTURBATION = (4.0, math.radians(15.0), 2.0, math.radians(30.0))
"""Standard deviations of a perturbation: scope pose (rows), rotation, insertions in mm, and rotation of one
tube against the others.  They are a few steps of the atlas, so that the search leaves the neighbourhood of
where it was."""


@dataclass(kw_only=True, eq=False)
class TubeChoice:
    """A place of the scope and a deployment from it, which the kernels change.

    Args:
        x ((c,) float64): See `lungaccess.planning.coupled.kernels.candidate`.
    """

    x: Float
    shape: ShapeArrays

    @classmethod
    def empty(cls, design: DesignArrays) -> "TubeChoice":
        """Return one without a deployment."""
        shape = shape_arrays(design)
        return cls(x=np.zeros(INSERTED + len(shape.joints)), shape=shape)

    @classmethod
    def of(cls, design: DesignArrays, deployment: Deployment, row: float) -> "TubeChoice | None":
        """Return that of a deployment; None if its way does not keep the limits when it is followed anew."""
        made = deployment.shape
        shape = deployed(design, made.insertions_mm, made.rotations_rad)
        if shape is None:
            return None
        joints = made.insertions_mm[::-1], made.rotations_rad[::-1]
        return cls(x=np.concatenate([[row, deployment.rotation_rad], *joints]), shape=shape)

    @property
    def numbers(self) -> tuple[float, TubeShape]:
        """Rotation and shape, as `DeploymentValidator.choose` takes them."""
        return float(self.x[ROTATION]) % (2.0 * math.pi), shape_of_arrays(self.shape)

    def perturb(self, design: DesignArrays, rng: np.random.Generator) -> None:
        """Move it some distance away at random."""
        n, x = len(self.shape.tips), self.x
        row, turn, insertion, relative = PERTURBATION
        spreads = np.array([row, turn, *(insertion,) * n, *(relative * design.turned[::-1])])
        x[:] = x + rng.standard_normal(len(x)) * spreads
        x[SCOPE_POSE] = min(max(round(x[SCOPE_POSE]), 0), len(SHIFTS_MM) - 1)
        inserted = x[INSERTED : INSERTED + n]
        inserted[0] = max(inserted[0], 0.0)
        inserted[:] = np.maximum.accumulate(inserted)


@dataclass(kw_only=True, eq=False)
class LocalSearchRun:
    """The state of a local search that began at one candidate, whose paths end at `goal`.

    Args:
        vias ((MAX_VIAS, 3) float64): Those of the best choice so far, see `kernels.candidate`.
        cost: Estimated cost of that choice; infinite before the search has begun.
        evaluated_cost: The estimated cost at which the choice was last evaluated in full.
    """

    poses: TipRow
    goal: tuple[float, float, float]
    choice: TubeChoice
    vias: Float
    count: int
    cost: float = math.inf
    evaluated_cost: float = math.inf


class LocalSearch:
    """Improves candidates of one task; `needle` and `tube` are as kernels take them: `kernels.candidate`."""

    def __init__(self, evaluator: CandidateEvaluator, rng: np.random.Generator) -> None:
        self._evaluator, self._rng = evaluator, rng
        self.design = design_arrays(evaluator.task.system.tubes)
        self.tube = tube_arguments(evaluator, self.design)
        self.needle = evaluator.needle_arrays
        x, y, z = evaluator.task.target.lps_mm.tolist()
        self.target = (x, y, z)

    def begin(self, candidate: Candidate | None) -> LocalSearchRun | None:
        """Return a run from a candidate; None without one, or if its needle has too many arcs."""
        if candidate is None:
            return None
        points = candidate.path.frames()[1:-1, :3, 3]
        if len(points) > MAX_VIAS:
            return None
        choice = TubeChoice.of(self.design, candidate.deployment, float(len(SHIFTS_MM) // 2))
        if choice is None:
            return None
        poses = self._evaluator.tip_rows.along(candidate.tip, SHIFTS_MM)
        vias = np.zeros((MAX_VIAS, 3))
        vias[: len(points)] = points
        x, y, z = self._evaluator.end_of(candidate.path).tolist()
        return LocalSearchRun(poses=poses, goal=(x, y, z), choice=choice, vias=vias, count=len(points))

    def advance(self, run: LocalSearchRun, tries: int) -> None:
        """Evaluate so many variations of a run's choice, and keep the best."""
        state: UInt64 = self._rng.integers(2**64, size=1, dtype=np.uint64)
        choice, poses = run.choice, run.poses
        about = self.tube(choice), self.needle, poses.tips, poses.proved, choice.x, run.vias
        run.count, run.cost = improve(*about, run.count, run.goal, tries, state)

    def perturb(self, run: LocalSearchRun) -> None:
        """Move a run some distance away at random, and leave out some of its via points."""
        run.choice.perturb(self.design, self._rng)
        run.count = min(run.count, int(self._rng.integers(MAX_VIAS)))
        # The same for each coordinate of a via point: the largest spread of a variation in the local search.
        run.vias[: run.count] += 3.0 * self._rng.standard_normal((run.count, 3))
        run.cost = run.evaluated_cost = math.inf

    def candidate(self, run: LocalSearchRun) -> Candidate | None:
        """Return a run's best choice as a candidate, in the numbers of a plan."""
        tip = self._evaluator.tip_rows.tip(run.poses, int(run.choice.x[SCOPE_POSE]))
        deployment = self._evaluator.tubes.choose(tip.lps_from_scope_tip, *run.choice.numbers)
        if isinstance(deployment, str):
            return None
        path = path_through(deployment, run.vias[: run.count], np.array(run.goal))
        return Candidate(tip=tip, deployment=deployment, path=path)


def tube_arguments(
    evaluator: CandidateEvaluator, design: DesignArrays
) -> Callable[[TubeChoice], TubeArguments]:
    """Return what gives the tubes of a task, with the shape of a choice, as the kernels take them."""
    task, scratch = evaluator.task, shape_arrays(design)
    environment = tube_environment(task.lung, with_fissures=task.with_fissures)
    constants = tube_constants(task.system.tubes, task.system.margins)
    return lambda choice: (environment, constants, design, choice.shape, scratch)


def path_through(deployment: Deployment, vias: Float, target: Float) -> ArcPath:
    """Return the path of single arcs from the tip of the tubes through points (V, 3) to the target."""
    frame, arcs = deployment.lps_from_tip, []
    for point in [*vias, target]:
        arc = direct_path(frame, point)
        arcs.append(arc.arcs[0])
        frame = arc.frames()[-1]
    return ArcPath(lps_from_start=deployment.lps_from_tip, arcs=np.array(arcs))
