"""Algorithm 1 of [Kuntz2015] on clearance fields, for comparison."""

import math
from collections.abc import Iterator

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.planning.coupled.search.base import SearchInParts, Step, evaluated_step
from lungaccess.planning.coupled.search.needle_planner import NamedNeedlePlanner
from lungaccess.plans.candidate import Candidate
from lungaccess.plans.evaluator import CandidateEvaluator
from lungaccess.problem.task import Task
from stages.scope import ScopeTip
from stages.tube import design_arrays, longest_mm


@frozen_record
class Placement:
    """Where scope and tubes are placed.

    Args:
        rotation_rad: Rotation of all tubes.
        insertions_mm, rotations_rad ((n,) float64): Insertion of each tube, the outermost first, and how much
            farther it is turned.
        needle_seed: Seed of the needle's RRT from there.
    """

    tip: ScopeTip
    rotation_rad: float
    insertions_mm: Float
    rotations_rad: Float
    needle_seed: int


def random_placements(task: Task, atlas: Atlas, number: int = 0) -> Iterator[Placement]:
    """Draw placements without end, each `number` others; there is none if the scope can take no pose.

    The poses are drawn from the atlas's tips that look along the airway.  These lie evenly spaced by arc
    length, where a motion of the scope ends and an airway in lung tissue is ahead.
    """
    rng = np.random.Generator(np.random.PCG64([task.seed, number] if number else task.seed))
    along = np.flatnonzero(~atlas.motions.turned)
    tubes = task.system.tubes
    most_mm, turned = longest_mm(tubes), design_arrays(tubes).turned[::-1]
    while len(along):
        tip = atlas.motions.tip(int(rng.choice(along)))
        rotation = float(rng.uniform(0.0, 2.0 * math.pi))
        inserted = np.sort(rng.uniform(0.0, most_mm, len(turned)))
        relative = np.zeros(len(turned))
        relative[turned] = rng.uniform(0.0, 2.0 * math.pi, turned.sum())
        yield Placement(
            tip=tip,
            rotation_rad=rotation,
            insertions_mm=inserted,
            rotations_rad=relative,
            needle_seed=int(rng.integers(2**63)),
        )


PLANNER = "rrt"
"""The planner of line 9 where none is named: the paper's."""


class KuntzSearch(SearchInParts):
    """Algorithm 1 of [Kuntz2015]: random placement, workspace rejection, RRT, keep the best.

    Lines 3-7 draw site, rotation and translations; line 8 rejects placements whose workspace does not hold
    the target; line 9 runs the RRT, here for a fixed number of iterations so that runs repeat.

    Args:
        atlas: Only its motions of the scope are used.
        rejects: Whether line 8 is carried out; the paper compares with a run without it.
    """

    phase = "Algorithm 1"

    def __init__(self, task: Task, atlas: Atlas, *, rejects: bool = True) -> None:
        self._task, self._atlas, self._rejects = task, atlas, rejects
        self._evaluator = CandidateEvaluator(task)
        self._needle_planner = NamedNeedlePlanner(self._evaluator, PLANNER)
        super().__init__(self._evaluator.blocked)

    def further_steps(self) -> Iterator[Step]:
        """Draw placements without end; each is an iteration, and none depends on those before it."""
        placements = random_placements(self._task, self._atlas, self.share[0])
        for iteration, placement in enumerate(placements, start=1):
            candidate = self._attempt(placement)
            yield self.incumbent.improved(evaluated_step(self._evaluator, self.phase, candidate, iteration))

    def _attempt(self, placement: Placement) -> Candidate | None:
        """Carry out lines 8 and 9 for a placement."""
        evaluator, tip = self._evaluator, placement.tip
        deployment = evaluator.tubes.validate(
            tip.lps_from_scope_tip, placement.rotation_rad, placement.insertions_mm, placement.rotations_rad
        )
        if isinstance(deployment, str) or (self._rejects and not evaluator.reaches(deployment.lps_from_tip)):
            return None
        # Iterations of each RRT; the paper gives it 0.05 s, but a run by time cannot be repeated exactly.
        path = self._needle_planner.path(deployment, seed=placement.needle_seed, iterations=300)
        return None if path is None else Candidate(tip=tip, deployment=deployment, path=path)
