"""Stochastic local search over scope pose, tubes and needle together, in compiled batches."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from anatomy.typed import Float, UInt64
from lungaccess.coupled.kernels.candidate import INNER, N_CHOICE, OUTER, SCOPE_POSE
from lungaccess.coupled.kernels.local_search import MAX_VIAS, improve
from lungaccess.plans.candidate import Candidate
from lungaccess.plans.evaluator import CandidateEvaluator
from stages.needle import ArcPath, direct_path
from stages.scope import TipRow, evenly
from stages.tube import Deployment, TubeEnvironment, TubeShape, tube_constants, tube_environment
from stages.tube.kernels import ARC_COLUMNS

TubeArguments = tuple[TubeEnvironment, Float, Float, float]
"""Tubes for the kernels; see `lungaccess.coupled.kernels.candidate`."""

SHIFTS_MM = evenly(0.25, 4.0)
"""How much farther the scope may stop: a fraction of the 1 mm between the tips of an atlas, and several times
as far as the next."""
PERTURBATION = np.array([4.0, math.radians(15.0), 2.0, 2.0])
"""Standard deviations of a perturbation: scope pose (rows), rotation, and insertions in mm.  They are a few
steps of the atlas, so that the search leaves the neighbourhood of where it was."""
VIA_PERTURBATION_MM = 3.0
"""The same for each coordinate of a via point: the largest spread of a variation in the local search."""


@dataclass(kw_only=True, eq=False)
class LocalSearchRun:
    """The state of a local search that began at one candidate.

    Parameters
    ----------
    x : (4,) float64
    vias : (MAX_VIAS, 3) float64
        The best choice so far; see `lungaccess.coupled.kernels.candidate`.
    count : int
        Number of vias in use.
    cost : float
        Estimated cost of that choice; infinite before the search has begun.
    evaluated_cost : float
        The estimated cost at which the choice was last evaluated in full.
    shape : TubeShape or None
        That of tubes which are not planar; it is kept.
    """

    poses: TipRow
    x: Float
    vias: Float
    count: int
    cost: float = math.inf
    evaluated_cost: float = math.inf
    shape: TubeShape | None = None


class LocalSearch:
    """Improves candidates of one task.

    Parameters
    ----------

    Attributes
    ----------
    needle : tuple
        Argument of the kernels; see `lungaccess.coupled.kernels.candidate`.
    target : tuple of 3 floats
    """

    def __init__(self, evaluator: CandidateEvaluator, rng: np.random.Generator) -> None:
        task = evaluator.task
        self._evaluator, self._rng = evaluator, rng
        environment = tube_environment(task.lung, with_fissures=task.with_fissures)
        self._tube = (environment, tube_constants(task.system.tubes, task.system.margins))
        self.needle = evaluator.needle_arrays
        x, y, z = task.target.lps_mm.tolist()
        self.target = (x, y, z)

    def tube(self, shape: TubeShape | None = None) -> TubeArguments:
        """Return the tubes for the kernels, with their shape if they are not planar."""
        return tube_arguments(*self._tube, shape)

    def begin(self, candidate: Candidate | None) -> LocalSearchRun | None:
        """Return a run from a candidate; None without one, or if its needle has too many arcs."""
        if candidate is None:
            return None
        deployment = candidate.deployment
        points = candidate.path.frames()[1:-1, :3, 3]
        if len(points) > MAX_VIAS:
            return None
        poses = self._evaluator.tip_rows.along(candidate.tip, SHIFTS_MM)
        vias = np.zeros((MAX_VIAS, 3))
        vias[: len(points)] = points
        home = float(len(SHIFTS_MM) // 2)
        x = np.array([home, deployment.rotation_rad, deployment.outer_mm, deployment.inner_mm])
        return LocalSearchRun(poses=poses, x=x, vias=vias, count=len(points), shape=deployment.shape)

    def advance(self, run: LocalSearchRun, tries: int) -> None:
        """Evaluate so many variations of a run's choice, and keep the best."""
        state: UInt64 = self._rng.integers(2**64, size=1, dtype=np.uint64)
        run.count, run.cost = improve(
            self.tube(run.shape),
            self.needle,
            run.poses.tips,
            run.poses.proved,
            run.x,
            run.vias,
            run.count,
            self.target,
            tries,
            state,
        )

    def perturb(self, run: LocalSearchRun) -> None:
        """Move a run some distance away at random, and leave out some of its via points."""
        x, drawn = run.x, self._rng.standard_normal(N_CHOICE)
        x[:] = x + drawn * PERTURBATION
        x[SCOPE_POSE] = min(max(round(x[SCOPE_POSE]), 0), len(SHIFTS_MM) - 1)
        x[OUTER] = max(x[OUTER], 0.0)
        x[INNER] = max(x[INNER], x[OUTER])
        run.count = min(run.count, int(self._rng.integers(MAX_VIAS)))
        run.vias[: run.count] += VIA_PERTURBATION_MM * self._rng.standard_normal((run.count, 3))
        run.cost = run.evaluated_cost = math.inf

    def candidate(self, run: LocalSearchRun) -> Candidate | None:
        """Return a run's best choice as a candidate, in the numbers of a plan."""
        index = int(run.x[SCOPE_POSE])
        tip, (rotation, outer, inner) = self._evaluator.tip_rows.tip(run.poses, index), run.x[1:].tolist()
        rotation %= 2.0 * math.pi
        tubes, frame = self._evaluator.tubes, tip.lps_from_scope_tip
        if run.shape is None:
            deployment = tubes.validate(frame, rotation, outer, inner)
        else:
            deployment = tubes.validate_shape(frame, rotation, run.shape)
        if isinstance(deployment, str):
            return None
        path = path_through(deployment, run.vias[: run.count], self._evaluator.task.target.lps_mm)
        return Candidate(tip=tip, deployment=deployment, path=path)


def tube_arguments(environment: TubeEnvironment, constants: Float, shape: TubeShape | None) -> TubeArguments:
    """Return tubes as the kernels take them; see `lungaccess.coupled.kernels.candidate`."""
    if shape is None:
        return environment, constants, np.zeros((0, ARC_COLUMNS)), 0.0
    return environment, constants, np.array(shape.arcs), shape.required_beside_mm


def path_through(deployment: Deployment, vias: Float, target: Float) -> ArcPath:
    """Return the path of single arcs from the tip of the tubes through points (V, 3) to the target."""
    frame, arcs = deployment.lps_from_tip, []
    for point in [*vias, target]:
        arc = direct_path(frame, point)
        arcs.append(arc.arcs[0])
        frame = arc.frames()[-1]
    return ArcPath(lps_from_start=deployment.lps_from_tip, arcs=np.array(arcs))
