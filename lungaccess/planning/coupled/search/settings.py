"""Settings of the search over the deployment atlas."""

from typing import Annotated

from anatomy.base.settings import quantity, settings

ESTIMATE_SLACK = 1.03
"""Estimates of the kernels that exceed the best cost by more are dropped: few are over 1 % too large."""


@settings
class SearchSettings:
    """How the search shares its iterations among its phases; `docs/explanation/planning.md` explains them.

    The defaults are free choices; the results on that page were measured with them.

    Args:
        kept_slack: Direct arcs that cost up to so many times the cheapest may be starts of local searches.
        starts: Direct arcs with which the first successive halving begins.  More of them find a good region
            more surely, and leave less work for each.
        rungs: Rungs of a successive halving.
        rung_iterations: Iterations of each local search on the first rung; they double from rung to rung.
        perturbations: Perturbed copies of the best candidate that join the successive halving of each round.
        samplings: Iterations of local sampling in each round; with one or more, every round has an iteration.
        needle_searches: Runs of the needle's optimal search in each round.
        needle_iterations: Iterations of such a run in the first pass over the deployments; they double three
            times.
        intensifications: How often in each round the local search from the best candidate is evaluated in
            full.
        intensification_iterations: Iterations of that local search before each of these evaluations.
        refine_every: Rounds between two joint refinements, which take as long as several rounds.
    """

    kept_slack: Annotated[float, quantity("slack of kept direct arcs", at_least=1.0, at_most=100.0)] = 1.5
    starts: Annotated[int, quantity("starts of the first halving", at_least=1, at_most=10_000)] = 8
    rungs: Annotated[int, quantity("rungs of a halving", at_least=1, at_most=30)] = 5
    rung_iterations: Annotated[int, quantity("iterations on the first rung", at_least=1, at_most=10_000)] = 3
    perturbations: Annotated[int, quantity("perturbed copies a round", at_least=0, at_most=1000)] = 2
    samplings: Annotated[int, quantity("local samplings a round", at_least=1, at_most=1000)] = 6
    needle_searches: Annotated[int, quantity("needle searches a round", at_least=0, at_most=1000)] = 4
    needle_iterations: Annotated[
        int, quantity("iterations of a needle search", at_least=1, at_most=1_000_000)
    ] = 300
    intensifications: Annotated[int, quantity("intensifications a round", at_least=0, at_most=1000)] = 2
    intensification_iterations: Annotated[
        int, quantity("iterations of an intensification", at_least=1, at_most=10_000)
    ] = 20
    refine_every: Annotated[int, quantity("rounds between joint refinements", at_least=1)] = 16
