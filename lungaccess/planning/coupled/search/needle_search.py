"""The needle's own search from deployments of the atlas whose direct arc is blocked or costly."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import count

import numpy as np

from lungaccess.planning.coupled.search.base import Incumbent, Step, evaluated_step
from lungaccess.planning.coupled.search.direct_arcs import DirectArcs
from lungaccess.planning.coupled.search.entries import different
from lungaccess.planning.coupled.search.needle_planner import NamedNeedlePlanner
from lungaccess.planning.coupled.search.settings import SearchSettings
from lungaccess.plans.candidate import Candidate

PHASE = "needle search"
PLANNER = "ao-rrt"
"""The planner where none is named: of those that look for low cost, it finds its first path soonest."""
DOUBLINGS = 3
"""In so many passes over the deployments the iterations double.  Later passes have other random numbers."""
SLACK = 1.3
"""A path may cost so many times what the best candidate costs: a local search can make it cheaper."""


def needle_searches(
    arcs: DirectArcs,
    planner: NamedNeedlePlanner,
    incumbent: Incumbent,
    settings: SearchSettings,
    rng: np.random.Generator,
    share: tuple[int, int],
) -> Iterator[tuple[Step, Candidate | None]]:
    """Search for needle paths from deployments, the least lower bound of the cost first, pass after pass.

    A pass ends where the lower bound reaches the cost of the best candidate.  Each run is an iteration, and
    so is the end of a pass.

    Parameters
    ----------
    share : tuple of int
        Number of this process, and how many processes share the deployments.

    Yields
    ------
    Step, Candidate or None
        The candidate is where a local search may begin.  The step has it only if there is no plan yet.
    """
    nothing = Step(iteration=0, phase=PHASE)
    if not len(arcs.in_workspace):
        return
    number, parts = share
    by_bound, bounds = arcs.by_bound
    ordered = different(arcs.atlas.deployments, by_bound)[number::parts]
    for level in count():
        iterations = settings.needle_iterations * 2 ** min(level, DOUBLINGS)
        for entry in ordered.tolist():
            if bounds[entry] >= incumbent.cost:
                break
            limit = SLACK * incumbent.cost - float(arcs.before(np.array([entry]))[0])
            found = _with_path(arcs, planner, entry, limit, iterations, rng)
            first = found is not None and incumbent.step is None
            yield evaluated_step(arcs.evaluator, PHASE, found) if first else nothing, found
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
