"""Joint refinement of a proved candidate: scope, tubes and needle together."""

from __future__ import annotations

from lungaccess.planning.refinement.problem import ARC_COUNTS, Problem, Weights, program_weights
from lungaccess.planning.refinement.reconstruction import Reconstruction
from lungaccess.plans.candidate import Candidate
from lungaccess.plans.evaluator import CandidateEvaluator
from lungaccess.problem.task import Task

ITERATIONS = 40
"""Most steps of IPOPT by default; docs/explanation/refinement.md has what they save."""
BETTER = 1e-3
"""Share of the cost that an improvement must save."""


def refine(task: Task, candidate: Candidate, *, iterations: int = ITERATIONS) -> Candidate | None:
    """Improve everything about a candidate together.

    A nonlinear program moves the place where the scope stops, the tubes and all arcs of the needle at once.
    What it finds is put back into the numbers of a plan and proved by the evaluator, so nothing is returned
    that it refuses.  Called again with what it returned, it may find more.  It is not for several threads at
    a time.

    Parameters
    ----------
    candidate : Candidate
        Proved by the evaluator.
    iterations : int
        Most steps of the program's solver, each time it runs (two or three times a call).  For each number a
        program is built at the first call, which takes a second or two.

    Returns
    -------
    Candidate or None
        Cheaper than the one given by BETTER or more, or None; always None for an objective that the program
        cannot express: see `lungaccess.planning.refinement.problem.program_weights`.
    """
    weights = program_weights(task)
    if len(candidate.path.arcs) > ARC_COUNTS[-1] or weights is None:
        return None
    return _refined(CandidateEvaluator(task), candidate, weights, iterations)


def _refined(
    evaluator: CandidateEvaluator, candidate: Candidate, weights: Weights, iterations: int
) -> Candidate | None:
    """Solve for everything, then for the needle alone from tubes that are proved."""
    from lungaccess.planning.refinement.program import program

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
