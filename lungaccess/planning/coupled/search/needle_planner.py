"""A needle planner by its name in the coupled search: ours, or one of OMPL; driven by OMPL if it is there."""

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from itertools import count
from typing import TYPE_CHECKING

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.planning.coupled.search import base
from lungaccess.planning.coupled.search.direct_arcs import DirectArcs
from lungaccess.plans.candidate import Candidate
from lungaccess.plans.evaluator import CandidateEvaluator
from lungaccess.problem.task import Task
from stages.needle import OMPL_PLANNERS, ArcPath, first_path, has_ompl, searches
from stages.scope import ScopeTip
from stages.tube import Deployment, design_arrays, longest_mm

if TYPE_CHECKING:
    from stages.needle.ompl import NeedleProblem

PHASE = "needle search"
PLANNER = "ao-rrt"
"""The planner where none is named: of those that look for low cost, it finds its first path soonest."""
DOUBLINGS = 3
"""In so many passes over the deployments the iterations double.  Later passes have other random numbers."""


class NamedNeedlePlanner:
    """Searches the needle's paths of one task with the planner that the task names.

    SettingsError is raised if it is a planner of OMPL and OMPL has been used in this process: it can be
    seeded once.
    """

    def __init__(self, evaluator: CandidateEvaluator, default: str) -> None:
        self._evaluator = evaluator
        self._name = evaluator.task.needle_planner or default
        if self._name in OMPL_PLANNERS:
            from stages.needle.ompl import seed_ompl

            seed_ompl(evaluator.task.seed + 1)

    def path(
        self,
        deployment: Deployment,
        end: Float | None = None,
        *,
        seed: int,
        iterations: int,
        cost_limit: float = math.inf,
    ) -> ArcPath | None:
        """Return a path from the tip of the tubes that costs less than a limit, None if none is found.

        The planners of OMPL look at no objective and at no seed; what they find may cost more.
        """
        query = self._evaluator.query(deployment, end)
        if self._name not in OMPL_PLANNERS and not has_ompl():
            search = searches()[self._name](
                self._evaluator.environment, query, seed, self._evaluator.objective
            )
            return first_path(search, iterations, cost_limit)
        return self._problem.plan(
            query, seed=seed, iterations=iterations, method=self._name, cost_limit=cost_limit
        )

    @cached_property
    def _problem(self) -> "NeedleProblem":
        from stages.needle.ompl import NeedleProblem  # Here: many searches end before they need it.

        return NeedleProblem(self._evaluator.environment, objective=self._evaluator.objective)


def needle_searches(
    arcs: DirectArcs,
    planner: NamedNeedlePlanner,
    incumbent: base.Incumbent,
    settings: base.SearchSettings,
    rng: np.random.Generator,
    share: tuple[int, int],
) -> Iterator[tuple[base.Step, Candidate | None]]:
    """Search for needle paths from deployments, the least lower bound of the cost first, pass after pass.

    A pass ends where the lower bound reaches the cost of the best candidate.  Each run is an iteration, and
    so is the end of a pass.  The candidate is where a local search may begin; the step has it only if there
    is no plan yet.  `share` is the number of this process, and how many share the deployments.
    """
    nothing = base.Step(iteration=0, phase=PHASE)
    if not len(arcs.in_workspace):
        return
    number, parts = share
    by_bound, bounds = arcs.by_bound
    ordered = base.different(arcs.atlas.deployments, by_bound)[number::parts]
    for level in count():
        iterations = settings.needle_iterations * 2 ** min(level, DOUBLINGS)
        for entry in ordered.tolist():
            if bounds[entry] >= incumbent.cost:
                break
            # A path may cost so many times what the best candidate costs: a local search can make it cheaper.
            limit = 1.3 * incumbent.cost - float(arcs.before(np.array([entry]))[0])
            found = _with_path(arcs, planner, entry, limit, iterations, rng)
            first = found is not None and incumbent.step is None
            yield base.evaluated_step(arcs.evaluator, PHASE, found) if first else nothing, found
        yield nothing, None


def _with_path(
    arcs: DirectArcs,
    planner: NamedNeedlePlanner,
    entry: int,
    cost_limit: float,
    iterations: int,
    rng: np.random.Generator,
) -> Candidate | None:
    """Return a deployment with a path that itself costs less than the limit, None if none is found."""
    candidate = arcs.candidate(entry)
    seed = int(rng.integers(2**63))
    if candidate is None:
        return None
    end = arcs.evaluator.end_of(candidate.path)
    path = planner.path(candidate.deployment, end, seed=seed, iterations=iterations, cost_limit=cost_limit)
    return None if path is None else replace(candidate, path=path)


@frozen_record
class Placement:
    """Where scope and tubes are placed.

    All tubes are turned by `rotation_rad`; `(n,)` insertions and further rotations begin with the outermost.
    `needle_seed` is that of the needle's RRT from there.
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


class KuntzSearch(base.ParallelSearch):
    """Algorithm 1 of [Kuntz2015]: random placement, workspace rejection, RRT, keep the best.

    Lines 3-7 draw site, rotation and translations; line 8 rejects placements whose workspace does not hold
    the target, unless `rejects` is false, with which the paper compares; line 9 runs the RRT, here for a
    fixed number of iterations so that runs repeat.
    """

    phase = "Algorithm 1"

    def __init__(self, task: Task, atlas: Atlas, *, rejects: bool = True) -> None:
        self._task, self._atlas, self._rejects = task, atlas, rejects
        self._evaluator = CandidateEvaluator(task)
        # The planner of line 9 where none is named is the paper's.
        self._needle_planner = NamedNeedlePlanner(self._evaluator, "rrt")
        super().__init__(self._evaluator.blocked)

    def further_steps(self) -> Iterator[base.Step]:
        """Draw placements without end; each is an iteration, and none depends on those before it."""
        placements = random_placements(self._task, self._atlas, self.share[0])
        for iteration, placement in enumerate(placements, start=1):
            candidate = self._attempt(placement)
            yield self.incumbent.improved(
                base.evaluated_step(self._evaluator, self.phase, candidate, iteration)
            )

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
