"""Random improvement of site, tubes and needle together, in compiled batches."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from anatomy.typed import Float, Float32, UInt64
from lungaccess.coupled.kernels.candidate import INNER, N_CHOICE, OUTER, SCOPE_POSE
from lungaccess.coupled.kernels.local_search import MAX_VIAS, improve
from lungaccess.coupled.search.evaluator import NeedleDesk
from lungaccess.coupled.search.scope_poses import Stands
from lungaccess.plans.assemble import Candidate, Task
from stages.needle import (
    NO_MAP,
    ArcPath,
    NeedleEnvironment,
    Objective,
    ObjectiveArrays,
    Obstacles,
    direct_path,
)
from stages.scope import Sites
from stages.tube import Deployment, TubeJudge, scene_of, tube_constants

Needle = tuple[Obstacles, Float, ObjectiveArrays, bool, Float32]

KICK = np.array([4.0, math.radians(15.0), 2.0, 2.0])
"""Spread of stand (rows), rotation, and insertions in mm."""
VIA_KICK_MM = 3.0


def objective_of(task: Task) -> Objective:
    """Return a task's objective for the kernels, which weigh a cost map only where there is one."""
    return task.objective.without_map if task.lung.cost is None else task.objective


@dataclass(kw_only=True, eq=False)
class Climb:
    """A candidate on its way to the nearest optimum.

    Parameters
    ----------
    stands : Stands
    x : (4,) float64
    vias : (MAX_VIAS, 3) float64
        See `lungaccess.coupled.kernels.candidate`.
    count : int
        Number of vias in use.
    cost : float
        Estimated; infinite before the first climb.
    priced : float
        The estimated cost when it was last finished.
    tries : int
        How many have been spent.
    """

    stands: Stands
    x: Float
    vias: Float
    count: int
    cost: float = math.inf
    priced: float = math.inf
    tries: int = field(default=0)


def needle_of(environment: NeedleEnvironment, task: Task) -> Needle:
    """Return a needle among obstacles, and what its path is to keep small, for the kernels."""
    objective, costs = objective_of(task), task.lung.cost
    blind = costs is not None and not objective.weighs_map and not np.isfinite(costs.array).all()
    walls = costs.array if blind and costs is not None else NO_MAP
    return environment.obstacles, environment.limits, environment.objective_arrays(objective), blind, walls


class Climber:
    """Improves candidates of one task.

    Parameters
    ----------
    desk : NeedleDesk
    judge : TubeJudge
    places : Sites
    rng : numpy.random.Generator
    """

    def __init__(self, desk: NeedleDesk, judge: TubeJudge, places: Sites, rng: np.random.Generator) -> None:
        task, environment = desk.task, desk.environment
        tubes, margins = task.system.tubes, task.system.margins
        self._desk, self._judge, self._places, self._rng = desk, judge, places, rng
        scene = scene_of(task.lung, with_fissures=task.with_fissures)
        self.tube = (scene, tube_constants(tubes, margins))
        self.needle = needle_of(environment, task)
        x, y, z = task.target.lps_mm.tolist()
        self.target = (x, y, z)

    def begin(self, candidate: Candidate) -> Climb | None:
        """Return where a candidate stands; None if its needle has too many arcs."""
        task, deployment = self._desk.task, candidate.deployment
        points = candidate.path.frames()[1:-1, :3, 3]
        if len(points) > MAX_VIAS:
            return None
        stands = Stands(task.lung, task.system.scope, self._places, candidate.tip, self._rng)
        vias = np.zeros((MAX_VIAS, 3))
        vias[: len(points)] = points
        x = np.array([stands.home, deployment.rotation_rad, deployment.outer_mm, deployment.inner_mm])
        return Climb(stands=stands, x=x, vias=vias, count=len(points))

    def advance(self, climb: Climb, tries: int) -> None:
        """Spend tries on a climb."""
        state: UInt64 = self._rng.integers(2**64, size=1, dtype=np.uint64)
        climb.count, climb.cost = improve(
            self.tube, self.needle, climb.stands.rows, climb.stands.allowed, climb.x, climb.vias, climb.count,
            self.target, tries, state,
        )  # fmt: skip
        climb.tries += tries

    def kick(self, climb: Climb) -> None:
        """Move a climb some way off at random, and let its needle go straight for the target or nearly so."""
        x, drawn = climb.x, self._rng.standard_normal(N_CHOICE)
        x[:] = x + drawn * KICK
        x[SCOPE_POSE] = min(max(round(x[SCOPE_POSE]), 0), len(climb.stands.tips) - 1)
        x[OUTER] = max(x[OUTER], 0.0)
        x[INNER] = max(x[INNER], x[OUTER])
        climb.count = min(climb.count, int(self._rng.integers(MAX_VIAS)))
        climb.vias[: climb.count] += VIA_KICK_MM * self._rng.standard_normal((climb.count, 3))
        climb.cost = climb.priced = math.inf

    def candidate(self, climb: Climb) -> Candidate | None:
        """Return the candidate at which a climb stands, in the numbers of a plan."""
        stand = int(climb.x[SCOPE_POSE])
        tip, (rotation, outer, inner) = climb.stands.tips[stand], climb.x[1:].tolist()
        rotation = climb.stands.rotation_rad(stand, rotation)
        deployment = self._judge.judge(tip.lps_from_scope_tip, rotation, outer, inner)
        if isinstance(deployment, str):
            return None
        path = path_through(deployment, climb.vias[: climb.count], self._desk.task.target.lps_mm)
        return Candidate(tip=tip, deployment=deployment, path=path)


def path_through(deployment: Deployment, vias: Float, target: Float) -> ArcPath:
    """Return the path of single arcs from the tip of the tubes through points (V, 3) to the target."""
    frame, arcs = deployment.lps_from_tip, []
    for point in [*vias, target]:
        arc = direct_path(frame, point)
        arcs.append(arc.arcs[0])
        frame = arc.frames()[-1]
    return ArcPath(lps_from_start=deployment.lps_from_tip, arcs=np.array(arcs))
