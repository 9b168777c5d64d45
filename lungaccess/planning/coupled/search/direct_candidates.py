"""The simplest ways to a target from the deployments of an atlas, with a needle and without one."""

import math
from collections.abc import Callable, Iterator

import numpy as np

from anatomy.base.typed import Float, Int
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.planning.coupled.kernels.direct_arcs import choose_separated
from lungaccess.planning.coupled.search.aimed_tubes import AimedTubes
from lungaccess.planning.coupled.search.direct_arcs import DirectArcs
from lungaccess.plans.candidate import Candidate
from lungaccess.plans.evaluator import CandidateEvaluator
from lungaccess.problem.task import Task

DirectCandidates = DirectArcs | AimedTubes
"""Ways to the target of a task, at most one from each entry of an atlas: the direct arcs of the needle, or
without one the tubes aimed at the target."""


def direct_candidates(
    task: Task, atlas: Atlas, evaluator: CandidateEvaluator | None = None, aims: Float | None = None
) -> DirectCandidates:
    """Return the simplest ways to the target of a task, or to aims beside it; parameters are of `DirectArcs`.

    The evaluator proves them, for instance also for phases of the breath.
    """
    made = AimedTubes if task.system.needle is None else DirectArcs
    return made(task, atlas, evaluator, aims)


SAMPLES = 17
"""Points of each path that are compared; between two of them a path strays less than 1 mm from a line."""
NEAREST, SAMPLED, LEAST_OF_BRANCH = 1000, 2000, 100
"""The deployments that are evaluated: the nearest ones, and about so many of all, evenly spaced; at least so
many of every branch."""


def separated_candidates(
    arcs: DirectCandidates, count: int, separation_mm: float, expected: Callable[[Int], Float] | None = None
) -> Iterator[Candidate]:
    """Yield proved ways to the target that are separated, the cheapest of each branch first, then the others.

    The nearest deployments are evaluated with an even sample of the others, then further samples, but only
    as long as there are not enough plans.

    Args:
        expected: Returns what is expected of clear entries; the more, the better.  If None, cost decides.
    """
    near = arcs.promising
    pool, pool_costs = np.zeros(0, dtype=np.int64), np.zeros(0)
    proved: dict[int, Candidate | None] = {}
    chosen: list[int] = []
    for sample in _samples(arcs.atlas.deployments.branch[near]):
        blockers, costs, _best = arcs.evaluate(near[sample], math.inf)
        arcs.evaluator.blocked.update(arcs.reasons(blockers))
        clear = np.flatnonzero(blockers == 0)
        found = near[sample][clear]
        worth = costs[clear] if expected is None else -expected(found)
        pool, pool_costs = np.append(pool, found), np.append(pool_costs, worth)
        chosen = _chosen(arcs, pool[np.argsort(pool_costs, kind="stable")], count, separation_mm, proved)
        if len(chosen) == count:
            break
    for entry in chosen:
        candidate = proved[entry]
        if candidate is not None:
            yield candidate


def _samples(branch: Int) -> Iterator[Int]:
    """Yield parts of deployments, given by their branches (N,), that together are all of them.

    The first part holds the first deployments, and evenly spaced ones of every branch.
    """
    everyone = np.arange(len(branch))
    grouped = np.argsort(branch, kind="stable")
    _names, first, group, sizes = np.unique(
        branch[grouped], return_index=True, return_inverse=True, return_counts=True
    )
    strides = np.maximum(np.minimum(len(branch) // SAMPLED, sizes // LEAST_OF_BRANCH), 1)
    part = np.zeros(len(branch), dtype=np.int64)
    part[grouped] = (everyone - first[group]) % strides[group]
    part[:NEAREST] = 0
    for number in range(int(part.max(initial=0)) + 1):
        yield np.flatnonzero(part == number)


def _chosen(
    arcs: DirectCandidates,
    ordered: Int,
    count: int,
    separation_mm: float,
    proved: dict[int, Candidate | None],
) -> list[int]:
    """Choose separated deployments from clear ones by rising cost; `proved` keeps the proofs."""
    lines = arcs.lines(ordered, SAMPLES)
    order = _branches_first(arcs.atlas.deployments.branch[ordered])
    while True:
        refused = [n for n, entry in enumerate(ordered.tolist()) if proved.get(entry, True) is None]
        places = np.zeros(count, dtype=np.int64)
        found = choose_separated(lines, order[~np.isin(order, refused)], float(separation_mm), places)
        chosen: list[int] = ordered[places[:found]].tolist()
        unproved = [entry for entry in chosen if entry not in proved]
        for entry in unproved:
            proved[entry] = arcs.proved(entry)
        if all(proved[entry] is not None for entry in chosen):
            return chosen


def _branches_first(branch: Int) -> Int:
    """Return the order in which the first of every branch comes before all others."""
    first = np.sort(np.unique(branch, return_index=True)[1])
    return np.concatenate([first, np.setdiff1d(np.arange(len(branch)), first)])
