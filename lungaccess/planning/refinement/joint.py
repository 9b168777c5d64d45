"""Joint refinement of a proved candidate: scope, tubes and needle together."""

from collections.abc import Iterator

import numpy as np

from anatomy import poses
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from lungaccess.planning.refinement.layout import joints_of
from lungaccess.planning.refinement.problem import ARC_COUNTS, Problem, aimed, path_of, program_weights
from lungaccess.plans.candidate import Candidate
from lungaccess.plans.evaluator import CandidateEvaluator
from lungaccess.problem.task import Task
from stages.scope import ScopeTip
from stages.tube import Deployment

SHARES = (1.0, 0.85, 0.7, 0.5, 0.35, 0.2, 0.1)
"""Shares of the step from the candidate to what the program found that are tried until one is proved."""

ITERATIONS = 40
"""Most steps of IPOPT by default; docs/explanation/refinement.md has what they save."""
BETTER = 1e-3
"""Share of the cost that an improvement must save."""


def refine(task: Task, candidate: Candidate, *, iterations: int = ITERATIONS) -> Candidate | None:
    """Improve everything about a proved candidate together.

    A nonlinear program moves the place where the scope stops, the tubes and all arcs of the needle at once.
    What it finds is put back into the numbers of a plan and proved by the evaluator, so nothing is returned
    that it refuses.  Called again with what it returned, it may find more.  It is not for several threads at
    a time.

    Args:
        iterations: Most steps of the program's solver, each time it runs (two or three times a call).  For
            each number a program is built at the first call, which takes a second or two.

    Returns:
        Cheaper than the one given by BETTER or more, or None; always None for an objective that the program
        cannot express: see `program_weights`.
    """
    from lungaccess.planning.refinement.program import program

    weights = program_weights(task)
    if len(candidate.path.arcs) > ARC_COUNTS[-1] or weights is None:
        return None
    # First everything is solved for, then the needle alone from tubes that are proved.
    evaluator = CandidateEvaluator(task)
    problem = Problem(evaluator, candidate, weights)
    reconstruction = Reconstruction(evaluator, problem)
    limit = evaluator.cost(candidate) * (1.0 - BETTER)
    solver = program(problem.layout, iterations)
    _objective, values = solver.evaluate(problem.start, problem.numbers, problem.boxes)
    found = solver.solve(problem.start, problem.eased(values), problem.boxes)
    for placement in reconstruction.placements(found):
        numbers = problem.for_needle(placement.x, placement.tip, placement.deployment.shape)
        aimed = solver.solve(placement.x, numbers, problem.boxes)
        # Where the needle that the program ends at is refused, the one half as far is tried.
        for share in (1.0, 0.5):
            new = reconstruction.candidate(placement, placement.x + share * (aimed - placement.x))
            if new is None:
                continue
            if evaluator.cost(new) < limit:
                return new
            break
    return None


@frozen_record
class Placement:
    """Proved scope and tubes, and the program's variables `x` there, whose site counts from `tip`.

    `share` is that of the step from the candidate (0) to what the program found (1).
    """

    share: float
    x: Float
    tip: ScopeTip
    deployment: Deployment


class Reconstruction:
    """Puts variables of a problem back into the numbers of a plan, and proves them."""

    def __init__(self, evaluator: CandidateEvaluator, problem: Problem) -> None:
        self._evaluator, self._problem = evaluator, problem

    def placements(self, found: Float) -> Iterator[Placement]:
        """Yield proved tubes: the nearest to `found`, some at most half as far, those of the candidate."""
        # So many proved placements besides the candidate's own get a program for the needle alone, to save
        # time.
        farthest, left = 1.0, 2
        for share in SHARES:
            moved = self.placement(found, share) if left and share <= farthest else None
            if moved is not None:
                farthest, left = 0.5 * share, left - 1
                yield moved
        own = self.placement(found, 0.0)
        if own is not None:
            yield own

    def placement(self, found: Float, share: float) -> Placement | None:
        """Return the tubes at a share of the step from the candidate to `found`, None if they are refused."""
        at = self._problem.layout.variables
        x = self._problem.start + share * (found - self._problem.start)
        tip = self._problem.axis.tip(float(x[at["site"]]))
        deployment = None if tip is None else self._deployment(tip, x)
        if tip is None or deployment is None or isinstance(deployment, str):
            return None
        x[at["site"]] = 0.0
        x[at["outer"]], x[at["inner"]] = deployment.outer_mm, deployment.inner_mm
        x[self._problem.layout.joints] = joints_of(self._problem.design, deployment.shape)
        x[at["exit"]] = deployment.exit_mm
        return Placement(share=share, x=x, tip=tip, deployment=deployment)

    def candidate(self, placement: Placement, x: Float) -> Candidate | None:
        """Return the candidate with the needle of `x`, aimed anew, None if its proof fails."""
        needle = self._evaluator.task.system.require_needle("The joint refinement")
        at, kappa = self._problem.layout.variables, needle.max_curvature_per_mm
        start = placement.deployment.lps_from_tip
        rows = np.stack([x[at["lengths"]], kappa * x[at["bend_x"]], kappa * x[at["bend_y"]]], axis=1)
        aim = aimed(start, rows, self._evaluator.task.target.lps_mm, kappa)
        if aim is None:
            return None
        found = Candidate(tip=placement.tip, deployment=placement.deployment, path=path_of(start, aim))
        return found if self._evaluator.proves(found.deployment, found.path) else None

    def _deployment(self, tip: ScopeTip, x: Float) -> Deployment | str:
        """Return the tubes of `x`, or why they are refused; the rotation counts from the tip's own +x."""
        at, frame = self._problem.layout.variables, tip.lps_from_scope_tip
        smooth = poses.pose(frame[:3, 3], frame[:3, 2], self._problem.sideways)
        bend = poses.bending_directions(smooth, x[at["rotation"]])[0]
        shape = self._problem.model.shape_at(x[self._problem.layout.joints])
        if shape is None:
            return "the shape of the tubes keeps no limits"
        return self._evaluator.tubes.validate_shape(frame, poses.roll_towards(frame, bend), shape)
